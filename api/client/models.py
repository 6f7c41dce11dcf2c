"""What the client returns and raises. No server code: pydantic alone.

NerfworksError
  ConnectionFailed      the service cannot be reached, or none is configured
  ApiProblem            the service answered with an error: status, code, message, hint
  JobFailed             a job that was waited for did not succeed
  WaitTimedOut          a job is not over after the time that was given
  FilesInTheWay         a download would take the place of other files
  ChecksumMismatch      downloaded bytes are not those that the service promised
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

TERMINAL = frozenset({"succeeded", "failed", "cancelled"})


class _Model(BaseModel):
    """Fields that a newer service adds are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class Capture(_Model):
    """An uploaded capture."""

    id: str
    filename: str
    kind: str
    bytes: int
    sha256: str
    details: dict[str, Any]
    created_at: datetime


class Stage(_Model):
    """One stage of a job. progress: 0 to 1. eta_s: seconds left, where known."""

    name: str
    state: str
    progress: float
    eta_s: float | None
    attempt: int
    message: str
    progress_at: datetime | None = None
    started_at: datetime | None
    finished_at: datetime | None


class JobPlan(_Model):
    """What a job would be. options: complete, of every stage. without: stages it skips."""

    preset: str
    preset_reason: str
    options: dict[str, Any]
    labels: dict[str, str]
    without: list[str]


class JobError(_Model):
    """Why a job failed, and what to do."""

    code: str
    message: str
    hint: str
    stage: str | None = None
    details: dict[str, Any] = Field(default_factory=dict)


class Check(_Model):
    """How a capture was filmed. verdict: good, usable, poor, unusable, or None where nobody knows.

    reasons: what decides it. advice: what to do next time, the most useful first.
    """

    verdict: str | None
    reasons: list[str]
    advice: list[str]


class Artifact(_Model):
    """A file that a job offers. url: signed, good for a short while, needs no key."""

    name: str
    media_type: str
    bytes: int
    sha256: str
    url: str
    opens_with: str = ""


class Export(_Model):
    """What an export is of. job_id: of the job that was trained. result: what it says it made."""

    kind: str
    job_id: str
    result: dict[str, Any] | None = None


class ExportKind(_Model):
    """A kind of export. options: JSON Schema. artifacts: what it may write, by name."""

    kind: str
    summary: str
    version: int
    on_request: bool
    artifacts: list[dict[str, Any]]
    options: dict[str, Any]


class Job(_Model):
    """A job, or an export of another one (`export`).

    `artifacts` and `queue_position` are filled by `get_job`, not in lists.
    """

    id: str
    state: str
    generation: int = 1
    preset: str
    preset_reason: str
    options: dict[str, Any]
    labels: dict[str, str]
    capture_id: str
    export: Export | None = None
    stages: list[Stage]
    metrics: dict[str, float | int | None] | None
    assets: dict[str, Any] | None = None
    check: Check | None = None
    error: JobError | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    queue_position: int | None = None
    artifacts: list[Artifact] = Field(default_factory=list)

    @property
    def is_over(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.state in TERMINAL


class Preset(_Model):
    """A complete, named set of options. without: stages that its jobs skip."""

    name: str
    summary: str
    options: dict[str, Any]
    without: list[str] = Field(default_factory=list)


class Presets(_Model):
    """The presets, and the one that a job gets which names none."""

    items: list[Preset]
    default: str
    default_reason: str


class Event(_Model):
    """Something that happened to a job. kind: "job.STATE" or "stage.STATE"."""

    seq: int
    created_at: datetime
    kind: str
    stage: str | None
    actor: str
    reason: str
    data: dict[str, Any]


class LogPage(_Model):
    """Lines of a job. next: the number of the line after the last one here."""

    lines: list[str]
    first: int
    next: int
    total: int


class NerfworksError(Exception):
    """The root of what the client raises. message: what failed. hint: what to do."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".strip()


class ConnectionFailed(NerfworksError):
    """The service cannot be reached, or none is configured."""


class ApiProblem(NerfworksError):
    """The service answered with an error. errors: (dotted path, what is wrong) of each value."""

    def __init__(
        self,
        status: int,
        code: str,
        message: str,
        hint: str = "",
        errors: tuple[tuple[str, str], ...] = (),
    ) -> None:
        super().__init__(message, hint)
        self.status = status
        self.code = code
        self.errors = errors


class JobFailed(NerfworksError):
    """A job did not succeed."""

    def __init__(self, job: Job) -> None:
        error = job.error
        message = f"Job {job.id} {job.state}." if error is None else error.message
        super().__init__(message, "" if error is None else error.hint)
        self.job = job


class WaitTimedOut(NerfworksError):
    """A job is not over yet; it goes on. job: as it was last seen; None where no answer came."""

    def __init__(self, job_id: str, job: Job | None, timeout_s: float) -> None:
        self.job = job
        if job is None:
            super().__init__(
                f"The service said nothing of job {job_id} within {timeout_s:.0f} s.",
                "The job goes on; wait again.",
            )
            return
        stages = [f"{s.name} at {s.progress:.0%}" for s in job.stages if s.state == "running"]
        at = f" ({', '.join(stages)})" if stages else ""
        super().__init__(
            f"Job {job.id} is {job.state}{at} after {timeout_s:.0f} s.", "It goes on; wait again."
        )


class FilesInTheWay(NerfworksError):
    """A download would take the place of files that are another job's, or nobody knows whose."""


class ChecksumMismatch(NerfworksError):
    """Downloaded bytes are not those that the service promised."""
