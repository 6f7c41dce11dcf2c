"""Pictures that come several times with one pose, as splits that list the same ones do.

`train`, `val` and `test` of a published scene may hold the very same photos: what is held out would
have a twin in training then, and count in it three times.
"""

from __future__ import annotations

import hashlib
import io
from collections import defaultdict
from collections.abc import Sequence

from pipelines.captures.contents import PosedSource
from pipelines.captures.decoders import DAMAGED, open_picture
from pipelines.captures.unpack import CaptureArchive

_DIGITS = 6
"""Of a pose's numbers, after the point."""
_MOST_BYTES = 256 << 20


def without_copies(
    archive: CaptureArchive, sources: Sequence[PosedSource], max_pixels: int
) -> list[PosedSource]:
    """The sources without those of the same pose and picture as one before; they are set aside.

    Pictures are the same by their bytes or their pixels; only those of one pose are compared. Of
    several the first that has depth or a mask is kept, else the first. Raises CaptureError
    archive_damaged.
    """
    by_pose: dict[object, list[int]] = defaultdict(list)
    for index, source in enumerate(sources):
        if source.frame is None:
            rows = tuple(round(value, _DIGITS) for row in source.world_from_camera for value in row)
            by_pose[rows].append(index)
    copies: set[int] = set()
    for group in by_pose.values():
        if len(group) > 1:
            copies.update(_copies(archive, sources, group, max_pixels))
    kept = [source for index, source in enumerate(sources) if index not in copies]
    used = {name for source in kept for name in (source.name, source.mask, *source.depth_files)}
    again = [sources[index] for index in sorted(copies)]
    beside = [name for one in again for name in (one.mask, *one.depth_files) if name is not None]
    archive.set_aside(
        (name for one in again if (name := one.name) not in used),
        "the same picture again, with the same pose",
    )
    archive.set_aside((name for name in beside if name not in used), "their pictures are left out")
    return kept


def _copies(
    archive: CaptureArchive, sources: Sequence[PosedSource], group: Sequence[int], max_pixels: int
) -> list[int]:
    """Of sources with one pose those that show what another shows."""
    best_first = sorted(
        group, key=lambda index: (not (sources[index].depth or sources[index].mask), index)
    )
    by_bytes: dict[tuple[int, int], int] = {}
    by_pixels: set[str] = set()
    copies = []
    for index in best_first:
        name = sources[index].name
        content = (archive.num_bytes(name), archive.checksum(name))
        if content in by_bytes:
            copies.append(index)
            continue
        by_bytes[content] = index
    for index in by_bytes.values() if len(by_bytes) > 1 else ():
        pixels = _pixels(archive, sources[index].name, max_pixels)
        if pixels is not None and pixels in by_pixels:
            copies.append(index)
        elif pixels is not None:
            by_pixels.add(pixels)
    return copies


def _pixels(archive: CaptureArchive, name: str, max_pixels: int) -> str | None:
    """A sum over a picture's pixels and size, or None where it does not decode."""
    try:
        data = io.BytesIO(archive.peek(name, _MOST_BYTES))
        with open_picture(data, archive.image_format(name)) as image:
            if image.width * image.height > max_pixels:
                return None
            plain = image.convert("RGBA")
            return hashlib.sha256(repr(plain.size).encode() + plain.tobytes()).hexdigest()
    except DAMAGED:
        return None
