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
from storage.keys import folder_of, token_of
from storage.models import Capture, PendingDeletion, StageRow
from storage.objects import ObjectStore

DAY = timedelta(days=1)
ROOTS = ("captures/", "jobs/")
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
    ids = {prefix.split("/")[1] for prefix in prefixes}
    captures = select(Capture.object_key).where(Capture.id.in_(ids), Capture.deleted_at.is_(None))
    named = {folder_of(key) or key for key in session.scalars(captures)}
    rows = session.scalars(select(StageRow).where(StageRow.job_id.in_(ids))).all()
    named |= {row.output_prefix for row in rows if row.output_prefix}
    named |= {row.checkpoint_prefix for row in rows if row.checkpoint_prefix}
    running = {(row.job_id, row.name): row.lease_token for row in rows if row.state == "running"}
    for prefix in prefixes:
        parts = prefix.split("/")
        token = token_of(f"{prefix}-")
        if token is not None and running.get((parts[1], parts[2])) == token:
            named.add(prefix)
    named |= set(
        session.scalars(
            select(PendingDeletion.prefix).where(
                PendingDeletion.prefix.in_([*prefixes, *(f"jobs/{one}/" for one in ids)])
            )
        )
    )
    return {
        prefix
        for prefix in prefixes
        if prefix in named or "/".join(prefix.split("/")[:2]) + "/" in named
    }
