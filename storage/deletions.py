"""Bytes go after their records: deletion that survives a crash between the two.

`storage.jobs.delete_job` and `storage.records.delete_capture` leave a row per prefix in their own
transaction. The API's `Drainer` drains the rows at once; housekeeping drains what was left behind.
"""

from __future__ import annotations

import logging
import threading

from sqlalchemy import delete, select

from storage.db import Database
from storage.errors import ObjectStoreError
from storage.models import PendingDeletion
from storage.objects import ObjectStore
from storage.steps import reached

MAX_FAILURES = 3
"""So many in a row, and the store is taken for away until the next round."""

_log = logging.getLogger("nerfworks.storage")


def drain_deletions(database: Database, store: ObjectStore, limit: int = 100) -> int:
    """Delete the bytes of deleted records. Returns how many prefixes are gone.

    Deleting twice is harmless, so two callers at once are. What cannot be deleted goes to the end
    of the queue, so that it holds up nothing else.
    """
    with database.read_scope() as session:
        query = select(PendingDeletion.id, PendingDeletion.prefix, PendingDeletion.created_at)
        waiting = session.execute(query.order_by(PendingDeletion.id).limit(limit)).all()
    done = failures = 0
    for row_id, prefix, created_at in waiting:
        try:
            store.delete_prefix(prefix)
            failures = 0
            reached("erase.deleted")
        except ObjectStoreError as error:
            _log.warning("could not delete %s yet: %s", prefix, error)
            failures += 1
        with database.session_scope(step="erase") as session:
            gone = session.scalar(
                delete(PendingDeletion)
                .where(PendingDeletion.id == row_id)
                .returning(PendingDeletion.id)
            )
            if failures and gone is not None:
                session.add(PendingDeletion(prefix=prefix, created_at=created_at))
        if failures == MAX_FAILURES:
            break
        done += not failures
    return done


class Drainer:
    """Drains in a thread of its own, so that whoever deletes waits for the store only so long."""

    def __init__(self, database: Database, store: ObjectStore) -> None:
        self._database = database
        self._store = store
        self._changed = threading.Condition()
        self._asked = 0
        self._done = 0
        self._closed = False
        self._thread: threading.Thread | None = None

    def drain(self, wait_s: float) -> bool:
        """Start a round, which sees what is committed by now. Whether it ended within `wait_s`."""
        with self._changed:
            self._asked += 1
            mine = self._asked
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, daemon=True, name="drainer")
                self._thread.start()
            self._changed.notify_all()
            return self._changed.wait_for(lambda: self._done >= mine or self._closed, wait_s)

    def _serve(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked > self._done or self._closed)
                if self._closed:
                    return
                goal = self._asked
            try:
                drain_deletions(self._database, self._store)
            except Exception:  # noqa: BLE001 the thread must outlive whatever it meets
                _log.warning("a round of deletions failed", exc_info=True)
            with self._changed:
                self._done = goal
                self._changed.notify_all()

    def close(self, timeout_s: float) -> None:
        """End after the round in progress; what is left, housekeeping deletes."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)
