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
import secrets
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from storage.bell import Bell
from storage.claims import Claim, claim_next, claim_stage
from storage.db import Database
from storage.leases import owner_name, release_worker
from storage.models import Worker
from storage.open_objects import open_object_store
from storage.queries import ready_unclaimed
from storage.queue import QUEUE_GPU, RESOURCE_GPU, RESOURCES, queue_for, resource_of
from storage.records import (
    forget_worker,
    has_live_gpu,
    register_worker,
    worker_seen_lately,
)
from storage.settings import StorageSettings
from worker.compiling import KernelCompiler, compile_sources
from worker.containment.environment import CODE_ROOT
from worker.containment.planning import check_plan, make_plan
from worker.cores import num_cores
from worker.disk import DiskWatch
from worker.housekeeping import Housekeeping
from worker.locks import is_process
from worker.runner import Runner, load_registry
from worker.settings import WorkerSettings
from worker.store_watch import StoreWatch

_log = logging.getLogger("nerfworks.worker")


@dataclass(frozen=True)
class WorkerIdentity:
    """Who a worker is and what it offers. queues: those it really serves. boot: tells processes
    that go by one id, at once or one after the other, apart."""

    id: str
    slots: int
    queues: tuple[str, ...]
    has_gpu: bool
    boot: str = field(default_factory=lambda: secrets.token_hex(4))

    @property
    def owner(self) -> str:
        """The name under which it holds leases."""
        return owner_name(self.id, self.boot)

    @classmethod
    def of(cls, worker_id: str, slots: int, queues: Sequence[str], has_gpu: bool) -> WorkerIdentity:
        """Without a GPU a worker leaves the queue `gpu` alone: what no GPU worker is there for
        comes over the queue `cpu`."""
        served = tuple(name for name in queues if has_gpu or name != QUEUE_GPU)
        return cls(worker_id, slots, served, has_gpu)


def is_alive(other: Worker) -> bool:
    """Whether a worker that was seen lately still lives, as far as this machine can tell.

    A process id that is our own is a former self's: in a container every worker has the same.
    """
    if other.hostname != socket.gethostname():
        return True
    return other.pid != os.getpid() and is_process(other.pid)


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
        self._running: set[str] = set()  # stages; a slot that looks for one takes no cores
        self._gpu = threading.Lock()  # held by the slot whose stage runs on the GPU
        self._stages = load_registry(registry).STAGES
        self._plan = plan = make_plan(storage, settings, os.environ, has_gpu=identity.has_gpu)
        self._compiler = KernelCompiler(plan)
        self._disk = DiskWatch(storage.work_dir, settings.min_free_bytes)
        self._store_watch = StoreWatch(self._store)
        self._runners = [
            Runner(
                self._database,
                self._store,
                settings,
                work_dir=storage.work_dir,
                registry=registry,
                plan=plan,
                threads=self._threads_now,
                shutdown=self.shutdown,
                store_watch=self._store_watch,
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
        """Free what this worker's former self held, and start to keep house.

        Raises ContainmentError where stages must be contained and cannot be.
        """
        check_plan(self._plan)
        freed = self._enlist()
        if freed:
            _log.warning("a former self of this worker left: %s", ", ".join(freed))
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
            forget_worker(session, self.identity.id, self.identity.boot)
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
                self._running.add(taken.claim.stage_id)
                try:
                    ready = runner.run(taken.claim)
                finally:
                    self._running.discard(taken.claim.stage_id)
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
            if queue_for(resource_of(stage.needs_gpu), gpu_is_live) in self.identity.queues
        ]
        compile_sources(CODE_ROOT)
        for runner in self._runners:
            runner.prepare([stage.name for stage in mine])
        trains = any(stage.run.startswith("pipelines.stages.train:") for stage in mine)
        if trains and not self.identity.has_gpu:
            self._compiler.start()

    def _enlist(self) -> list[str]:
        """Take up the id, and what its former self held; beside one that lives, another id.

        Ids of the stages that became ready.
        """
        while True:
            try:
                with self._database.session_scope(f"worker:{self.identity.owner}") as session:
                    other = worker_seen_lately(session, self.identity.id)
                    if other is not None and is_alive(other):
                        self._rename()
                        freed = []
                    else:
                        freed = release_worker(session, self.identity.id)
                    self._enter(session, take_over=True)
                return freed
            except IntegrityError:
                continue  # another process entered the same id at this moment: look at it

    def _rename(self) -> None:
        mine = self.identity
        _log.warning("another worker goes by the id %s; this one goes on under its own", mine.id)
        self.identity = replace(mine, id=f"{mine.id}-{mine.boot}")

    def _register(self) -> None:
        with self._database.session_scope() as session:
            if not self._enter(session):
                self._rename()  # we were away for so long that another took our place
                self._enter(session)

    def _enter(self, session: Session, take_over: bool = False) -> bool:
        told = (runner.contained for runner in self._runners)
        contained = next((one for one in told if one is not None), None)
        return register_worker(
            session,
            self.identity.id,
            hostname=socket.gethostname(),
            pid=os.getpid(),
            boot=self.identity.boot,
            queues=self.identity.queues,
            slots=self.identity.slots,
            has_gpu=self.identity.has_gpu,
            contained=None if contained is None else contained.as_json(),
            take_over=take_over,
        )

    def _served(self, session: Session) -> list[str]:
        """The resources whose stages this worker may take at the moment."""
        gpu_is_live = has_live_gpu(session)
        return [name for name in RESOURCES if queue_for(name, gpu_is_live) in self.identity.queues]

    def _take(self, wanted: str | None = None) -> _Taken | None:
        """Claim the wanted stage, or else the next that waits; its GPU is then this slot's.

        A worker with a GPU takes what needs one first, a slot beside one that has it the rest.
        """
        if self.shutdown.is_set() or not (self._disk.has_room() and self._store_watch.answers()):
            return None
        has_gpu = self.identity.has_gpu and self._gpu.acquire(blocking=False)
        claim: Claim | None = None
        try:
            with self._database.session_scope(step="claim") as session:
                served = self._served(session)
                if self.identity.has_gpu and not has_gpu:
                    served = [name for name in served if name != RESOURCE_GPU]
                owner, lease_s = self.identity.owner, self._settings.lease_s
                if wanted is not None:
                    claim = claim_stage(session, wanted, owner, lease_s, resources=served)
                if claim is None:
                    claim = claim_next(session, self._ranked(served), owner, lease_s)
        except BaseException:
            claim = None  # where it was committed all the same, it runs out
            raise
        finally:
            on_gpu = has_gpu and claim is not None and claim.resource == RESOURCE_GPU
            if has_gpu and not on_gpu:
                self._gpu.release()
        return None if claim is None else _Taken(claim, on_gpu)

    def _ranked(self, served: list[str]) -> list[list[str]]:
        """A GPU serves what needs it first; without one all stages are alike."""
        if not self.identity.has_gpu:
            return [served]
        return [[name for name in served if (name == RESOURCE_GPU) is gpu] for gpu in (True, False)]

    def _threads_now(self) -> int:
        """A fair share of the processor for a stage that starts now."""
        return max(num_cores() // max(len(self._running), 1), 1)

    def _offer(self) -> None:
        if self._free.empty() or self.shutdown.is_set() or not self._disk.has_room():
            return
        if self._store_watch.is_pausing:
            return  # whoever takes a stage then asks the store: this thread waits for nothing
        with self._database.read_scope() as session:
            served = self._served(session)
            if self._gpu.locked():
                served = [name for name in served if name != RESOURCE_GPU]
            older_than_s = self._settings.direct_after_s
            waiting = ready_unclaimed(session, older_than_s, limit=1, resources=served)
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
