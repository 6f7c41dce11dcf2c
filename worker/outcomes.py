"""How an attempt can end other than well: exceptions inside the runner, and what people read."""

from __future__ import annotations

import errno
import signal
from typing import Any

from pipelines.errors import PipelineError, ResourceError
from storage.damage import CAPTURE, INPUT_DAMAGED
from storage.errors import ObjectMissingError, ObjectStoreError, ObjectStoreFullError
from worker.locks import FolderInUseError


class UnknownOutcomeError(Exception):
    """The database did not say whether it recorded the end of an attempt: nothing may be deleted,
    for the row may name it. What nothing names is swept up later."""


class StopRunError(Exception):
    """The attempt must stop: `reason` is "cancel", "lost" or "shutdown"."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class StageFailedError(Exception):
    """The stage ended with an error of its own: `{code, message, hint, retryable, details}`."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(str(error.get("code")))
        self.error = error


class StageCrashedError(Exception):
    """The stage's process died, or was ended. cause: one of `storage.leases.CAPS`, which says how
    often that may happen. exit_code: of the process, negative for a signal; None while it lives."""

    def __init__(self, cause: str, error: dict[str, Any], exit_code: int | None = None) -> None:
        super().__init__(str(error["code"]))
        self.cause = cause
        self.error = error
        self.exit_code = exit_code


class InputDamagedError(ObjectStoreError):
    """What a stage reads is missing from the object store, or is not what is on record.

    name: the stage that made it, or CAPTURE. of_parent: whether that is a stage of the job that an
    export is of.
    """

    def __init__(self, name: str, reason: str, *, of_parent: bool = False) -> None:
        super().__init__(reason)
        self.name = name
        self.of_parent = of_parent


def _out_of_memory(stage: str) -> dict[str, Any]:
    return ResourceError(
        f"Memory ran out during {stage}: the system stopped it.",
        code="out_of_memory",
        hint="Use a smaller preset, or fewer or smaller images, or a larger machine.",
    ).as_dict()


def failed_of(
    stage: str, error: dict[str, Any], memory_ran_out: bool
) -> StageCrashedError | StageFailedError:
    """What a stage's own error means. memory_ran_out: the kernel killed something for it meanwhile.

    A program that a stage started and the kernel killed for memory is the stage's lack of memory.
    """
    if error["code"] == "out_of_memory":
        return StageCrashedError("out_of_memory", error)
    if memory_ran_out and (error.get("details") or {}).get("exit_code") == -signal.SIGKILL:
        return StageCrashedError("out_of_memory", _out_of_memory(stage))
    return StageFailedError(error)


def crash_of(stage: str, status: int, out_of_memory: bool) -> StageCrashedError:
    """What an exit status of the stage's process means.

    status: as subprocess gives it, negative for a signal.
    """
    if out_of_memory:
        return StageCrashedError("out_of_memory", _out_of_memory(stage), status)
    if status == -signal.SIGXCPU:
        spent = PipelineError(
            f"The stage {stage} used all the processor time that it may.",
            code="time_limit",
            hint="Use a smaller preset, or a faster machine.",
        )
        return StageCrashedError("time_limit", spent.as_dict(), status)
    if status in (-signal.SIGKILL, 128 + signal.SIGKILL, -signal.SIGTERM):
        error = ResourceError(
            f"The process that ran {stage} was killed from outside.",
            code="worker_lost",
            hint="Look at the worker's log and the machine's memory; then retry the job.",
        )
        return StageCrashedError("killed", error.as_dict(), status)
    how = f"signal {-status}" if status < 0 else f"status {status}"
    fault = PipelineError(
        f"The process that ran {stage} broke down ({how}).",
        code="stage_crashed",
        hint="This is a fault of the service: see the job's logs for the last lines before it.",
    )
    return StageCrashedError("crashed", fault.as_dict(), status)


def time_limit_of(stage: str, limit_s: float) -> StageCrashedError:
    """The stage ran for too long."""
    error = PipelineError(
        f"The stage {stage} did not end within {limit_s:.0f} seconds.",
        code="time_limit",
        hint="Use a smaller preset, or a faster machine.",
    )
    return StageCrashedError("time_limit", error.as_dict())


def stalled_of(stage: str, silent_s: float) -> StageCrashedError:
    """The stage's process lives, and nothing happens."""
    error = PipelineError(
        f"The stage {stage} did nothing for {silent_s:.0f} seconds.",
        code="stalled",
        hint="Look at the job's logs for the step that hangs; then retry the job.",
    )
    return StageCrashedError("stalled", error.as_dict())


def gave_up_of(stage: str) -> StageFailedError:
    """The stage stopped as one that was cancelled does, and nobody had asked it to."""
    error = PipelineError(
        f"The stage {stage} gave up, though nobody had cancelled it.",
        code="internal_error",
        hint="This is a fault of the service: see the job's logs for the last lines before it.",
        retryable=True,
    )
    return StageFailedError(error.as_dict())


def disk_too_small(stage: str, free: int, needed: int) -> StageFailedError:
    """There is no room for what the stage reads and writes."""
    error = ResourceError(
        f"The worker's disk has {free / 2**30:.1f} GiB free; {stage} needs {needed / 2**30:.1f}.",
        code="disk_full",
        hint="Free some space on the worker's disk; then retry the job.",
    )
    return StageFailedError(error.as_dict())


def folder_in_use(stage: str) -> dict[str, Any]:
    """Another process works in the stage's folder on this machine."""
    return ResourceError(
        f"Another process still runs {stage} in the same folder.",
        code="folder_in_use",
        hint="Look at the worker's log for a process that does not end; then retry the job.",
    ).as_dict()


def _input_damaged(stage: str, error: InputDamagedError) -> dict[str, Any]:
    """Trying again can help: another machine may still have the files."""
    if error.name == CAPTURE:
        what = "The capture"
        hint = "Upload the same file again, which replaces what is stored; then retry the job."
    elif error.of_parent:
        what = f"What {error.name} made"
        hint = f"Retry the export's job, which runs {error.name} again; then retry the export."
    else:
        what, hint = f"What {error.name} made", f"Retry the job, which runs {error.name} again."
    return PipelineError(
        f"{what} is missing or damaged in the object store, and {stage} needs it.",
        code=INPUT_DAMAGED,
        hint=hint,
        retryable=True,
        details={"input": error.name},
    ).as_dict()


def failure_of(stage: str, error: BaseException) -> dict[str, Any]:
    """What an exception in the worker around the stage means, as an error of the stage."""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    if full or isinstance(error, ObjectStoreFullError):
        return ResourceError(
            f"The disk is full: the files of {stage} could not be stored.",
            code="disk_full",
            hint="Free some space on the worker's disk or the object store; then retry the job.",
        ).as_dict()
    if isinstance(error, FolderInUseError):
        return folder_in_use(stage)
    if isinstance(error, InputDamagedError):
        return _input_damaged(stage, error)
    if isinstance(error, ObjectMissingError):
        return PipelineError(
            f"A file that {stage} needs is no longer stored.",
            code="input_missing",
            hint="Retry the job.",
            retryable=True,
        ).as_dict()
    if isinstance(error, ObjectStoreError):
        return ResourceError(
            f"The object store did not answer while {stage} moved its files.",
            code="object_store_unavailable",
            hint="Check the object store; then retry the job.",
        ).as_dict()
    return PipelineError(
        f"The worker failed around {stage} with {type(error).__name__}.",
        code="internal_error",
        hint="This is a fault of the service: see the worker's log.",
        retryable=True,
    ).as_dict()
