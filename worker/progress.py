"""What keeps a claim alive while its stage runs: heartbeats, progress, log lines.

A thread in the worker's parent process, so that a stage in a long native call still beats. It also
learns of a cancel, and of a lease that is lost: by the database's word, or because the database
did not answer for as long as the lease lasts, after which another worker may hold the stage.
"""

from __future__ import annotations

import logging
import threading
import time
from types import TracebackType

from sqlalchemy.exc import SQLAlchemyError

from storage.claims import Claim
from storage.db import Database
from storage.leases import heartbeat
from storage.queries import is_cancel_requested
from storage.records import append_logs
from worker.settings import WorkerSettings

_log = logging.getLogger("nerfworks.worker")
STEP_S = 0.5
PROGRESS_STEP_S = 1.0
MAX_BUFFERED_LINES = 5_000


class LeaseKeeper:
    """Holds a claim's lease while its block runs."""

    def __init__(self, database: Database, claim: Claim, settings: WorkerSettings) -> None:
        self.lost = threading.Event()
        self.cancel_requested = threading.Event()
        self._database = database
        self._claim = claim
        self._settings = settings
        self._lock = threading.Lock()
        self._progress: tuple[float, str, float | None] | None = None
        self._moved = False  # since it was last written
        self._lines: list[str] = []
        self._stopped = threading.Event()
        self._beat_at = self._looked_at = time.monotonic()
        self._thread = threading.Thread(target=self._loop, daemon=True, name="lease")

    def __enter__(self) -> LeaseKeeper:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stopped.set()
        self._thread.join()

    def is_up_to_date(self) -> bool:
        """Whether the last beat is younger than the lease.

        Otherwise this process stood still, or the database is away: another may hold the stage, and
        `lost` tells within a moment.
        """
        silent_s = time.monotonic() - self._beat_at
        return silent_s <= self._settings.lease_s or not self._thread.is_alive()

    def report(
        self, fraction: float, message: str, eta_s: float | None, *, moved: bool = True
    ) -> None:
        """Note progress; it is written within a second or so.

        moved: False where only the seconds left are new: they are written with the next heartbeat.
        """
        with self._lock:
            self._progress = (fraction, message, eta_s)
            self._moved |= moved

    def log(self, line: str) -> None:
        """Note a log line; it is written within a second or so."""
        with self._lock:
            if len(self._lines) < MAX_BUFFERED_LINES:
                self._lines.append(line)

    def flush(self) -> None:
        """Write the log lines that wait. Without the database they are kept for later."""
        with self._lock:
            lines, self._lines = self._lines, []
        if not lines:
            return
        try:
            with self._database.session_scope() as session:
                append_logs(session, self._claim, lines)
        except SQLAlchemyError as error:
            if not self.lost.is_set():
                _log.warning("log lines wait for the database: %s", type(error).__name__)
                with self._lock:
                    self._lines = (lines + self._lines)[:MAX_BUFFERED_LINES]

    def _loop(self) -> None:
        while not self._stopped.wait(STEP_S):
            if self.lost.is_set():
                continue
            try:
                self._step(time.monotonic())
            except SQLAlchemyError as error:
                _log.warning("heartbeat failed: %s", type(error).__name__)
                if time.monotonic() - self._beat_at > self._settings.lease_s:
                    self.lost.set()
            self.flush()

    def _step(self, moment: float) -> None:
        since_beat = moment - self._beat_at
        reporting = self._moved and since_beat >= PROGRESS_STEP_S
        if since_beat >= self._settings.heartbeat_s or reporting:
            self._beat(moment)
        elif moment - self._looked_at >= self._settings.cancel_poll_s:
            self._looked_at = moment
            with self._database.read_scope() as session:
                stop = is_cancel_requested(session, self._claim)
            if stop:
                self._beat(moment)

    def _beat(self, moment: float) -> None:
        with self._lock:
            progress, self._progress = self._progress, None
            moved, self._moved = self._moved, False
        fraction, message, eta_s = progress or (None, None, None)
        try:
            with self._database.session_scope(step="beat") as session:
                reply = heartbeat(
                    session,
                    self._claim,
                    self._settings.lease_s,
                    progress=fraction,
                    message=message,
                    eta_s=eta_s,
                    moved=moved,
                )
        except SQLAlchemyError:
            with self._lock:
                self._progress = self._progress or progress
                self._moved |= moved
            raise
        if reply.lost:
            self.lost.set()
        if reply.cancel_requested:
            self.cancel_requested.set()
        self._beat_at = self._looked_at = moment  # last: then `is_up_to_date`
