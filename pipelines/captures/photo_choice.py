"""Which pictures of an archive are photos: what else lies beside them is set aside, with a reason.

Five things tell, in this order:

1. takes: a photo that lies there as camera raw and developed, or as HEIC and JPEG, is taken once,
   where both were taken at one time, or show the same: another phone may have used the name.
2. channels: beside colour photos, a lossless picture of one channel is a mask, a depth or a
   confidence map. Where no picture has colour, grey ones are photos unless their name says what
   else they are.
3. values: pictures of a few flat colours are masks or label maps. Only those that are packed far
   smaller than photos are decoded for it.
4. names: folders and files called mask, depth, conf, thumbnail and the like (`roles`), which speak
   only where photos remain beside them.
5. copies: the same picture again, in the same size or reduced (`images_2/`, `images_4/`), edited,
   or as a messenger sent it; decided by comparing what they show, not by folder or name.

What cannot be decoded stays, for whoever writes the pictures to report.
"""

from __future__ import annotations

import io
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import PIL.ExifTags
import PIL.Image
import PIL.ImageOps
from numpy.typing import NDArray

from pipelines.captures.decoders import DAMAGED, open_picture
from pipelines.captures.exif import read_exif
from pipelines.captures.photo_copies import LOOK_PX, Candidate, copies_among
from pipelines.captures.raw_photos import FORMAT as RAW
from pipelines.captures.roles import (
    file_role,
    folder_role,
    named_role,
    original_stem,
    plain_stem,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.stage import StageContext

_HEADER_BYTES = 256 << 10
_MOST_BYTES = 256 << 20
_HEADED = frozenset({"JPEG", "PNG", "WEBP"})
"""Formats whose first bytes say what a picture is; of others the directory may lie at the end."""
_OF_CAMERAS = frozenset({"JPEG", "HEIF", "AVIF", RAW})
"""Formats that cameras write photos in, and nobody writes numbers in that must not change."""
_FEW_COLORS = 32
_FLAT_BYTES_PER_PIXEL = {
    "JPEG": 0.1,
    "PNG": 0.25,
    "WEBP": 0.1,
    "HEIF": 0.05,
    "AVIF": 0.05,
    "TIFF": 0.25,
    RAW: 0.0,
}
"""Pictures of few flat colours are packed smaller; photos are only where they are very empty."""
_HEADER_ALLOWANCE_BYTES = 2048
_FLAT_LOOK_PX = 256
_NEAR = 12
"""How far, of 255, JPEG moves the values of a picture of black and white."""
_BINARY_SHARE = 0.98
"""Of the pixels; the others lie on the edges, which a reduced picture blurs."""

_ASPECT_SLACK = 0.02
_COMPARED_PX = 48
_COPY_DIFFERENCE = 3.0
"""Mean difference in brightness, of 255, of reduced pictures that show the same. On real photos a
copy at an eighth of the size comes to 0.7 to 2.8, by its filter; a view a hundredth of the picture
aside to 6 and more."""
_ORIENTATION = PIL.ExifTags.Base.Orientation
_FIRST_ON_ITS_SIDE = 5
"""EXIF orientations from here on exchange width and height."""
_SAME_TAKE = 0.9
"""Correlation in brightness, reduced, of a raw and the photo developed from it, which may be
brighter and have other contrast."""


@dataclass(frozen=True)
class _Look:
    """What a picture's header says. width, height: of the picture turned upright. taken_at: as in
    `Exif`."""

    name: str
    kind: str
    mode: str
    width: int
    height: int
    taken_at: str | None = None

    @property
    def num_pixels(self) -> int:
        return self.width * self.height

    @property
    def is_deep(self) -> bool:
        """Whether a value has more than 8 bits."""
        return self.mode.startswith(("I", "F"))

    @property
    def has_color(self) -> bool:
        return self.mode not in ("1", "L", "LA", "La") and not self.is_deep


def choose_photos(
    archive: CaptureArchive, names: Sequence[str], max_pixels: int, ctx: StageContext
) -> list[str]:
    """Those of the pictures that are photos. The others are set aside in the archive.

    max_pixels: pictures with more are not decoded here. Raises CaptureError no_images where no
    photo is left.
    """
    looks = []
    unreadable = []
    for done, name in enumerate(sorted(names), start=1):
        look = _look(archive, name)
        if look is None:
            unreadable.append(name)
        else:
            looks.append(look)
        ctx.progress(0.0, f"Looking at picture {done} of {len(names)}")
    images = _Images(archive, max_pixels)
    looks = _once_each(archive, looks, images)
    looks = _by_channels(archive, looks)
    looks = _by_values(archive, looks, images)
    looks = _by_names(archive, looks)
    looks = _without_copies(archive, looks, images, ctx)
    if names and not looks and not unreadable:
        raise CaptureError(
            f"The archive has {len(names)} pictures, and none of them is a photo.",
            code="no_images",
            hint="Send the photos; masks, depth and confidence maps are not needed.",
        )
    return [look.name for look in looks] + unreadable


def header_of(archive: CaptureArchive, name: str) -> io.BytesIO:
    """As much of a picture as it takes to open it, not to decode it."""
    headed = archive.image_format(name) in _HEADED
    return io.BytesIO(archive.peek(name, _HEADER_BYTES if headed else _MOST_BYTES))


def _look(archive: CaptureArchive, name: str) -> _Look | None:
    kind = archive.image_format(name)
    try:
        with open_picture(header_of(archive, name), kind) as image:
            found = RAW if image.format == RAW else kind
            sides = image.size
            exif = read_exif(image)
            if (exif.orientation or 1) >= _FIRST_ON_ITS_SIDE:
                sides = sides[1], sides[0]
            return _Look(name, found, image.mode, *sides, exif.taken_at)
    except DAMAGED:
        return None


class _Images:
    """Decodes pictures of the archive to look at them, small where the format allows it."""

    def __init__(self, archive: CaptureArchive, max_pixels: int) -> None:
        self._archive = archive
        self._max_pixels = max_pixels

    def decoded(self, look: _Look, near_px: int) -> PIL.Image.Image | None:
        """The picture upright in RGB, or None where it does not decode or has too many pixels.

        near_px: a JPEG is decoded at the smallest size that is no smaller, a raw at half of its.
        """
        if look.num_pixels > self._max_pixels:
            return None
        try:
            data = io.BytesIO(self._archive.peek(look.name, _MOST_BYTES))
            with open_picture(data, look.kind) as image:
                image.draft("RGB", (near_px, near_px))
                return PIL.ImageOps.exif_transpose(image).convert("RGB")
        except DAMAGED:
            return None

    def brightness(
        self, look: _Look, side_px: int, shape: float | None = None
    ) -> NDArray[np.float32] | None:
        """Brightness of the upright picture, or of its middle of that shape (width by height),
        squeezed to a square; None as `decoded`."""
        if look.num_pixels > self._max_pixels:
            return None
        try:
            data = io.BytesIO(self._archive.peek(look.name, _MOST_BYTES))
            with open_picture(data, look.kind) as image:
                width, height = image.size
                image.draft("RGB", (2 * side_px, 2 * side_px))
                # A JPEG that was decoded smaller is padded: sides are rounded up.
                scale = max(1, round(width / image.width))
                exif = image.getexif()
                if shape is not None and exif.get(_ORIENTATION, 1) >= _FIRST_ON_ITS_SIDE:
                    shape = 1 / shape
                across, down = _middle(width / height, shape)
                right, below = min(width / scale, image.width), min(height / scale, image.height)
                left, top = right * (1 - across) / 2, below * (1 - down) / 2
                plain = image.convert("RGB" if image.mode == "P" else "L").convert("L")
                square = plain.resize(
                    (side_px, side_px),
                    PIL.Image.Resampling.LANCZOS,
                    box=(left, top, right - left, below - top),
                )
                square.info["exif"] = exif.tobytes()
                return np.asarray(PIL.ImageOps.exif_transpose(square), np.float32)
        except DAMAGED:
            return None


def _once_each(archive: CaptureArchive, looks: Sequence[_Look], images: _Images) -> list[_Look]:
    """The pictures without those that are the same take as another one of that name and folder.

    Phones and cameras write a raw and the photo that they developed from it, and apps an HEIC and
    a JPEG. Developed ones are preferred to raw, then larger ones, then HEIC to what was made of it.
    """
    takes: dict[str, list[_Look]] = defaultdict(list)
    for look in looks:
        if look.kind in _OF_CAMERAS:
            takes[look.name.rpartition(".")[0].lower()].append(look)
    raw: list[str] = []
    others: list[str] = []
    for take in takes.values():
        best = min(take, key=lambda look: (look.kind == RAW, -look.num_pixels, look.kind == "JPEG"))
        for look in take:
            if look.kind != best.kind and _is_one_take(look, best, images):
                (raw if look.kind == RAW else others).append(look.name)
    archive.set_aside(raw, "the same photo lies there developed")
    archive.set_aside(others, "the same photo lies there in another format")
    return _without(looks, [*raw, *others])


def _is_one_take(look: _Look, best: _Look, images: _Images) -> bool:
    """Whether two pictures of one name are one photo: two phones give the same names.

    What cannot be decoded is taken for the same: nothing is lost with it.
    """
    if look.taken_at is not None and look.taken_at == best.taken_at:
        return True
    # Cameras that are set to 16:9 or square develop the middle of what they keep as raw.
    shape = best.width / best.height
    seen = [images.brightness(item, _COMPARED_PX, shape) for item in (look, best)]
    if seen[0] is None or seen[1] is None:
        return True
    return _correlation(seen[0], seen[1]) >= _SAME_TAKE


def _middle(own: float, wanted: float | None) -> tuple[float, float]:
    """Of a picture's width and height the shares that its middle of another shape has."""
    if wanted is None or max(own, wanted) <= (1 + _ASPECT_SLACK) * min(own, wanted):
        return 1.0, 1.0
    return min(1.0, wanted / own), min(1.0, own / wanted)


def _correlation(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    first, second = first - first.mean(), second - second.mean()
    spread = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return float((first * second).sum()) / spread if spread > 0 else 0.0


def _by_channels(archive: CaptureArchive, looks: Sequence[_Look]) -> list[_Look]:
    if any(look.has_color for look in looks):
        # Cameras write grey photos too, as JPEG; maps, whose values count, are never lossy.
        out = [look for look in looks if not look.has_color and look.kind not in _OF_CAMERAS]
    else:
        out = [look for look in looks if named_role(look.name) is not None]
    deep = [look.name for look in out if look.is_deep]
    archive.set_aside(deep, "one channel of 16 bits or more, as depth maps have")
    archive.set_aside(
        [look.name for look in out if not look.is_deep],
        "one channel, as masks and confidence maps have",
    )
    return _without(looks, [look.name for look in out])


def _by_values(archive: CaptureArchive, looks: Sequence[_Look], images: _Images) -> list[_Look]:
    out = [
        look.name
        for look in looks
        if archive.num_bytes(look.name) - _HEADER_ALLOWANCE_BYTES
        < _FLAT_BYTES_PER_PIXEL[look.kind] * look.num_pixels
        and (image := images.decoded(look, near_px=_FLAT_LOOK_PX)) is not None
        and _is_flat(image)
    ]
    archive.set_aside(out, "a few flat colours, as masks and label maps have")
    return _without(looks, out)


def _is_flat(image: PIL.Image.Image) -> bool:
    """Whether a picture has a handful of colours, or black and white alone.

    It takes both: an object may well lie small on a white table.
    """
    if image.getcolors(_FEW_COLORS) is not None:
        return True
    values = np.asarray(image)
    black = (values <= _NEAR).all(axis=-1).mean()
    white = (values >= 255 - _NEAR).all(axis=-1).mean()
    return bool(min(black, white) > 1 - _BINARY_SHARE and black + white >= _BINARY_SHARE)


def _by_names(archive: CaptureArchive, looks: Sequence[_Look]) -> list[_Look]:
    in_folders = _folders_beside_photos(looks)
    photos = {plain_stem(look.name) for look in looks if named_role(look.name) is None}
    out = []
    for look in looks:
        folder, own = folder_role(look.name), file_role(look.name)
        if folder in in_folders:
            archive.set_aside([look.name], f"in a folder for {folder}")
        elif own and _has_partner(look.name, photos):
            archive.set_aside([look.name], f"named as {own}")
        else:
            continue
        out.append(look.name)
    return _without(looks, out)


def _folders_beside_photos(looks: Sequence[_Look]) -> set[str]:
    """What folders say that pictures are, as far as there are photos beside those.

    Who films a mask may well call the folder so; half as many photos elsewhere are asked for.
    """
    by_role = Counter(folder_role(look.name) for look in looks)
    return {role for role, count in by_role.items() if role and 2 * by_role[None] >= count}


def _has_partner(name: str, photos: set[str]) -> bool:
    """Whether a photo has the same name but for the word, or, of mere numbers, the same number."""
    stem = plain_stem(name)
    return stem in photos or (
        stem.isdigit()
        and any(photo.lstrip("abcdefghijklmnopqrstuvwxyz") == stem for photo in photos)
    )


def _without_copies(
    archive: CaptureArchive, looks: Sequence[_Look], images: _Images, ctx: StageContext
) -> list[_Look]:
    """The pictures without those that show the same as another, of equal size or larger."""
    by_bytes = _groups(
        looks, lambda look: (archive.checksum(look.name), archive.num_bytes(look.name))
    )
    out = [look.name for group in by_bytes for look in group[1:]]
    archive.set_aside(out, "the same picture again")
    looks = _without(looks, out)
    reduced = []
    for group in _groups(looks, lambda look: plain_stem(look.name)):
        ctx.check_cancelled()
        reduced += _copies(group, images)
    archive.set_aside(reduced, "a copy of a larger or equal picture")
    looks = _without(looks, reduced)
    named_otherwise = _copies_under_any_name(looks, images, ctx)
    archive.set_aside(named_otherwise, "an edited, sent or reduced copy of another photo")
    return _without(looks, named_otherwise)


def _copies_under_any_name(looks: Sequence[_Look], images: _Images, ctx: StageContext) -> list[str]:
    """Names of the copies. The largest is kept, of several as large one that says when it was
    taken, then the one of most bytes; raw last."""
    order = sorted(
        looks,
        key=lambda look: (look.kind == RAW, -look.num_pixels, look.taken_at is None, look.name),
    )

    def look_at(number: int) -> NDArray[np.float32] | None:
        ctx.check_cancelled()
        ctx.progress(0.0, f"Looking for copies, {number + 1} of {len(order)}")
        return images.brightness(order[number], LOOK_PX)

    photos = [
        Candidate(look.width / look.height, look.taken_at, original_stem(look.name))
        for look in order
    ]
    return [order[number].name for number in copies_among(photos, look_at)]


def _groups(looks: Iterable[_Look], key: Callable[[_Look], object]) -> list[list[_Look]]:
    """Pictures of equal key, groups of one left out, the largest first in each, raw last."""
    found: dict[object, list[_Look]] = defaultdict(list)
    for look in looks:
        found[key(look)].append(look)
    return [
        sorted(
            group,
            key=lambda look: (look.kind == RAW, -look.num_pixels, look.name.count("/"), look.name),
        )
        for group in found.values()
        if len(group) > 1
    ]


def _copies(group: Sequence[_Look], images: _Images) -> list[str]:
    """Names of those that show the same as a larger or earlier one of the group."""
    kept: list[tuple[_Look, PIL.Image.Image]] = []
    copies = []
    for look in group:
        image = images.decoded(look, near_px=2 * _COMPARED_PX)
        if image is None:
            continue
        if any(_shows_same(look, image, other, original) for other, original in kept):
            copies.append(look.name)
        else:
            kept.append((look, image))
    return copies


def _shows_same(
    look: _Look, image: PIL.Image.Image, other: _Look, original: PIL.Image.Image
) -> bool:
    """Whether a picture is one that is no smaller, by shape and by what both show, reduced."""
    aspect = (look.width * other.height) / (look.height * other.width)
    side = min(_COMPARED_PX, max(1, min(image.size) // 2))
    reduced = [
        np.asarray(item.convert("L").resize((side, side), PIL.Image.Resampling.BOX), np.float32)
        for item in (image, original)
    ]
    if abs(aspect - 1) > _ASPECT_SLACK:
        return False
    if (look.kind == RAW) != (other.kind == RAW):
        return _correlation(reduced[0], reduced[1]) >= _SAME_TAKE
    return float(np.abs(reduced[0] - reduced[1]).mean()) <= _COPY_DIFFERENCE


def _without(looks: Iterable[_Look], names: Iterable[str]) -> list[_Look]:
    out = set(names)
    return [look for look in looks if look.name not in out]
