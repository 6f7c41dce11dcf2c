"""The guarded loops in every worker's parent process. No beat, no leader: each round is harmless
when several workers do it, because the database decides.

    register    refresh the worker's row: it is live, and has this
    reap        take back stages whose leases ran out
    dispatch    ring again for ready stages that nobody came for
    offer       let a free slot take a ready stage directly: work goes on without the broker, and
                also where the consumer is stuck after the broker came back
    clean       drop local folders of jobs that are over, rows of calls and workers of long ago, and
                bytes of deleted records
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

from storage.bell import Bell
from storage.clock import bring_times_back
from storage.db import Database, now
from storage.deletions import drain_deletions
from storage.idempotency import forget_old
from storage.leases import reap_expired
from storage.objects import ObjectStore
from storage.queries import WaitingStage, finished_jobs, ready_unclaimed
from storage.reconciling import sweep_orphans
from storage.records import forget_lost_workers
from worker.settings import WorkerSettings

_log = logging.getLogger("nerfworks.worker")
GONE = ".gone-"


def is_ring_due(stage: WaitingStage, moment: datetime, again_s: float) -> bool:
    """Whether the bell should ring again.

    At once when it never rang since the stage could run; then after `again_s`, twice that, and so
    on, so that a long queue behind a busy worker does not fill the broker.
    """
    if stage.rung_at is None or stage.rung_at < stage.since:
        return True
    waited_s = (stage.rung_at - stage.since).total_seconds()
    return moment - stage.rung_at >= timedelta(seconds=max(again_s, waited_s))


class Grace:
    """When a reaper may believe what it sees.

    A machine that slept, or was stopped, wakes with every lease on it run out, its own and those of
    the workers beside it, which live and have not yet had the time to say so. So a reaper that
    finds a gap behind itself that could have cost a lease waits until all had their turn.
    """

    def __init__(self, settings: WorkerSettings) -> None:
        self._gap = timedelta(seconds=max(settings.lease_s - settings.heartbeat_s, 0.0) / 2.0)
        self._pause = timedelta(seconds=max(settings.tick_s, 2.0 * settings.heartbeat_s))
        self._last: datetime | None = None
        self._until: datetime | None = None

    def is_new(self, moment: datetime) -> bool:
        """Whether the clock went back since the last round, or nobody knows: there was none."""
        return self._last is None or moment < self._last

    def is_over(self, moment: datetime) -> bool:
        """To be asked every round, by the clock that leases go by."""
        if self._last is not None and moment < self._last:
            self._until = None  # of a time that is still to come
        if self._last is not None and moment - self._last > max(self._gap, self._pause):
            self._until = moment + self._pause
            _log.warning("away for %.0f s: leases get some grace", (moment - self._last).seconds)
        self._last = moment
        return self._until is None or moment >= self._until


class Housekeeping:
    """Two threads: one asks the database alone, so that it is on time whatever else hangs; one
    cleans, which may wait for the object store.

    A round that fails is logged; the next one comes all the same.
    """

    def __init__(
        self,
        database: Database,
        store: ObjectStore,
        bell: Bell,
        settings: WorkerSettings,
        *,
        work_dir: Path,
        register: Callable[[], None],
        offer: Callable[[], None],
    ) -> None:
        self._database = database
        self._store = store
        self._bell = bell
        self._settings = settings
        self._work_dir = work_dir
        self._grace = Grace(settings)
        # Workers that started together do not sweep together.
        self._sweep_at = time.monotonic() + settings.sweep_s * secrets.randbelow(100) / 400
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(
                target=self._loop,
                args=((register, self.reap, self.dispatch, offer), settings.tick_s),
                daemon=True,
                name="housekeeping",
            ),
            threading.Thread(
                target=self._loop,
                args=((self.clean, self.sweep), settings.clean_s),
                daemon=True,
                name="cleaning",
            ),
        ]

    def start(self) -> None:
        """Start the loops."""
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float) -> None:
        """End the loops after the rounds in progress, or leave them behind after `timeout_s`."""
        self._stopped.set()
        give_up_at = time.monotonic() + timeout_s
        for thread in self._threads:
            if thread.is_alive():
                thread.join(max(give_up_at - time.monotonic(), 0.0))

    def _loop(self, duties: tuple[Callable[[], None], ...], pause_s: float) -> None:
        while not self._stopped.is_set():
            for duty in duties:
                try:
                    duty()
                except Exception:  # noqa: BLE001 the loop must outlive whatever a round meets
                    _log.exception("housekeeping: %s failed", duty.__name__)
            self._stopped.wait(pause_s)

    def reap(self) -> None:
        """Take back stages whose leases ran out; not at once where we ourselves were away.

        Where the clock went back, what it left ahead of itself is said anew first: in a transaction
        of its own, so that a round that fails is done again.
        """
        actor = f"reaper:{socket.gethostname()}"
        with self._database.read_scope() as session:
            is_new = self._grace.is_new(now(session))
        if is_new:
            self._bring_times_back(actor)
        with self._database.session_scope(actor, step="reap") as session:
            moment = now(session)
            ready = reap_expired(session, moment) if self._grace.is_over(moment) else []
        if ready:
            _log.warning("lost their workers: %s", ", ".join(ready))
            self._bell.ring(ready)

    def _bring_times_back(self, actor: str) -> None:
        with self._database.session_scope(actor) as session:
            ahead = bring_times_back(session, now(session))
        if ahead:
            _log.warning("the clock went back; times of %d stages said anew", len(ahead))

    def dispatch(self) -> None:
        """Ring for ready stages that nobody came for."""
        with self._database.read_scope() as session:
            moment = now(session)
            waiting = ready_unclaimed(session)
        due = [
            stage.id for stage in waiting if is_ring_due(stage, moment, self._settings.ring_again_s)
        ]
        self._bell.ring(due)

    def sweep(self) -> None:
        """Search the object store for what belongs to no record; rarely, for it looks at all."""
        if time.monotonic() >= self._sweep_at:
            self._sweep_at = time.monotonic() + self._settings.sweep_s
            sweep_orphans(self._database, self._store)

    def _clean_folders(self) -> None:
        """Drop folders of jobs that are over.

        Each is set aside in one step, right after the look at its job, and only then removed: a job
        that is retried meanwhile begins with a folder of its own.
        """
        folders = list(self._work_dir.iterdir()) if self._work_dir.is_dir() else []
        for folder in folders:
            if folder.name.startswith(GONE):
                shutil.rmtree(folder, ignore_errors=True)
                continue
            with self._database.read_scope() as session:
                is_over = bool(finished_jobs(session, [folder.name]))
            if is_over:
                aside = folder.with_name(f"{GONE}{folder.name}-{secrets.token_hex(4)}")
                with contextlib.suppress(OSError):  # another worker of this home was first
                    folder.rename(aside)
                shutil.rmtree(aside, ignore_errors=True)

    def clean(self) -> None:
        """Drop what finished jobs left here, rows that nobody needs, bytes of deleted records."""
        self._clean_folders()
        with self._database.session_scope() as session:
            forget_old(session)
            forget_lost_workers(session)
        drain_deletions(self._database, self._store)  # last: the store may hang
