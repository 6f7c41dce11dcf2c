"""One attempt of one stage: fetch inputs, run it in the slot's process, publish, record.

Whatever happens ends in exactly one operation of `storage.leases`, repeated until the database has
answered: one that comes too late, because the lease was lost, is refused, and only then is what was
uploaded deleted. A worker that must end before it has an answer leaves everything as it is.
"""

from __future__ import annotations

import importlib
import logging
import os
import queue
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from pipelines.stage import Stage
from pipelines.workspace import Workspace
from storage import keys
from storage.claims import Claim
from storage.db import Database, is_away
from storage.errors import LostLeaseError, NotFoundError, StorageError
from storage.leases import (
    FailureReport,
    cancel_stage,
    crash_stage,
    fail_stage,
    release_stage,
    succeed_stage,
)
from storage.objects import ObjectStore
from storage.queries import StageWork, stage_work
from storage.runs import RunEnd
from storage.steps import reached
from worker.checkpoints import CheckpointUploader, snapshot_of
from worker.containment.apply import Containment
from worker.containment.plan import Plan
from worker.cores import num_cores
from worker.disk import free_bytes
from worker.failures import publish_failure
from worker.laps import Laps
from worker.outcomes import (
    StageCrashedError,
    StageFailedError,
    StopRunError,
    UnknownOutcomeError,
    crash_of,
    disk_too_small,
    failed_of,
    failure_of,
    gave_up_of,
    stalled_of,
    time_limit_of,
)
from worker.predecessors import end_predecessor
from worker.process import StageProcess
from worker.progress import LeaseKeeper
from worker.pulse import Pulse
from worker.settings import WorkerSettings
from worker.store_watch import StoreWatch
from worker.transfer import (
    fetch_capture,
    fetch_inputs,
    missing_bytes,
    publish_folder,
    restore_checkpoint,
    write_job_file,
)

_log = logging.getLogger("nerfworks.worker")
MESSAGE_STEP_S = 0.25
GUARD_STEP_S = 0.05
LOG_END_S = 2.0
CHECKPOINT_END_S = 120.0
RECORD_STEP_S = 1.0
Result = TypeVar("Result")


class Registry(Protocol):
    """What a registry module offers: `pipelines.registry`, or a test's own."""

    STAGES: tuple[Stage, ...]

    def get_stage(self, name: str) -> Stage: ...


def load_registry(name: str) -> Registry:
    """The registry module of that dotted name. Reading it imports no stage's code."""
    module: Registry = importlib.import_module(name)
    return module


class Runner:
    """Runs attempts for one slot, in one warm process that is replaced when it dies.

    registry: dotted name of the stages' registry. plan: what its process may touch.
    threads: says how many the numeric libraries of a stage that starts now may use, where the
    environment's OMP_NUM_THREADS does not.
    shutdown: set when the worker ends; a running attempt then gives its stage back. store_watch:
    the worker's; an attempt that it explains does so, too.
    """

    def __init__(
        self,
        database: Database,
        store: ObjectStore,
        settings: WorkerSettings,
        *,
        work_dir: Path,
        registry: str,
        plan: Plan,
        threads: Callable[[], int],
        shutdown: threading.Event,
        store_watch: StoreWatch | None = None,
    ) -> None:
        self._database = database
        self._store = store
        self._settings = settings
        self._work_dir = work_dir
        self._registry_name = registry
        self._registry = load_registry(registry)
        self._plan = plan
        self._threads = threads
        self._shutdown = shutdown
        self._store_watch = store_watch or StoreWatch(store)
        self._preload: Sequence[str] = ()
        self._process: StageProcess | None = None
        self._peak_bytes: int | None = None  # of the run at hand

    def prepare(self, preload: Sequence[str]) -> None:
        """Start the process before there is anything to run.

        preload: stages whose code it, and those that take its place, load while they are idle.
        """
        self._preload = preload
        self._ensure_process()

    def close(self) -> None:
        """Kill the warm process."""
        if self._process is not None:
            self._process.kill()
            self._process = None

    def run(self, claim: Claim) -> list[str]:
        """Run a claimed stage to its recorded end. Ids of stages that became ready."""
        _log.info("%s: attempt %d", claim.stage_id, claim.attempt)
        prefix = keys.attempt_prefix(claim.root, claim.name, claim.attempt, claim.token)
        with LeaseKeeper(self._database, claim, self._settings) as keeper:
            try:
                manifest = self._attempt(claim, keeper, prefix)
                record: Callable[[Session], Any] = lambda session: succeed_stage(  # noqa: E731
                    session,
                    claim,
                    manifest=manifest,
                    output_prefix=prefix,
                    peak_bytes=self._peak_bytes,
                )
            except Exception as error:  # noqa: BLE001 every end of an attempt is recorded
                self._discard(claim, prefix)  # the database was never told of it
                record = self._record_of(claim, error, prefix)
            keeper.flush()
            try:
                ready = self._record(record)
            except UnknownOutcomeError:
                _log.warning("%s: nobody knows whether its end was recorded", claim.stage_id)
                return []
            except (LostLeaseError, NotFoundError):
                _log.warning("%s: lease lost, work thrown away", claim.stage_id)
                self._discard(claim, prefix)
                return []
        if not isinstance(ready, list):
            if ready != "failed":
                self._discard(claim, prefix)
            _log.info("%s: %s", claim.stage_id, ready or "cancelled")
            return []
        _log.info("%s: succeeded", claim.stage_id)
        self._discard(claim, keys.stage_prefix(claim.root, claim.name), keep=prefix)
        reached("finish.tidied")
        return ready

    def _guard_of(self, keeper: LeaseKeeper, *, waits: bool) -> Callable[[], None]:
        """waits: not a byte more before it is known whose the stage is."""

        def guard() -> None:
            while True:
                if keeper.lost.is_set():
                    raise StopRunError("lost")
                if keeper.cancel_requested.is_set():
                    raise StopRunError("cancel")
                if self._shutdown.is_set():
                    raise StopRunError("shutdown")
                if not waits or keeper.is_up_to_date():
                    return
                time.sleep(GUARD_STEP_S)

        return guard

    def _attempt(self, claim: Claim, keeper: LeaseKeeper, prefix: str) -> dict[str, Any]:
        guard, workers = self._guard_of(keeper, waits=True), self._settings.transfers
        laps, self._peak_bytes = Laps(), None
        stage = self._registry.get_stage(claim.name)
        with self._database.read_scope() as session:
            work = stage_work(session, claim)
        workspace = Workspace(self._work_dir / claim.job_id)
        end_predecessor(workspace.root, stage.name, claim.token)
        self._check_disk(stage, work, workspace)
        write_job_file(workspace, work)
        if self._is_near_the_capture(stage):
            fetch_capture(self._store, workspace, work, guard)
        fetch_inputs(self._store, workspace, stage.reads, work, guard, workers=workers)
        restore_checkpoint(
            self._store, workspace, stage.name, work.checkpoint_prefix, guard, workers=workers
        )
        laps.end("fetch_s")
        reached("run.fetched")
        uploader = CheckpointUploader(
            self._database, self._store, claim, self._lease_guard(keeper), workers=workers
        )
        finish = False
        try:
            manifest = self._run_in_process(stage, claim, keeper, work, workspace, uploader, laps)
        except (StageFailedError, StageCrashedError, StopRunError):
            finish = not (keeper.lost.is_set() or keeper.cancel_requested.is_set())
            raise
        finally:
            limit_s = self._settings.cancel_grace_s if self._shutdown.is_set() else CHECKPOINT_END_S
            uploader.close(finish=finish, timeout_s=limit_s)
        reached("run.done")
        folder = workspace.stage(stage.name)
        publish_folder(
            self._store,
            folder,
            prefix,
            guard,
            lambda: keeper.report(1.0, "the object store is full: waiting for room", None),
            workers=workers,
            expected=manifest["files"],
        )
        laps.end("store_s")
        return {**manifest, "timings": {**manifest["timings"], **laps.seconds}}

    def _check_disk(self, stage: Stage, work: StageWork, workspace: Workspace) -> None:
        """Refuse to begin what cannot end: what it still lacks, and room to write, must fit."""
        wants_capture = self._is_near_the_capture(stage)
        needed = missing_bytes(workspace, stage.reads, work, wants_capture=wants_capture)
        needed += self._settings.min_free_bytes
        free = free_bytes(self._work_dir)
        if free < needed:
            raise disk_too_small(stage.name, free, needed)

    def _lease_guard(self, keeper: LeaseKeeper) -> Callable[[], None]:
        """A checkpoint is worth keeping also when the worker shuts down."""

        def guard() -> None:
            if keeper.lost.is_set() or keeper.cancel_requested.is_set():
                raise LostLeaseError("the stage is cancelled, or no longer ours")

        return guard

    def _is_near_the_capture(self, stage: Stage) -> bool:
        """Whether the stage gets the uploaded bytes: it reads nothing, or only such stages."""
        return all(not self._registry.get_stage(name).reads for name in stage.reads)

    @property
    def contained(self) -> Containment | None:
        """What holds this slot's stages in, as its process says; None while there is none."""
        process = self._process
        return None if process is None else process.contained

    def _ensure_process(self) -> StageProcess:
        process = self._process
        if process is None or not process.is_alive() or not process.is_in_place():
            self.close()
            process = StageProcess(self._registry_name, self._plan, self._preload)
            self._process = process
        return process

    def _run_in_process(
        self,
        stage: Stage,
        claim: Claim,
        keeper: LeaseKeeper,
        work: StageWork,
        workspace: Workspace,
        uploader: CheckpointUploader,
        laps: Laps,
    ) -> dict[str, Any]:
        process, pulse = self._ensure_process(), Pulse()
        temporary = workspace.temporary(stage.name)
        threads = int(os.environ.get("OMP_NUM_THREADS") or self._threads())
        if work.ran_out_of_memory:
            keeper.log("Memory ran out before: this attempt takes less, and longer.")

        def on_line(line: str) -> None:
            pulse.beat()
            keeper.log(line)

        try:
            process.start_run(
                f"{claim.token}-{claim.stage_id}",
                on_line,
                do="run",
                stage=stage.name,
                token=claim.token,
                options=work.options,
                root=str(workspace.root),
                seed=work.seed,
                threads=max(threads // 2, 1) if work.ran_out_of_memory else threads,
                memory="small" if work.ran_out_of_memory else "full",
                cpu_s=stage.time_limit_s * num_cores(),
                temporary=str(temporary),
            )
            return self._follow(process, stage, keeper, workspace, uploader, laps, pulse)
        except BrokenPipeError:
            raise crash_of(stage.name, *process.exit_reason()) from None
        except StageCrashedError:
            self.close()  # also where memory ran out and the process lives: it gives it back
            raise
        except StageFailedError as error:
            if error.error["code"] in ("internal_error", "gpu_lost"):
                self.close()  # its state cannot be trusted, or its GPU answers it no more
            if not workspace.job_file.is_file():  # somebody deleted the folder under it
                raise StageFailedError({**error.error, "retryable": True}) from error
            raise
        finally:
            process.finish_log(LOG_END_S if process.is_alive() else 0.0)
            if left := process.end_leftovers():
                _log.warning("%s: ended %d processes that it left", claim.stage_id, left)
            if not process.is_alive():
                self.close()
            shutil.rmtree(temporary, ignore_errors=True)

    def _follow(
        self,
        process: StageProcess,
        stage: Stage,
        keeper: LeaseKeeper,
        workspace: Workspace,
        uploader: CheckpointUploader,
        laps: Laps,
        pulse: Pulse,
    ) -> dict[str, Any]:
        """Take the process's messages until the stage has ended, or must."""
        guard = self._guard_of(keeper, waits=False)
        deadline = time.monotonic() + stage.time_limit_s
        while True:
            try:
                guard()
            except StopRunError as stop:
                self._stop(process, stop.reason, workspace, stage, uploader)
                raise
            if time.monotonic() > deadline:
                process.kill()
                raise time_limit_of(stage.name, stage.time_limit_s)
            self._peak_bytes = process.peak_bytes() or self._peak_bytes
            message, is_sign = self._next_message(process, pulse)
            if pulse.silent_s() > stage.stall_s:
                process.kill()
                raise stalled_of(stage.name, stage.stall_s)
            kind = message.get("type")
            if kind == "progress":
                keeper.report(
                    message["fraction"], message["message"], message["eta_s"], moved=is_sign
                )
            elif kind == "checkpoint":
                uploader.offer(snapshot_of(workspace, stage.name, message))
            elif kind == "begun":
                laps.end("start_s")
                reached("run.begun")
            elif kind == "done":
                laps.end("run_s")
                manifest: dict[str, Any] = message["manifest"]
                return manifest
            elif kind == "failed":
                raise failed_of(stage.name, message["error"], process.memory_ran_out())
            elif kind == "cancelled":
                raise gave_up_of(stage.name)  # where we had asked, `_stop` took the message
            elif kind == "exit":
                raise crash_of(stage.name, *process.exit_reason())

    @staticmethod
    def _next_message(process: StageProcess, pulse: Pulse) -> tuple[dict[str, Any], bool]:
        """What the process says next, and whether it is a sign of life; empty where it is silent.

        It may repeat itself without a pause and get on no more: that is silence, too.
        """
        try:
            message: dict[str, Any] = process.messages.get(timeout=MESSAGE_STEP_S)
        except queue.Empty:
            return {}, False
        return message, pulse.notice(message)

    def _stop(
        self,
        process: StageProcess,
        reason: str,
        workspace: Workspace,
        stage: Stage,
        uploader: CheckpointUploader,
    ) -> None:
        """Ask the stage to stop; kill it, and what it started, where it does not in time.

        A checkpoint that it still saves is kept where the uploader's guard lets it.
        """
        process.ask_to_stop(reason)
        deadline = time.monotonic() + self._settings.cancel_grace_s
        while (left := deadline - time.monotonic()) > 0:
            try:
                message = process.messages.get(timeout=left)
            except queue.Empty:
                break
            if message["type"] == "checkpoint":
                uploader.offer(snapshot_of(workspace, stage.name, message))
            elif message["type"] in ("done", "failed", "cancelled", "exit"):
                return
        self.close()

    def _record_of(self, claim: Claim, error: Exception, prefix: str) -> Callable[[Session], Any]:
        """The operation that records how an attempt ended. prefix: for what it says of that."""
        if isinstance(error, StopRunError):
            if error.reason == "lost":
                return lambda session: _raise(LostLeaseError(claim.stage_id))
            if error.reason == "shutdown":
                return lambda session: release_stage(session, claim)
            return lambda session: cancel_stage(session, claim)
        if self._store_watch.explains(error):
            _log.warning("%s: given back, the object store is away: %s", claim.stage_id, error)
            away = failure_of(claim.name, error)
            return lambda session: release_stage(session, claim, error=away)
        if isinstance(error, StageCrashedError):
            crash = error
            _log.warning("%s: %s", claim.stage_id, crash.error["message"])
            said = self._publish_failure(claim, crash.error, prefix)
            end = RunEnd(crash.cause, crash.error, crash.exit_code, self._peak_bytes)
            return lambda session: crash_stage(session, claim, end, report=said)
        if isinstance(error, StageFailedError):
            failure = error.error
        else:
            _log.error("%s: the attempt broke off", claim.stage_id, exc_info=error)
            failure = failure_of(claim.name, error)
        retryable = bool(failure.pop("retryable", False))
        report = self._publish_failure(claim, failure, prefix)
        return lambda session: fail_stage(
            session,
            claim,
            failure,
            retryable=retryable,
            report=report,
            peak_bytes=self._peak_bytes,
        )

    def _publish_failure(
        self, claim: Claim, error: dict[str, Any], prefix: str
    ) -> FailureReport | None:
        return publish_failure(self._database, self._store, claim, self._work_dir, error, prefix)

    def _record(self, operation: Callable[[Session], Result]) -> Result:
        """Run a closing operation until the database answers: it can be repeated.

        Raises what the operation raises, the database's own refusal; UnknownOutcomeError where the
        worker ends first, or the database fails in another way for as long as a lease lasts.
        """
        deadline = time.monotonic() + self._settings.lease_s
        while True:
            try:
                with self._database.session_scope(step="finish") as session:
                    return operation(session)
            except SQLAlchemyError as error:
                _log.warning("the end of a stage waits for the database: %s", error)
                given_up = not is_away(error) and time.monotonic() > deadline
                if given_up or self._shutdown.wait(RECORD_STEP_S):
                    raise UnknownOutcomeError from error

    def _discard(self, claim: Claim, prefix: str, keep: str | None = None) -> None:
        """Delete what attempts that do not count have uploaded, up to this one.

        What a later claim writes stays: this worker may have slept while the job was retried.
        """
        try:
            for key in list(self._store.list(prefix)):
                token = keys.token_of(key)
                is_later = token is not None and token > claim.token
                if not is_later and (keep is None or not key.startswith(keep)):
                    self._store.delete(key)
        except StorageError as error:
            _log.warning("left behind below %s: %s", prefix, error)


def _raise(error: Exception) -> None:
    raise error
