"""Photos without poses: chosen, decoded, turned upright, in their natural order."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.captures.contents import Photos
from pipelines.captures.minimum import MIN_IMAGES
from pipelines.captures.photo_choice import choose_photos
from pipelines.captures.pictures import Picture, PictureWriter
from pipelines.captures.record import Found
from pipelines.captures.storing import store_each
from pipelines.captures.unpack import CaptureArchive
from pipelines.options import IngestOptions
from pipelines.scene.natural_order import natural_key
from pipelines.stage import StageContext


@dataclass(frozen=True)
class _Photo:
    name: str


def write_photos(
    archive: CaptureArchive, capture: Photos, options: IngestOptions, ctx: StageContext
) -> Found:
    """Write `images/` from those pictures that are photos.

    Raises CaptureError: no_images where none is, and as `storing.store_each` does.
    """
    names = choose_photos(archive, capture.names, options.max_pixels, ctx)
    pictures, warnings = store_each(
        archive,
        [_Photo(name) for name in sorted(names, key=natural_key)],
        _store,
        options,
        ctx,
        upright=True,
        minimum=MIN_IMAGES,
    )
    sizes = sorted({(picture.width, picture.height) for picture in pictures})
    return Found(
        images=[picture.as_dict() for picture in pictures],
        details={"num_sizes": len(sizes), "largest": list(max(sizes))},
        warnings=warnings,
    )


def _store(writer: PictureWriter, photo: _Photo, number: int) -> Picture:
    return writer.store(photo.name, number)
