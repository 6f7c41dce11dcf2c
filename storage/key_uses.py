"""When keys were used is noted beside the calls that use them.

A note is a write, and whoever only reads must not wait for those who write. So one thread notes,
and gives up soon where the database is locked, full or away: the note is lost, and the next use a
minute later brings another.
"""

from __future__ import annotations

import logging
import threading
import time

from sqlalchemy.exc import DBAPIError

from storage.api_keys import USED_GRAIN, touch_api_keys
from storage.db import Database

MAX_PENDING = 1000
PATIENCE_S = 1.0
CLOSE_S = 2.0
AGAIN_S = USED_GRAIN.total_seconds()

_log = logging.getLogger("nerfworks.storage")


class KeyUses:
    """Notes the uses of keys. Safe to share between threads; none of them waits."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._changed = threading.Condition()
        self._pending: set[str] = set()
        self._tried: dict[str, float] = {}  # when, by the monotonic clock
        self._closed = False
        self._thread: threading.Thread | None = None

    def note(self, key_id: str) -> None:
        """Have it noted that a key was used, unless that was tried in the last AGAIN_S."""
        with self._changed:
            moment = time.monotonic()
            tried = self._tried.get(key_id)
            if tried is not None and moment - tried < AGAIN_S:
                return
            if self._closed or len(self._pending) >= MAX_PENDING:
                return
            self._tried[key_id] = moment
            self._pending.add(key_id)
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, daemon=True, name="key uses")
                self._thread.start()
            self._changed.notify_all()

    def _serve(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pending or self._closed)
                if not self._pending:
                    return
                batch, self._pending = self._pending, set()
                edge = time.monotonic() - AGAIN_S
                self._tried = {key: tried for key, tried in self._tried.items() if tried > edge}
            try:
                with self._database.session_scope(patience_s=PATIENCE_S) as session:
                    touch_api_keys(session, batch)
            except DBAPIError as error:
                _log.warning("the use of %d keys could not be noted: %s", len(batch), error.orig)
            except Exception:  # noqa: BLE001 the thread must outlive whatever it meets
                _log.warning("the use of %d keys could not be noted", len(batch), exc_info=True)

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """End after what is noted by now."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)
