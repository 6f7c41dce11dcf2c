"""The files of a COLMAP model, cameras, images and points3D, as text or as binary.

They are read as they stream by: of images.*, which may have gigabytes, the observations are passed
over. Every count and every length in a binary file is checked against what is left of it.
Standard library only. Source: colmap.github.io/format.html; COLMAP, src/colmap/scene/
reconstruction_io.cc.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO, TextIO

from pipelines.captures.contents import SparsePoints
from pipelines.captures.parsing import malformed
from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.colmap_lenses import COLMAP_LENSES, OTHER_LENSES, lens_from_colmap

MIN_TRACK = 3
"""Points that fewer images have seen are left out where the file says how many have: most of them
are wrong."""
MOST_POINTS = 2_000_000
MOST_IMAGES = 200_000
"""Of a model, and as many cameras."""
_LONGEST_LINE = 64 << 20
_LONGEST_NAME = 4096
_NUMBERS = {lens.number: (name, len(lens.terms)) for name, lens in COLMAP_LENSES.items()}
_MODELS = _NUMBERS | OTHER_LENSES
_OBSERVATION_BYTES = 24
_TRACK_BYTES = 8
_HINT = "Export the model again from COLMAP."


@dataclass(frozen=True)
class Image:
    """One image. quaternion (w, x, y, z), translation: of camera_from_world. camera: its id."""

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


Lens = Intrinsics | str
"""A camera's lens, or why it cannot be used."""


def read_cameras(path: Path, file: str) -> dict[int, Lens]:
    """The cameras by their ids. path: where it lies. file: what messages call it; a name that ends
    with .bin is binary. Raises CaptureError poses_malformed."""
    rows = _binary_cameras if file.endswith(".bin") else _text_cameras
    cameras: dict[int, Lens] = {}
    for number, model, size, params in rows(path, file):
        cameras[number] = _lens(model, size, params)
        if len(cameras) > MOST_IMAGES:
            raise malformed(f"{file} has more than {MOST_IMAGES} cameras.", _HINT)
    return cameras


def read_images(path: Path, file: str) -> list[Image]:
    """The images in the order of the file. Arguments and errors as `read_cameras`."""
    read = _binary_images if file.endswith(".bin") else _text_images
    images = list(islice(read(path, file), MOST_IMAGES + 1))
    if len(images) > MOST_IMAGES:
        raise malformed(f"{file} has more than {MOST_IMAGES} images.", _HINT)
    return images


def read_points(path: Path, file: str) -> SparsePoints:
    """The points that enough images have seen. Arguments and errors as `read_cameras`."""
    read = _binary_points if file.endswith(".bin") else _text_points
    places, colors = [], []
    for place, color, track in read(path, file):
        if (track >= MIN_TRACK or track == 0) and all(map(math.isfinite, place)):
            places.append(place)
            colors.append(color)
            if len(places) > MOST_POINTS:
                raise malformed(f"{file} has more than {MOST_POINTS} points.", _HINT)
    return SparsePoints(places, colors)


def _lens(model: str, size: tuple[int, int], params: tuple[float, ...]) -> Lens:
    try:
        return lens_from_colmap(model, *size, params)
    except ValueError as error:
        return str(error)


_Camera = tuple[int, str, tuple[int, int], tuple[float, ...]]
_Point = tuple[tuple[float, ...], tuple[int, ...], int]


class _Records:
    """Numbers from a binary file, little endian; its end comes as an error that names it."""

    def __init__(self, stream: BinaryIO, num_bytes: int, file: str) -> None:
        self._stream, self._left, self._file = stream, num_bytes, file

    def take(self, form: str) -> tuple[float, ...]:
        return struct.unpack("<" + form, self._bytes(struct.calcsize("<" + form)))

    def skip(self, num_bytes: int) -> None:
        if num_bytes > self._left:
            raise self.cut_off()
        self._left -= num_bytes
        self._stream.seek(num_bytes, 1)

    def name(self) -> str:
        letters = bytearray()
        while (letter := self._bytes(1)) != b"\0":
            letters += letter
            if len(letters) > _LONGEST_NAME:
                raise malformed(f"{self._file} has a name without an end.", _HINT)
        return letters.decode("utf-8", "replace")

    def cut_off(self) -> CaptureError:
        return malformed(f"{self._file} is cut off, or no COLMAP file: it ends too early.", _HINT)

    def _bytes(self, count: int) -> bytes:
        data = self._stream.read(count)
        if len(data) != count:
            raise self.cut_off()
        self._left -= count
        return data


def _binary_cameras(path: Path, file: str) -> Iterator[_Camera]:
    with path.open("rb") as stream:
        records = _Records(stream, path.stat().st_size, file)
        for _ in range(int(records.take("Q")[0])):
            number, model, width, height = map(int, records.take("IiQQ"))
            if model not in _MODELS:
                raise malformed(f"{file} has a camera of an unknown model, number {model}.", _HINT)
            name, num_terms = _MODELS[model]
            yield number, name, (width, height), records.take(f"{num_terms}d")


def _binary_images(path: Path, file: str) -> Iterator[Image]:
    with path.open("rb") as stream:
        records = _Records(stream, path.stat().st_size, file)
        for _ in range(int(records.take("Q")[0])):
            _, *pose, camera = records.take("I7dI")
            name = records.name()
            records.skip(_OBSERVATION_BYTES * int(records.take("Q")[0]))
            yield Image(tuple(pose[:4]), tuple(pose[4:]), int(camera), name)


def _binary_points(path: Path, file: str) -> Iterator[_Point]:
    with path.open("rb") as stream:
        records = _Records(stream, path.stat().st_size, file)
        for _ in range(int(records.take("Q")[0])):
            _, x, y, z, red, green, blue, _, track = records.take("Q3d3BdQ")
            records.skip(_TRACK_BYTES * int(track))
            yield (x, y, z), (int(red), int(green), int(blue)), int(track)


def _lines(stream: TextIO, file: str) -> Iterator[tuple[int, str]]:
    """The lines of a text file with their numbers, comments left out."""
    number = 0
    while line := stream.readline(_LONGEST_LINE):
        number += 1
        if len(line) == _LONGEST_LINE:
            raise malformed(f"Line {number} of {file} is endless.", _HINT)
        if not line.startswith("#"):
            yield number, line.strip()


def _text(path: Path) -> TextIO:
    return path.open("r", encoding="utf-8", errors="replace", newline="\n")


def _text_cameras(path: Path, file: str) -> Iterator[_Camera]:
    with _text(path) as stream:
        for number, line in _lines(stream, file):
            if not line:
                continue
            words = line.split()
            try:
                size = (int(words[2]), int(words[3]))
                yield int(words[0]), words[1], size, tuple(map(float, words[4:]))
            except (ValueError, IndexError, OverflowError) as error:
                raise malformed(f"Line {number} of {file} is no camera.", _HINT) from error


def _text_images(path: Path, file: str) -> Iterator[Image]:
    """Two lines an image; the second, its observations, may be empty."""
    with _text(path) as stream:
        lines = _lines(stream, file)
        for number, line in lines:
            if not line:
                continue
            words = line.split(maxsplit=9)
            try:
                pose = tuple(map(float, words[1:8]))
                image = Image(pose[:4], pose[4:], int(words[8]), words[9])
            except (ValueError, IndexError, OverflowError) as error:
                raise malformed(
                    f"Line {number} of {file} is no image: two lines belong to each, and the "
                    "second may be empty.",
                    _HINT,
                ) from error
            next(lines, None)
            yield image


def _text_points(path: Path, file: str) -> Iterator[_Point]:
    with _text(path) as stream:
        for number, line in _lines(stream, file):
            if not line:
                continue
            words = line.split()
            try:
                place = tuple(map(float, words[1:4]))
                color = tuple(map(int, words[4:7]))
                if len(color) != 3:
                    raise ValueError
            except (ValueError, IndexError, OverflowError) as error:
                raise malformed(f"Line {number} of {file} is no point.", _HINT) from error
            yield place, color, max(0, len(words) - 8) // 2
