"""Bytes go after their records: deletion that survives a crash between the two.

`storage.jobs.delete_job` and `storage.records.delete_capture` leave a row per prefix in their own
transaction. Whoever deleted drains the rows at once; housekeeping drains what was left behind.
"""

from __future__ import annotations

import logging

from sqlalchemy import delete, select

from storage.db import Database
from storage.errors import ObjectStoreError
from storage.models import PendingDeletion
from storage.objects import ObjectStore

_log = logging.getLogger("nerfworks.storage")


def drain_deletions(database: Database, store: ObjectStore, limit: int = 100) -> int:
    """Delete the bytes of deleted records. Returns how many prefixes are gone.

    Deleting twice is harmless, so two callers at once are. A store that does not answer leaves
    the rest for later.
    """
    with database.read_scope() as session:
        query = select(PendingDeletion.id, PendingDeletion.prefix)
        waiting = session.execute(query.order_by(PendingDeletion.id).limit(limit)).all()
    done = 0
    for row_id, prefix in waiting:
        try:
            store.delete_prefix(prefix)
        except ObjectStoreError as error:
            _log.warning("could not delete %s yet: %s", prefix, error)
            break
        with database.session_scope() as session:
            session.execute(delete(PendingDeletion).where(PendingDeletion.id == row_id))
        done += 1
    return done
