"""Store and records compared: bytes that nobody will ever ask for, or delete, are swept.

They come to be where a process dies, or a COMMIT's outcome stays unknown, between storing bytes and
recording them. What is younger than a day may still be on its way to its record, and stays. So does
what has no place in `storage.keys`: it is not ours.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from datetime import datetime, timedelta
from itertools import groupby, islice

from sqlalchemy import select
from sqlalchemy.orm import Session

from storage.db import Database, now
from storage.errors import ObjectStoreError
from storage.keys import ROOTS, folder_of, place_of
from storage.models import Blob, Job, PendingDeletion, StageRow
from storage.objects import ObjectStore

DAY = timedelta(days=1)
BATCH = 200

_log = logging.getLogger("nerfworks.storage")


def sweep_orphans(
    database: Database,
    store: ObjectStore,
    *,
    older_than: timedelta = DAY,
    when: datetime | None = None,
) -> list[str]:
    """Put up for deletion what no record names (`storage.deletions`). Returns the prefixes.

    when: now; defaults to the database's clock. Half-done transfers of that age are dropped, too.
    Raises ObjectStoreError where the store does not answer.
    """
    if when is None:
        with database.read_scope() as session:
            when = now(session)
    edge = when - older_than
    found: list[str] = []
    old = (prefix for prefix, newest in _folders(store) if newest < edge)
    while batch := [*islice(old, BATCH)]:
        with database.session_scope("sweep", step="sweep") as session:
            spoken_for = _spoken_for(session, batch)
            orphans = [prefix for prefix in batch if prefix not in spoken_for]
            session.add_all(PendingDeletion(prefix=prefix, created_at=when) for prefix in orphans)
        found += orphans
    if found:
        _log.warning("%d folders of the object store belong to nobody: swept", len(found))
    try:
        dropped = store.drop_unfinished(edge)
    except ObjectStoreError as error:
        _log.info("half-done transfers were not looked for: %s", error)
    else:
        if dropped:
            _log.warning("%d half-done transfers were dropped", dropped)
    return found


def _folders(store: ObjectStore) -> Iterator[tuple[str, datetime]]:
    """Each folder that a record could name, and when something was last written there."""
    for root in ROOTS:
        placed = (
            (folder, entry.modified_at)
            for entry in store.list_entries(root)
            if (folder := folder_of(entry.key)) is not None
        )
        for folder, times in groupby(placed, key=lambda pair: pair[0]):
            yield folder, max(moment for _, moment in times)


def _spoken_for(session: Session, prefixes: list[str]) -> set[str]:
    """Of these folders, those that a record names, a running stage may write, or are to go."""
    places = {prefix: place for prefix in prefixes if (place := place_of(f"{prefix}-")) is not None}
    roots = {place.root for place in places.values() if place.root is not None}
    blobs = select(Blob.object_key).where(
        Blob.object_key.in_([f"{one}content" for one in prefixes])
    )
    named = {folder_of(key) or key for key in session.scalars(blobs)}
    found = session.execute(
        select(StageRow, Job.object_root)
        .join(Job, Job.id == StageRow.job_id)
        .where(Job.id.in_({root.split("/")[-2] for root in roots}), Job.object_root.in_(roots))
    ).all()
    for row, _ in found:
        named |= {row.output_prefix or "", row.checkpoint_prefix or "", row.report_prefix or ""}
    running = {(root, row.name, row.lease_token) for row, root in found if row.state == "running"}
    named |= {
        prefix
        for prefix, place in places.items()
        if (place.root, place.stage, place.token) in running
    }
    waiting = select(PendingDeletion.prefix).where(PendingDeletion.prefix.in_({*prefixes, *roots}))
    named |= set(session.scalars(waiting))
    return {prefix for prefix, place in places.items() if {prefix, place.root} & named}
