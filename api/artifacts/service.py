"""Artifacts: the files that the registry names, where their stages published them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from fastapi import Request

from api.artifacts.schemas import ArtifactView
from api.deps import Services
from api.problems import MissingError
from pipelines.registry import STAGES, get_stage
from pipelines.stage import CAPTURE_PAGE, CAPTURE_REPORT, REPORT, Artifact
from storage.models import Job, StageRow
from storage.objects_local import LocalObjectStore
from storage.results import is_offered

_OF_FAILURES = {
    found.path: found
    for name in ("report", "check")
    for found in get_stage(name).artifacts
    if found.path in (REPORT, CAPTURE_REPORT, CAPTURE_PAGE)
}
"""What a job that failed offers, although the stages that make it did not succeed."""
_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})


@dataclass(frozen=True)
class Published:
    """An artifact that is there. key: in the object store."""

    artifact: Artifact
    key: str
    bytes: int
    sha256: str


def published(job: Job) -> Iterator[Published]:
    """What the job's stages have made; of a job that failed, its reports, too.

    Of a stage that a retry did not make anew, what it had made before; but what went wrong is said
    by the report of the failure alone. The job is loaded with its manifests.
    """
    rows = {row.name: row for row in job.stages}
    reports = {found.artifact.path: found for found in _of_failure(job, rows)}
    there: set[str] = set()
    for stage in STAGES:
        row = rows.get(stage.name)
        if row is None or not is_offered(row) or not row.output_prefix or not row.manifest:
            continue
        files = {entry["path"]: entry for entry in row.manifest["files"]}
        for artifact in stage.artifacts:
            entry = files.get(artifact.path)
            if entry is not None and not (artifact.path == REPORT and REPORT in reports):
                key = row.output_prefix + artifact.path
                there.add(artifact.name)
                yield Published(artifact, key, entry["bytes"], entry["sha256"])
    yield from (found for found in reports.values() if found.artifact.name not in there)


def _of_failure(job: Job, rows: Mapping[str, StageRow]) -> Iterator[Published]:
    failed = rows.get(str((job.error or {}).get("stage")))
    if failed is None or not failed.report_prefix:
        return
    for entry in failed.report_files or []:
        known = _OF_FAILURES.get(entry["path"])
        if known is not None:
            key = failed.report_prefix + known.path
            yield Published(known, key, entry["bytes"], entry["sha256"])


def find(job: Job, name: str) -> Published:
    """One artifact by name. Raises MissingError."""
    for found in published(job):
        if found.artifact.name == name:
            return found
    stages = STAGES
    if job.parent_id is not None:
        stages = tuple(stage for stage in STAGES if stage.name in {row.name for row in job.stages})
    makers = {artifact.name: stage.name for stage in stages for artifact in stage.artifacts}
    on_request = {one.name for stage in STAGES for one in stage.artifacts if one.on_request}
    if name not in makers:
        what = "job" if job.parent_id is None else "export of this kind"
        hint = f"A finished {what} has {', '.join(sorted(makers))}."
    elif any(row.name == makers[name] and row.state == "skipped" for row in job.stages):
        hint = f"A job with preset {job.preset} on such a capture skips {makers[name]}."
    elif name in on_request:
        hint = f"It is made only where the options of {makers[name]} ask for it."
    else:
        hint = f"The job is {job.state}; wait until the stage that makes it has succeeded."
    raise MissingError(f"Job {job.id} has no such artifact.", code="artifact_not_found", hint=hint)


def signed_url(services: Services, found: Published, request: Request) -> str:
    """A URL that anyone can download the artifact from, for a while.

    A local store signs for `public_url`; where that is a loopback address, which only this machine
    could use, the address that the client came by takes its place.
    """
    url = services.store.signed_url(
        found.key,
        expires_s=services.settings.url_expires_s,
        filename=found.artifact.name,
        media_type=found.artifact.media_type,
        sha256=found.sha256,
    )
    if isinstance(services.store, LocalObjectStore):
        public = services.settings.public_url.rstrip("/")
        if urlsplit(public).hostname in _LOOPBACK:
            return str(request.base_url).rstrip("/") + url.removeprefix(public)
    return url


def list_of(services: Services, job: Job, request: Request) -> list[ArtifactView]:
    """What a job, loaded with its manifests, offers for download."""
    return [
        ArtifactView(
            name=found.artifact.name,
            media_type=found.artifact.media_type,
            bytes=found.bytes,
            sha256=found.sha256,
            url=signed_url(services, found, request),
            opens_with=found.artifact.opens_with,
        )
        for found in published(job)
    ]
