"""A worker without its bell: slots, claims and housekeeping. `worker.tasks` calls `serve`.

A message only wakes a slot. A slot that has ended a stage goes on with whatever else this worker
may take, oldest job first: the next stage of the same job finds its inputs on this machine.

Of several slots one at a time runs on the GPU, whose memory is not to be shared; the others take
what needs none. A stage starts with the processor's cores divided by the slots that are busy then.
"""

from __future__ import annotations

import logging
import os
import queue
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from storage.bell import Bell
from storage.db import Database
from storage.leases import Claim, claim_stage, release_worker
from storage.open_objects import open_object_store
from storage.queries import WaitingStage, ready_unclaimed
from storage.queue import QUEUE_GPU, queue_for
from storage.records import forget_worker, has_live_gpu, register_worker
from storage.settings import StorageSettings
from worker.compiling import KernelCompiler
from worker.housekeeping import Housekeeping
from worker.runner import Runner, load_registry
from worker.settings import WorkerSettings

_log = logging.getLogger("nerfworks.worker")


@dataclass(frozen=True)
class WorkerIdentity:
    """Who a worker is and what it offers. queues: those it really serves."""

    id: str
    slots: int
    queues: tuple[str, ...]
    has_gpu: bool

    @classmethod
    def of(cls, worker_id: str, slots: int, queues: Sequence[str], has_gpu: bool) -> WorkerIdentity:
        """Without a GPU a worker leaves the queue `gpu` alone: what no GPU worker is there for
        comes over the queue `cpu`."""
        served = tuple(name for name in queues if has_gpu or name != QUEUE_GPU)
        return cls(worker_id, slots, served, has_gpu)


def num_cores() -> int:
    """Processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class _Taken:
    """A claim, and whether it holds the worker's GPU."""

    claim: Claim
    on_gpu: bool


class WorkerRuntime:
    """The slots of one worker process and the loop that keeps house."""

    def __init__(
        self,
        identity: WorkerIdentity,
        storage: StorageSettings,
        settings: WorkerSettings,
        *,
        registry: str,
        on_unheard: Callable[[], None] = lambda: None,
    ) -> None:
        """on_unheard: called when the bell rang for a stage and no idle slot came,."""
        self.identity = identity
        self._on_unheard = on_unheard
        self.shutdown = threading.Event()
        self._settings = settings
        self._database = Database(storage.resolved_database_url, storage.database_timeout_s)
        self._store = open_object_store(storage)
        self._bell = Bell(storage.redis_url, self._database)
        self._direct = ThreadPoolExecutor(identity.slots, thread_name_prefix="direct")
        self._free: queue.SimpleQueue[Runner] = queue.SimpleQueue()
        self._gpu = threading.Lock()  # held by the slot whose stage runs on the GPU
        self._stages = load_registry(registry).STAGES
        self._compiler = KernelCompiler()
        self._runners = [
            Runner(
                self._database,
                self._store,
                settings,
                work_dir=storage.work_dir,
                registry=registry,
                threads=self._threads_now,
                shutdown=self.shutdown,
            )
            for _ in range(identity.slots)
        ]
        for runner in self._runners:
            self._free.put(runner)
        self._housekeeping = Housekeeping(
            self._database,
            self._store,
            self._bell,
            settings,
            work_dir=storage.work_dir,
            register=self._register,
            offer=self._offer,
        )

    def start(self) -> None:
        """Free what this worker's former self held, and start to keep house."""
        with self._database.session_scope() as session:
            freed = release_worker(session, self.identity.id)
        if freed:
            _log.warning("a former self of this worker left: %s", ", ".join(freed))
        self._register()
        self._prepare()
        self._bell.ring(freed)
        self._housekeeping.start()

    def close(self) -> None:
        """End the slots: running stages are given back, stage processes are killed."""
        self.shutdown.set()
        self._housekeeping.stop(self._settings.cancel_grace_s)
        self._direct.shutdown(wait=True)
        for runner in self._runners:
            runner.close()
        self._compiler.stop()
        with self._database.session_scope() as session:
            forget_worker(session, self.identity.id)
        self._bell.close()
        self._database.dispose()

    def serve(self, stage_id: str | None = None) -> None:
        """Run a stage, if it is free and so is a slot; then whatever else waits for this worker."""
        try:
            runner = self._free.get_nowait()
        except queue.Empty:
            return  # the database remembers the stage; a slot that ends its work looks there
        try:
            taken = self._take(stage_id)
            while taken is not None:
                try:
                    ready = runner.run(taken.claim)
                finally:
                    if taken.on_gpu:
                        self._gpu.release()
                taken = self._take()
                mine = taken.claim.stage_id if taken else None
                self._bell.ring([key for key in ready if key != mine])
        finally:
            self._free.put(runner)

    def _prepare(self) -> None:
        """Start what makes the first job as fast as the second."""
        if not self._settings.prepare:
            return
        with self._database.read_scope() as session:
            gpu_is_live = has_live_gpu(session)
        mine = [
            stage
            for stage in self._stages
            if queue_for(stage.needs_gpu, gpu_is_live) in self.identity.queues
        ]
        for runner in self._runners:
            runner.prepare([stage.name for stage in mine])
        trains = any(stage.run.startswith("pipelines.stages.train:") for stage in mine)
        if trains and not self.identity.has_gpu:
            self._compiler.start()

    def _register(self) -> None:
        with self._database.session_scope() as session:
            register_worker(
                session,
                self.identity.id,
                hostname=socket.gethostname(),
                pid=os.getpid(),
                queues=self.identity.queues,
                slots=self.identity.slots,
                has_gpu=self.identity.has_gpu,
            )

    def _claim(self, stage_id: str) -> Claim | None:
        with self._database.session_scope() as session:
            return claim_stage(session, stage_id, self.identity.id, self._settings.lease_s)

    def _waiting(self, older_than_s: float) -> list[WaitingStage]:
        """Ready stages that this worker may take now; GPU stages first where it has a GPU."""
        with self._database.read_scope() as session:
            waiting = ready_unclaimed(session, older_than_s)
            gpu_is_live = bool(waiting) and has_live_gpu(session)
        mine = [
            stage
            for stage in waiting
            if queue_for(stage.needs_gpu, gpu_is_live) in self.identity.queues
        ]
        if self.identity.has_gpu:
            mine.sort(key=lambda stage: not stage.needs_gpu)
            if self._gpu.locked():
                mine = [stage for stage in mine if not stage.needs_gpu]
        return mine

    def _take(self, wanted: str | None = None) -> _Taken | None:
        """Claim the wanted stage, or else the next that waits; its GPU is then this slot's."""
        if self.shutdown.is_set():
            return None
        for stage in sorted(self._waiting(0.0), key=lambda stage: stage.id != wanted):
            on_gpu = stage.needs_gpu and self.identity.has_gpu
            if on_gpu and not self._gpu.acquire(blocking=False):
                continue
            claim: Claim | None = None
            try:
                claim = self._claim(stage.id)
            finally:
                if on_gpu and claim is None:
                    self._gpu.release()
            if claim is not None:
                return _Taken(claim, on_gpu)
        return None

    def _threads_now(self) -> int:
        """A fair share of the processor for a stage that starts now."""
        busy = self.identity.slots - self._free.qsize()
        return max(num_cores() // max(busy, 1), 1)

    def _offer(self) -> None:
        if self._free.empty() or self.shutdown.is_set():
            return
        waiting = self._waiting(self._settings.direct_after_s)
        if not waiting:
            return
        _log.info("taking %s, which nobody came for", waiting[0].id)
        self._direct.submit(self.serve, waiting[0].id)
        rung_at, since = waiting[0].rung_at, waiting[0].since
        if rung_at is not None and rung_at >= since:
            self._on_unheard()


_current: list[WorkerRuntime] = []


def set_current_runtime(runtime: WorkerRuntime) -> None:
    """Name the runtime of this process, for the Celery tasks."""
    _current[:] = [runtime]


def current_runtime() -> WorkerRuntime:
    """The runtime of this process. Raises RuntimeError before `set_current_runtime`."""
    if not _current:
        raise RuntimeError("this process was not started as `python -m worker`")
    return _current[0]
