"""Stage `ingest`: what was sent, checked, and its pictures and poses in our own form.

Writes `capture.json` (always), `images/` (photos and app exports), `masks/`, `depth/` and
`cameras.json` (captures with poses), `points.ply` (where sparse points came with those). A video
stays where it is: `frames` reads the upload, also where it is a .zip of several.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.catalogue import importer_of, load_reader
from pipelines.captures.clips import read_film, read_films
from pipelines.captures.contents import PosedPictures
from pipelines.captures.leftovers import as_details, leftover_warnings, leftovers
from pipelines.captures.photos import write_photos
from pipelines.captures.posed import write_posed
from pipelines.captures.record import CaptureRecord, Found
from pipelines.captures.sniff import Sniffed, sniff
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.exports.formats.ply import write_points
from pipelines.manifest import file_sha256
from pipelines.options import IngestOptions
from pipelines.stage import StageContext
from pipelines.workspace import SPARSE_POINTS


def run(options: IngestOptions, ctx: StageContext) -> dict[str, Any]:
    """Check and unpack the upload. Returns the summary for the report.

    Raises CaptureError with one of the codes listed at that class.
    """
    path = ctx.workspace.capture_file
    if not path.is_file():
        raise CaptureError(
            "There is no uploaded file in the job's folder.",
            code="capture_missing",
            hint="Upload the capture, or name it with --input.",
        )
    filename = _filename(ctx)
    ctx.progress(0.0, "Looking at the file")
    found_kind = sniff(path, filename, ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes))
    found = _read(found_kind, path, options, ctx)
    if found.points is not None:
        write_points(ctx.out / SPARSE_POINTS, found.points.places, found.points.colors)
    record = CaptureRecord(
        kind=found_kind.kind,
        filename=filename,
        sha256=file_sha256(path),
        num_images=len(found.images),
        video=found.video,
        images=found.images,
        details=found.details,
        warnings=found.warnings,
        clips=found.clips,
    )
    record.save(ctx.out)
    for warning in record.warnings:
        ctx.logger.warning("%s", warning)
    ctx.progress(1.0, f"{record.kind}: {_what(record)}")
    return {
        "kind": record.kind,
        "filename": record.filename,
        "num_images": record.num_images,
        **record.details,
        "warnings": record.warnings,
    }


def _read(sniffed: Sniffed, path: Path, options: IngestOptions, ctx: StageContext) -> Found:
    """What is in the upload, checked and written, with a word on what was not used."""
    importer = importer_of(sniffed.kind)
    if importer.brings == "film":
        return (read_film if sniffed.kind == "video" else read_films)(path, options, ctx)
    limits = ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes)
    with CaptureArchive(path, limits) as archive:
        contents = load_reader(importer)(archive, sniffed.claim)
        try:
            if isinstance(contents, PosedPictures):
                found = write_posed(archive, contents, sniffed.kind, options, ctx)
            else:
                found = write_photos(archive, contents, options, ctx)
        except CaptureError as error:
            if error.code not in ("too_few_images", "no_images"):
                raise
            raise _with_leftovers(error, archive) from error
        left = leftovers(archive)
    return Found(
        images=found.images,
        details={**found.details, **as_details(left)},
        warnings=found.warnings + leftover_warnings(left),
        points=found.points,
    )


def _with_leftovers(error: CaptureError, archive: CaptureArchive) -> CaptureError:
    """The error that too few pictures are left, and what became of the others."""
    told = leftover_warnings(leftovers(archive))
    return CaptureError(
        " ".join([error.message, *told]),
        code=error.code,
        hint=error.hint,
        details={**error.details, "not_used": told},
    )


def _filename(ctx: StageContext) -> str:
    """What the sender called the file; a label only."""
    if not ctx.workspace.job_file.is_file():
        return "capture"
    job = json.loads(ctx.workspace.job_file.read_text("utf-8"))
    return str(job.get("filename", "capture"))


def _what(record: CaptureRecord) -> str:
    if record.video is None:
        return f"{record.num_images} pictures"
    return f"{record.video['num_frames']} frames, {record.video['duration_s']:.1f} s"
