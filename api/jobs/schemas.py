"""What the API takes and says about jobs."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from api.artifacts.schemas import ArtifactView
from api.ids import CaptureId, JsonObject, Labels
from pipelines.registry import STAGE_NAMES
from storage.models import Job, StageRow

_METRICS = ("psnr", "ssim", "lpips", "num_images", "width", "height")
_CHECK = ("verdict", "reasons", "advice")
_ASSETS = ("mesh", "cloud", "depth", "depth_agreement", "warnings")

JobState = Literal["queued", "running", "succeeded", "failed", "cancelling", "cancelled"]
StageState = Literal["blocked", "ready", "running", "succeeded", "failed", "cancelled", "skipped"]
StageName = StrEnum("StageName", {name: name for name in STAGE_NAMES})  # type: ignore[misc]


class JobWish(BaseModel):
    """What to make of a capture, whichever."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "preset": "preview",
                    "options": {"train": {"max_steps": 500}},
                    "labels": {"project": "garden"},
                }
            ]
        },
    )

    preset: str | None = Field(
        None, max_length=64, description="A name from /v1/presets; left out: the service chooses."
    )
    options: JsonObject = Field(
        default_factory=dict, description="{stage: {option: value}}, laid over the preset."
    )
    labels: Labels = Field(default_factory=dict, description="Free text to find the job by.")


class JobRequest(JobWish):
    """What to make of a capture."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "capture_id": "019a5c0f1e2b0123456789abcdef",
                    "preset": "preview",
                    "options": {"train": {"max_steps": 500}},
                    "labels": {"project": "garden"},
                }
            ]
        },
    )

    capture_id: CaptureId


class JobPlan(BaseModel):
    """What a job would be, as far as that can be said without its capture."""

    preset: str
    preset_reason: str = Field(description="Why this preset: asked for, or chosen because of ...")
    options: dict[str, Any] = Field(description="The complete options of every stage.")
    labels: dict[str, str]
    without: list[str] = Field(
        description="Stages that the preset skips; a capture may have no use for others."
    )


class CheckRequest(BaseModel):
    """How to check a capture: with the options and labels of a job with preset `check`."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{}, {"options": {"poses": {"min_registered_ratio": 0.5}}}],
        },
    )

    options: JsonObject = Field(
        default_factory=dict, description="{stage: {option: value}}, laid over preset `check`."
    )
    labels: Labels = Field(default_factory=dict, description="Free text to find the job by.")


class RetryRequest(BaseModel):
    """What to do differently when a job is run again."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {},
                {"from_stage": "mesh"},
                {"options": {"train": {"max_steps": 4000}}},
            ]
        },
    )

    from_stage: StageName | None = Field(
        None, description="Begin with this stage even where its result would hold."
    )
    options: JsonObject = Field(
        default_factory=dict, description="{stage: {option: value}}, laid over the job's options."
    )


class JobErrorView(BaseModel):
    """Why a job failed: what failed, on what, what to do."""

    code: str
    message: str
    hint: str
    stage: str | None = Field(None, description="The stage that failed.")
    details: dict[str, Any] = Field(default_factory=dict)


class CheckView(BaseModel):
    """How the capture was filmed; `capture-report.json` has the whole."""

    verdict: Literal["good", "usable", "poor", "unusable"] | None = Field(
        description="null where the job ended too early to say, and not for what the capture is."
    )
    reasons: list[str] = Field(description="What was measured that decides it.")
    advice: list[str] = Field(description="What to do next time, the most useful first.")


class StageView(BaseModel):
    """One stage of a job."""

    model_config = ConfigDict(from_attributes=True)

    name: str
    state: StageState
    progress: float = Field(description="From 0 to 1.")
    eta_s: float | None = Field(description="Seconds left, as far as that is known.")
    attempt: int = Field(description="Which try this is; 0 before the first.")
    message: str = Field(description="What it is doing.")
    progress_at: datetime | None = Field(description="When it last got on.")
    started_at: datetime | None
    finished_at: datetime | None


class ExportView(BaseModel):
    """What an export is of."""

    kind: str
    job_id: str = Field(description="The job whose trained scene it exports.")
    result: dict[str, Any] | None = Field(
        description="What it says of what it made, once it has: counts, sizes, bounds."
    )


class JobSummary(BaseModel):
    """A job, or an export, as it stands in a list."""

    id: str
    state: JobState
    generation: int = Field(description="1, and one more with every retry.")
    preset: str
    preset_reason: str = Field(description="Why this preset: asked for, or chosen because of ...")
    options: dict[str, Any] = Field(description="The complete options of every stage.")
    labels: dict[str, str]
    capture_id: str
    export: ExportView | None = Field(
        description="Of a job that exports what another one trained; null for a job on a capture."
    )
    stages: list[StageView]
    metrics: dict[str, float | int | None] | None = Field(
        description="Held-out quality, once measured: psnr in dB, ssim, num_images, width, height."
    )
    assets: dict[str, Any] | None = Field(
        description="The delivered mesh and cloud against held-out photos, once measured: mesh and "
        "cloud {coverage, psnr, ssim, psnr_with_holes}, warnings [{code, message, hint}]."
    )
    check: CheckView | None = Field(
        None, description="How the capture was filmed, once that is known; also of a failed job."
    )
    error: JobErrorView | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    cancel_requested_at: datetime | None

    @staticmethod
    def fields_of(job: Job) -> dict[str, Any]:
        """The values of a loaded record."""
        return {
            "id": job.id,
            "state": job.state,
            "generation": job.generation,
            "preset": job.preset,
            "preset_reason": job.preset_reason,
            "options": job.options,
            "labels": job.labels,
            "capture_id": job.capture_id,
            "export": export_of(job),
            "stages": [StageView.model_validate(row) for row in job.stages],
            "metrics": metrics_of(job.stages),
            "assets": assets_of(job.stages),
            "check": check_of(job),
            "error": None if job.error is None else JobErrorView.model_validate(job.error),
            "created_at": job.created_at,
            "started_at": job.started_at,
            "finished_at": job.finished_at,
            "cancel_requested_at": job.cancel_requested_at,
        }

    @classmethod
    def of(cls, job: Job) -> JobSummary:
        """The view of a record."""
        return cls(**cls.fields_of(job))


class JobView(JobSummary):
    """A job."""

    queue_position: int | None = Field(
        description="1 is served next; 300 means so many or more; null once it runs."
    )
    artifacts: list[ArtifactView] = Field(description="What can be downloaded so far.")


class JobPage(BaseModel):
    """A page of jobs, newest first."""

    items: list[JobSummary]
    next_cursor: str | None = Field(description="Give it as `cursor` for the next page.")


class EventView(BaseModel):
    """Something that happened to a job."""

    model_config = ConfigDict(from_attributes=True)

    seq: int = Field(description="Rises with every event of the service.")
    created_at: datetime
    kind: str = Field(description='"job.STATE" or "stage.STATE": the state that was entered.')
    stage: str | None
    actor: str = Field(description='Who: "worker:...", "reaper:...", "api-key:ID" or "service".')
    reason: str = Field(description="Why, in a word or an error's code; may be empty.")
    data: dict[str, Any] = Field(description="The state before (`was`), attempt, outcome, error.")


class EventPage(BaseModel):
    """Events of a job, oldest first."""

    items: list[EventView]
    next: int | None = Field(description="Give it as `after` for what follows; null: no more yet.")


class LogView(BaseModel):
    """Lines that the stages wrote."""

    lines: list[str]
    first: int = Field(description="The number of the first line here; the first of all is 0.")
    next: int = Field(description="Give it as `line` to go on from here.")
    total: int = Field(description="Lines there are so far.")


def export_of(job: Job) -> ExportView | None:
    """What a job exports, None where it is no export."""
    if job.parent_id is None:
        return None
    (stage,) = job.stages
    made = stage.summary if stage.state == "succeeded" else None
    return ExportView(kind=stage.name, job_id=job.parent_id, result=made)


def metrics_of(stages: list[StageRow]) -> dict[str, float | int | None] | None:
    """Held-out quality from the evaluation's summary, or None before there is one."""
    for row in stages:
        if row.name == "evaluate" and row.state == "succeeded" and row.summary:
            return {key: row.summary[key] for key in _METRICS if key in row.summary}
    return None


def assets_of(stages: list[StageRow]) -> dict[str, Any] | None:
    """How mesh and cloud compare with photos, or None before that is known."""
    for row in stages:
        if row.name == "assess" and row.state == "succeeded" and row.summary:
            return {key: row.summary[key] for key in _ASSETS if key in row.summary}
    return None


def check_of(job: Job) -> dict[str, Any] | None:
    """How the capture was filmed, from its check, or else from what a failed stage said of it."""
    for row in job.stages:
        told = row.summary or {}
        # A worker of another version may have told less.
        if row.name == "check" and row.state == "succeeded" and set(_CHECK) <= set(told):
            return {key: told[key] for key in _CHECK}
    found: dict[str, Any] | None = (job.error or {}).get("details", {}).get("check")
    return found
