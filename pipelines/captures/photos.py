"""Photos without poses: chosen, decoded, turned upright, in order; panoramas cut into views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pipelines.captures.archive_rules import shown
from pipelines.captures.common_parts import mask_common_parts
from pipelines.captures.contents import Photos
from pipelines.captures.minimum import MIN_IMAGES
from pipelines.captures.panorama_files import EQUIRECTANGULAR, FOLDER, write_views
from pipelines.captures.photo_choice import choose_photos
from pipelines.captures.photo_masks import PhotoMasks, find_masks
from pipelines.captures.pictures import JPEG_QUALITY, Picture, PictureWriter
from pipelines.captures.record import Found
from pipelines.captures.storing import store_each
from pipelines.captures.turntable import TURNTABLE_NOTE, cut_turntable
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.scene.natural_order import natural_key
from pipelines.scene.panoramas import is_whole
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
    masks = find_masks(archive, names, options.masks, options.max_pixels, ctx, upright=True)
    pictures, warnings = store_each(
        archive,
        [_Photo(name) for name in sorted(names, key=natural_key)],
        partial(_store, ctx.out, options, masks),
        options,
        ctx,
        upright=True,
        minimum=MIN_IMAGES,
    )
    cuts = {}
    if not any(one.mask or one.cut or one.views for one in pictures):
        cuts = cut_turntable(ctx.out, [one.file for one in pictures], JPEG_QUALITY, ctx)
    pictures = [replace(one, cut=cuts.get(one.file, one.cut)) for one in pictures]
    plain = [one for one in pictures if not (one.mask or one.cut or one.views)]
    common = mask_common_parts(ctx.out, plain, ctx)
    pictures = [replace(one, mask=common.masks.get(one.file, one.mask)) for one in pictures]
    sizes = sorted({(picture.width, picture.height) for picture in pictures})
    return Found(
        images=[picture.as_dict() for picture in pictures],
        details={
            "num_sizes": len(sizes),
            "largest": list(max(sizes)),
            **masks.details(),
            **common.details(),
            **({"num_turned": len(cuts)} if cuts else {}),
        },
        warnings=warnings + common.warnings() + ([TURNTABLE_NOTE] if cuts else []),
    )


def _store(
    out: Path,
    options: IngestOptions,
    masks: PhotoMasks,
    writer: PictureWriter,
    photo: _Photo,
    number: int,
) -> Picture:
    masks.check(photo.name)
    picture = writer.store(photo.name, number, masks.of.get(photo.name), masks.meaning)
    told = options.projection == EQUIRECTANGULAR
    if options.projection == "flat" or not (told or picture.projection == EQUIRECTANGULAR):
        return picture
    if not is_whole(picture.width, picture.height):
        if not told:
            return picture
        raise CaptureError(
            f'The picture "{shown(photo.name)}" is {picture.width}x{picture.height}; a panorama of '
            "the whole sphere is twice as wide as high.",
            code="image_undecodable",
            hint="Leave the picture out, or set ingest.projection to auto.",
        )
    for beside in (picture.mask, picture.cut):
        if beside is not None:
            (out / beside).unlink()
    (out / FOLDER).mkdir(exist_ok=True)
    panorama = f"{FOLDER}/{picture.file.rpartition('/')[2]}"
    (out / picture.file).rename(out / panorama)
    views = write_views(out / panorama, out, f"{number:05d}", options.panorama_views)
    return replace(picture, file=panorama, views=tuple(views), mask=None, cut=None)
