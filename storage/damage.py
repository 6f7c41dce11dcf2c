"""Stored bytes that a stage found missing or damaged: how its error says so, and who asks.

A worker ends the stage with the code INPUT_DAMAGED and `details["input"]`: the stage whose result
it was, or CAPTURE. A retry runs that stage again; an upload of the same bytes puts them once more.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from storage.models import Capture, Job, StageRow

INPUT_DAMAGED = "input_damaged"
CAPTURE = "capture"


def damaged_input(error: Mapping[str, Any] | None) -> str | None:
    """What a stage's error says was damaged: a stage's name, or CAPTURE; None for another error."""
    if not error or error.get("code") != INPUT_DAMAGED:
        return None
    name: str | None = (error.get("details") or {}).get("input")
    return name


def damaged_results(session: Session, job: Job) -> set[str]:
    """The job's stages whose results a stage has found damaged, one of it or of an export of it,
    and that were not made anew since."""
    found = {name for row in job.stages if (name := damaged_input(row.error)) is not None}
    made_at = {row.name: row.finished_at for row in job.stages}
    exports = select(StageRow.error, StageRow.finished_at).join(Job, Job.id == StageRow.job_id)
    for error, when in session.execute(
        exports.where(Job.parent_id == job.id, StageRow.state == "failed")
    ):
        name = damaged_input(error)
        made = made_at.get(name or "")
        if name is not None and made is not None and when is not None and made < when:
            found.add(name)
    return found


def is_found_damaged(session: Session, blob_id: str) -> bool:
    """Whether a stage on a capture of these bytes ended so, and has not begun anew since."""
    query = (
        select(StageRow.id)
        .join(Job, Job.id == StageRow.job_id)
        .join(Capture, Capture.id == Job.capture_id)
        .where(
            Capture.blob_id == blob_id,
            StageRow.error["code"].as_string() == INPUT_DAMAGED,
            StageRow.error[("details", "input")].as_string() == CAPTURE,
        )
    )
    return session.scalar(query.limit(1)) is not None
