"""Which jobs have something to export."""

from __future__ import annotations

from collections.abc import Mapping

from api.problems import ConflictedError
from storage.models import Job
from storage.results import fitting

TRAINING = "train"
_WHY_NOT: Mapping[str, str] = {
    "skipped": "its preset {preset} trains nothing",
    "failed": "its training failed",
    "cancelled": "its training was cancelled",
}


def check_exportable(job: Job) -> None:
    """Raise ConflictedError (not_trained) where a job has no trained scene to export.

    One that a retry was to train anew, and did not, counts with what it was trained on.
    """
    if job.parent_id is not None:
        raise ConflictedError(
            f"Job {job.id} is itself an export.",
            code="not_trained",
            hint=f"Ask for exports of the job that it is of, {job.parent_id}.",
        )
    if TRAINING in fitting(job.stages):
        return
    state = next((row.state for row in job.stages if row.name == TRAINING), "skipped")
    why = _WHY_NOT.get(state, "its training has not ended yet")
    hint = "Wait until its stage train has succeeded."
    if state in _WHY_NOT:
        hint = "Retry the job, or start another one that trains on its capture."
    raise ConflictedError(
        f"Job {job.id} has nothing to export: {why.format(preset=job.preset)}.",
        code="not_trained",
        hint=hint,
    )
