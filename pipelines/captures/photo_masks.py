"""Masks that lie beside photos: which is whose, and what is meant by them.

Programs write a picture of black and white for each photo, in a folder called masks or under the
photo's name with that word (`roles`); white is what counts, in COLMAP, Metashape and nerfstudio
alike. Two things are meant by it:

- cut_out: the thing is white, and all around it, up to the borders, is black: the thing is wanted,
  and nothing else. Such photos become cut-out pictures, white around the thing, as if they had come
  so: a thing on a turntable before a room that stands still has no other poses;
- ignore: black hides what moved or must not be seen. The pixels are not looked at, by nobody.
"""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import PIL.Image
import PIL.ImageOps
from numpy.typing import NDArray

from pipelines.captures.archive_rules import shown
from pipelines.captures.decoders import DAMAGED, open_picture
from pipelines.captures.exif import read_exif
from pipelines.captures.photo_choice import header_of
from pipelines.captures.roles import named_role, plain_stem
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.stage import StageContext

Meaning = Literal["cut_out", "ignore"]

_MOST_BYTES = 256 << 20
_LOOK_PX = 256
_BLACK, _WHITE = 48, 207
"""Of 255: JPEG moves the values of a picture of black and white."""
_BINARY_SHARE = 0.9
"""Of the pixels of a reduced mask; the others lie on edges, which reducing blurs."""
_MOSTLY = 0.9
"""Share of the photos that have a mask, from which on those without may be left out."""
_BORDER = 0.02
"""Width of a picture's border, of its side."""
_BLACK_BORDER = 0.75
"""Share of the border that is black in the median cut-out: what hides people who walk by, or the
sky, leaves more of it."""
_CUT_OUT_SHARES = (0.01, 0.8)
"""How much of the median cut-out the thing takes."""
_ASPECT_SLACK = 0.02
_FIRST_ON_ITS_SIDE = 5
"""EXIF orientations from here on exchange width and height."""


@dataclass(frozen=True)
class PhotoMasks:
    """of: each photo's mask, both by their names in the archive; none of a capture without."""

    of: Mapping[str, str]
    meaning: Meaning

    def check(self, photo: str) -> None:
        """Raise CaptureError image_undecodable for a photo that is not cut out as the others are:
        what is around the thing would stand in it alone."""
        if self.meaning == "cut_out" and photo not in self.of:
            raise CaptureError(
                f'"{shown(photo)}" has no mask, and the others are cut out by theirs.',
                code="image_undecodable",
                hint="Send a mask of the same name for each photo; ingest.masks=off leaves them.",
            )

    def details(self) -> dict[str, object]:
        """For the record."""
        return {"num_masks": len(self.of), "masks": self.meaning} if self.of else {}


NO_MASKS = PhotoMasks({}, "ignore")


@dataclass(frozen=True)
class _Look:
    """A mask, reduced. white: where it is, [h, w]."""

    size: tuple[int, int]
    white: NDArray[np.bool_]

    @property
    def share(self) -> float:
        return float(self.white.mean())

    @property
    def border(self) -> float:
        """Share of the border that is black."""
        height, width = self.white.shape
        wide = max(1, round(_BORDER * max(height, width)))
        inner = np.zeros_like(self.white)
        inner[wide : height - wide, wide : width - wide] = True
        return float((~self.white[~inner]).mean())


def find_masks(
    archive: CaptureArchive,
    photos: Sequence[str],
    wanted: Literal["auto", "cut_out", "ignore", "off"],
    max_pixels: int,
    ctx: StageContext,
    *,
    upright: bool,
) -> PhotoMasks:
    """The masks of photos, by their names; none where there are none that say anything.

    wanted: what is meant by them, "auto" for what they look like. max_pixels: masks with more are
    not decoded. upright: whether the photos will be turned, as in `pictures.PictureWriter`.
    """
    if wanted == "off":
        return NO_MASKS
    looks: dict[str, _Look] = {}
    named = _named(archive, photos)
    for done, (photo, mask) in enumerate(named.items(), start=1):
        look = _look(archive, mask, max_pixels)
        if look is not None and _fits(archive, photo, look, upright=upright):
            looks[photo] = look
        ctx.progress(0.0, f"Looking at mask {done} of {len(named)}")
    if not looks or all(look.white.all() for look in looks.values()):
        return NO_MASKS
    meaning: Meaning = "ignore" if wanted == "auto" else wanted
    if wanted == "auto" and _cuts_out(list(looks.values()), len(photos)):
        meaning = "cut_out"
    return PhotoMasks({photo: named[photo] for photo in looks}, meaning)


def _named(archive: CaptureArchive, photos: Sequence[str]) -> dict[str, str]:
    """Each photo's mask, where its name alone says whose it is."""
    masks: dict[str, list[str]] = defaultdict(list)
    for name in sorted(archive.images - set(photos)):
        if named_role(name) == "masks":
            masks[plain_stem(name)].append(name)
    of: dict[str, list[str]] = defaultdict(list)
    for photo in photos:
        of[plain_stem(photo)].append(photo)
    return {
        names[0]: masks[stem][0]
        for stem, names in of.items()
        if len(names) == 1 and len(masks.get(stem, ())) == 1
    }


def _look(archive: CaptureArchive, name: str, max_pixels: int) -> _Look | None:
    """A mask reduced; None where it is no picture of black and white."""
    try:
        data = io.BytesIO(archive.peek(name, _MOST_BYTES))
        with open_picture(data, archive.image_format(name)) as image:
            size = image.size
            if size[0] * size[1] > max_pixels:
                return None
            image.draft("L", (_LOOK_PX, _LOOK_PX))
            grey = image.convert("L")
            grey.thumbnail((_LOOK_PX, _LOOK_PX), PIL.Image.Resampling.BOX)
    except DAMAGED:
        return None
    values = np.asarray(grey)
    if ((values <= _BLACK) | (values >= _WHITE)).mean() < _BINARY_SHARE:
        return None
    return _Look(size, values >= 128)


def _fits(archive: CaptureArchive, photo: str, look: _Look, *, upright: bool) -> bool:
    """Whether `fitted` will have the mask in its photo's shape."""
    try:
        with open_picture(header_of(archive, photo), archive.image_format(photo)) as image:
            orientation = read_exif(image).orientation if upright else None
            turned = _turned(image.size, orientation)
            return alike(look.size, turned) or (
                orientation not in (None, 1) and alike(look.size, image.size)
            )
    except DAMAGED:
        return False


def _turned(size: tuple[int, int], orientation: int | None) -> tuple[int, int]:
    """A photo's size once it is turned as EXIF says."""
    return (size[1], size[0]) if (orientation or 1) >= _FIRST_ON_ITS_SIDE else size


def alike(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have the same shape."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1) <= _ASPECT_SLACK


def _cuts_out(looks: Sequence[_Look], num_photos: int) -> bool:
    """Whether masks leave one thing of their photos, and nothing around it."""
    least, most = _CUT_OUT_SHARES
    return (
        len(looks) >= _MOSTLY * num_photos
        and float(np.median([look.border for look in looks])) >= _BLACK_BORDER
        and least <= float(np.median([look.share for look in looks])) <= most
    )


def fitted(
    mask: PIL.Image.Image, size: tuple[int, int], orientation: int | None, *, upright: bool
) -> PIL.Image.Image | None:
    """A mask as one channel, in the size and turn that its photo is written in; None where it has
    another shape.

    size, orientation: the photo's, as it is stored. upright: whether the photo is turned. A mask
    may lie there turned, as most programs write them, or as the photo is stored; of a square photo
    it is taken for turned.
    """
    grey = mask.convert("L")
    orientation = orientation if upright else None
    target = _turned(size, orientation)
    if alike(grey.size, target):
        return _resized(grey, target)
    if orientation not in (None, 1) and alike(grey.size, size):
        stored = _resized(grey, size)
        stored.getexif()[0x0112] = orientation
        return PIL.ImageOps.exif_transpose(stored)
    return None


def _resized(grey: PIL.Image.Image, size: tuple[int, int]) -> PIL.Image.Image:
    return grey if grey.size == size else grey.resize(size, PIL.Image.Resampling.BILINEAR)


def cut_out(rgb: PIL.Image.Image, mask: PIL.Image.Image) -> PIL.Image.Image:
    """A picture on white, where its mask, of one channel and the same size, is white."""
    steep = mask.point(
        [
            round(255 * min(max((value - _BLACK) / (_WHITE - _BLACK), 0.0), 1.0))
            for value in range(256)
        ]
    )
    white = PIL.Image.new("RGB", rgb.size, (255, 255, 255))
    white.paste(rgb, mask=steep)
    return white
