"""A zip of photos: decoded, turned upright, stripped of metadata, in their natural order."""

from __future__ import annotations

from pathlib import Path

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.pictures import PictureWriter, natural_key, store_all
from pipelines.captures.record import Found
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.stage import StageContext


def read(path: Path, options: IngestOptions, ctx: StageContext) -> Found:
    """Write `images/` from the archive at `path`.

    Raises CaptureError: no_images, too_large, too_few_images, image_undecodable, and those of
    `CaptureArchive`.
    """
    limits = ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes)
    with CaptureArchive(path, limits) as archive:
        names = sorted(archive.images, key=natural_key)
        if not names:
            raise CaptureError(
                "The archive has no pictures.",
                code="no_images",
                hint="Put the photos (JPEG, PNG or WebP) into the .zip.",
            )
        if len(names) > options.max_images:
            raise CaptureError(
                f"The archive has {len(names)} pictures; {options.max_images} are allowed.",
                code="too_large",
                hint="Send fewer pictures, or raise ingest.max_images.",
            )
        writer = PictureWriter(archive, ctx.out, max_pixels=options.max_pixels, upright=True)
        try:
            pictures, warnings = store_all(
                writer,
                names,
                lambda done: ctx.progress(done / len(names), f"Photo {done} of {len(names)}"),
            )
        finally:
            writer.close()
    sizes = sorted({(picture.width, picture.height) for picture in pictures.values()})
    return Found(
        images=[picture.as_dict() for picture in pictures.values()],
        details={"num_sizes": len(sizes), "largest": list(max(sizes))},
        warnings=warnings,
    )
