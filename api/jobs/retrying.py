"""A job once more: what of it still holds, and what is run again."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy.orm import Session

from api.jobs.exportable import check_exportable
from api.jobs.schemas import RetryRequest
from api.problems import ConflictedError, FieldProblem, InvalidRequestError, MissingError
from pipelines.exports.requests import resolve_export
from pipelines.manifest import fingerprint
from pipelines.options import OptionsError, revise_options
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, get_stage
from storage import jobs
from storage.damage import damaged_results
from storage.exports import live_exports
from storage.models import Job, StageRow
from storage.results import is_offered


def _holds(row: StageRow, rows: Mapping[str, StageRow], options: dict[str, Any], seed: int) -> bool:
    """Whether a stage would make what it has made: same version, options, inputs and seed."""
    made = row.manifest
    if not is_offered(row) or made is None or row.name not in STAGE_NAMES:
        return False
    if row.fingerprint is None or "inputs" not in made:
        return False
    inputs: dict[str, dict[str, Any]] = {}
    for name, content in made["inputs"].items():
        found = rows[name].manifest if name in rows else {"content": content}  # else the upload
        if not found or "content" not in found:
            return False
        inputs[name] = found
    wanted = fingerprint(get_stage(row.name), options, inputs, seed=seed)
    return wanted == row.fingerprint


def stages_to_redo(
    job: Job,
    options: dict[str, dict[str, Any]],
    from_stage: str | None = None,
    damaged: Collection[str] = (),
) -> list[str]:
    """The stages whose results do not hold with these options, in order, and all behind them.

    from_stage: one that is run again in any case. damaged: so are those, whose results are not in
    the object store as they were put there. What failed is, too, unless other options than it
    failed with are those of what it had made before. An export reads what its job has made.
    """
    rows = {row.name: row for row in (*(job.parent.stages if job.parent else ()), *job.stages)}
    behind: set[str] = set()  # what is run again, and skipped stages that only pass it on
    redo = []
    for row in job.stages:
        waits = not behind.isdisjoint(row.after)
        wanted = options.get(row.name, {})
        if row.state == "skipped":
            behind |= {row.name} if waits else set()
        elif (
            waits
            or row.name == from_stage
            or row.name in damaged
            or (row.state == "failed" and wanted == job.options.get(row.name, {}))
            or not _holds(row, rows, wanted, job.seed)
        ):
            behind.add(row.name)
            redo.append(row.name)
    return redo


def _reads_the_capture(name: str) -> bool:
    """Whether a stage is given the uploaded bytes: it reads nothing, or only such stages."""
    return all(not get_stage(earlier).reads for earlier in get_stage(name).reads)


def _stages_that_run(job: Job) -> set[str]:
    return {row.name for row in job.stages if row.state != "skipped"}


def _revised(job: Job, changes: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The options with some changed, of a job or of an export, whose job must still be trained."""
    if job.parent is not None:
        check_exportable(job.parent)
        (kind,) = job.options
        wrong = [(name, f"this is an export of kind {kind}") for name in changes if name != kind]
        given = changes.get(kind, {})
        if not isinstance(given, dict):
            wrong.append((kind, "expected an object of options"))
        if wrong:
            raise OptionsError(wrong)
        return {kind: resolve_export(kind, job.preset, job.options[kind], given)}
    if job.preset not in PRESETS:
        raise ConflictedError(
            f"The job's preset {job.preset} is no more.",
            code="preset_unknown",
            hint="Start a new job on the capture.",
        )
    return revise_options(job.preset, job.options, changes)


def _check_nobody_reads(session: Session, job: Job, redo: list[str]) -> None:
    """Raise ConflictedError where an export that is not over reads what would be made anew."""
    for export in live_exports(session, job.id):
        (stage,) = export.stages
        if not set(redo).isdisjoint(get_stage(stage.name).reads):
            raise ConflictedError(
                f"The job's export {export.id} ({stage.name}) is {export.state}, and reads what "
                "would be made anew.",
                hint="Wait until it has ended, or cancel it.",
            )


def retry(session: Session, job_id: str, wanted: RetryRequest) -> list[str]:
    """Put a job that is over into the queue again. Ids of the stages that can start.

    One that did not succeed, and whose every result holds all the same, has succeeded thereby.
    Raises NotFoundError, ConflictError (it is not over), ConflictedError (nothing is to be done),
    MissingError (the capture is gone and needed), InvalidRequestError, OptionsError.
    """
    job = jobs.open_for_retry(session, job_id)
    options = _revised(job, wanted.options)
    from_stage = None if wanted.from_stage is None else str(wanted.from_stage)
    if from_stage is not None and from_stage not in _stages_that_run(job):
        raise InvalidRequestError(
            f"The job has no stage {from_stage}: its capture or its preset has no use for it.",
            code="stage_skipped",
            errors=[FieldProblem(path="from_stage", detail="a stage that the job has")],
        )
    redo = stages_to_redo(job, options, from_stage, damaged_results(session, job))
    if not redo and job.state == "succeeded":
        raise ConflictedError(
            "Every result of the job holds: there is nothing to do again.",
            code="nothing_to_retry",
            hint="Change an option, or name the stage to begin with in from_stage.",
        )
    _check_nobody_reads(session, job, redo)
    if job.capture.deleted_at is not None and any(map(_reads_the_capture, redo)):
        raise MissingError(
            "The job's capture was deleted, and the job needs it again.",
            code="capture_deleted",
            hint="Upload the capture again and start a new job.",
        )
    return jobs.retry_job(
        session, job, redo, options, changes=wanted.options, from_stage=from_stage
    )
