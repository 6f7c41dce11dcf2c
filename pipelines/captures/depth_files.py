"""Depth that a phone's sensor measured, out of an archive: decoded, checked, in world units.

Read are pictures of one channel and 16 bits or more in PNG and TIFF, OpenEXR's R (Record3D's) or
what renderers call their depth there, and plain arrays of NumPy, and nothing else. What is not
finite, not above 0, not trusted or at the end of what its numbers can count becomes 0, unknown. A
map that cannot be used never costs its picture: it is left out and told.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import SensorDepth
from pipelines.captures.magic import image_format, is_exr, is_npy
from pipelines.captures.parsing import some_of
from pipelines.captures.pictures import opened
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.scene.sensor_depth import Depths, save_sensor_depth

_FOLDER = "depth"
_ASPECT_SLACK = 0.02
_MOST_CHANNELS = 4
_ONE_CHANNEL = ("L", "I", "I;16", "I;16L", "I;16B", "I;16N", "F")
"""Pillow's modes of pictures with one channel of numbers, of 8 bits or more."""
_NO_CHANNEL = "has no channel Z, V, R or Y of plain numbers that must be its depth"
_NOTHING_THERE = 1e9
"""Numbers with a fraction from which on nothing was met: renderers write 1e10 there. So it is for
65504, the largest that 16 bits hold of such numbers, as what was kept in them has it there."""
_NPY_NUMBERS = re.compile(r"[<>|=]?(?:[ui][1248]|f[248])")
"""What types of NumPy's arrays are read. Others never reach NumPy, which some of them end the
process of: files may say anything."""
_MOST_NPY_HEADER = 10_000
_BAD_LITERAL = (ValueError, TypeError, SyntaxError, MemoryError, RecursionError)


class DepthWriter:
    """Writes depth maps of one archive to `out/depth`."""

    def __init__(self, archive: CaptureArchive, out: Path, *, max_pixels: int) -> None:
        self._archive = archive
        self._out = out
        self._max_pixels = max_pixels
        self._raw = out / ".raw_depth"
        self._num_tried = 0
        self._refused: dict[str, str] = {}
        (out / _FOLDER).mkdir(parents=True, exist_ok=True)

    def close(self) -> None:
        """Remove what was only needed while writing."""
        self._raw.unlink(missing_ok=True)
        if not any((self._out / _FOLDER).iterdir()):
            (self._out / _FOLDER).rmdir()

    def store(self, depth: SensorDepth, number: int, size: tuple[int, int]) -> str | None:
        """Write the depth of picture `number`; returns its path below `out`.

        size: width and height of the picture. A map that cannot be used is remembered for
        `warnings`, and None is returned.
        """
        self._num_tried += 1
        try:
            z = self.read(depth, size)
        except CaptureError as error:
            if error.code != "image_undecodable":
                raise
            self._refused[depth.name] = error.message  # not with the frames that hold the map
            self._archive.told(depth.files)
            return None
        file = f"{_FOLDER}/{number:05d}.npz"
        save_sensor_depth(self._out / file, z)
        return file

    def read(self, depth: SensorDepth, size: tuple[int, int]) -> Depths:
        """[h, w] in world units along the camera's axis, 0 for unknown; size as for `store`.

        Raises CaptureError image_undecodable, also where the map's aspect is not the picture's
        (portrait taken for landscape, or a picture that was cut) or nothing of it is known.
        """
        values = self._values(depth.name)
        height, width = values.shape
        if abs(width * size[1] / (height * size[0]) - 1) > _ASPECT_SLACK:
            raise _unusable(
                depth.name,
                f"is {width}x{height}, its picture {size[0]}x{size[1]}: not the same view",
            )
        with np.errstate(over="ignore", invalid="ignore"):
            z = (values.astype(np.float64) * depth.unit).astype(np.float32)
            known = np.isfinite(z) & (z > 0) & ~_at_its_end(values)
        if depth.confidence is not None:
            known &= self._confidence(depth.confidence, values.shape) >= depth.least_confidence
        if not known.any():
            raise _unusable(depth.name, "has no value that can be trusted")
        return np.where(known, z, np.float32(0.0))

    @property
    def warnings(self) -> list[str]:
        """What is to be told about the maps so far."""
        if not self._refused:
            return []
        first = next(iter(self._refused.values()))
        return [
            f"{len(self._refused)} of {self._num_tried} depth maps cannot be used, and their "
            f"pictures are used without: {some_of(self._refused)}. {first}"
        ]

    def _values(self, name: str) -> NDArray[Any]:
        """What a file stores, [h, w], of any unit."""
        head = self._archive.head(name)
        if is_exr(head):
            self._archive.extract(name, self._raw)
            return _exr_channel(self._raw, name, self._max_pixels)
        if is_npy(head):
            self._archive.extract(name, self._raw)
            values = _npy_array(self._raw, name, self._max_pixels)
        else:
            values = self._one_channel(name)
        if values.itemsize == 1:
            raise _unusable(name, "has 8 bits; 16 are needed")
        return values

    def _confidence(self, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
        values = self._one_channel(name)
        if values.shape != shape:
            raise _unusable(
                name,
                f"is {values.shape[1]}x{values.shape[0]}, the depth map that it is for "
                f"{shape[1]}x{shape[0]}",
            )
        return values

    def _one_channel(self, name: str) -> NDArray[Any]:
        """A PNG or TIFF of one channel, [h, w]."""
        kind = image_format(self._archive.head(name))
        if kind not in ("PNG", "TIFF"):
            raise _unusable(name, "is neither a PNG, a TIFF, OpenEXR nor NumPy's .npy")
        self._archive.extract(name, self._raw)
        with opened(self._raw, name, kind, self._max_pixels) as image:
            if image.mode not in _ONE_CHANNEL:
                raise _unusable(name, f"has colours ({image.mode}) in place of one channel")
            return np.asarray(image)


def _at_its_end(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Where counts are the largest that their type has: nothing was measured, or more than fits."""
    ends: NDArray[np.bool_]
    if values.dtype.kind == "f":
        ends = (values >= _NOTHING_THERE) | (values == np.finfo(np.float16).max)
    elif values.dtype.kind == "u":
        ends = values == np.iinfo(values.dtype).max
    else:
        ends = np.zeros(values.shape, np.bool_)
    return ends


def _npy_array(path: Path, name: str, max_pixels: int) -> NDArray[Any]:
    """An array of NumPy's, [h, w], or with one channel: plain numbers, and nothing that would have
    to be executed. Source: numpy.lib.format, versions 1 to 3.
    """
    with path.open("rb") as file:
        version = int.from_bytes(file.read(8)[6:7], "little")
        length = int.from_bytes(file.read(2 if version == 1 else 4), "little")
        if version not in (1, 2, 3) or length > _MOST_NPY_HEADER:
            raise _unusable(name, "does not decode")
        written = file.read(length)
        start = file.tell()
        size = file.seek(0, os.SEEK_END)
    try:
        told = ast.literal_eval(written.decode("latin1" if version < 3 else "utf8").strip())
        kind, shape, is_fortran = told["descr"], told["shape"], told["fortran_order"]
    except (*_BAD_LITERAL, LookupError) as error:
        raise _unusable(name, "does not decode") from error
    if not (isinstance(shape, tuple) and all(type(side) is int and side >= 0 for side in shape)):
        raise _unusable(name, "does not decode")
    rows = [side for side in shape if side != 1]
    if not (isinstance(kind, str) and _NPY_NUMBERS.fullmatch(kind) and len(rows) == 2):
        what = shown(f"{shape} values of {kind}")
        raise _unusable(name, f"has {what}, not one number for each pixel")
    count = rows[0] * rows[1]
    if not 0 < count <= max_pixels:
        raise _unusable(name, f"has {rows[1]}x{rows[0]} pixels; {max_pixels} are allowed")
    if start + count * np.dtype(kind).itemsize > size:
        raise _unusable(name, "does not decode")
    values = np.fromfile(path, kind, count, offset=start)
    return values.reshape(rows, order="F" if is_fortran is True else "C")


def _exr_channel(path: Path, name: str, max_pixels: int) -> NDArray[Any]:
    """The depth of an OpenEXR file, [h, w].

    The headers are looked at before any pixel: size, one plain image, few channels. A damaged part
    is left out by the library, with a line on stdout, and no part is left then.
    """
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True, num_threads=0) as file:
            why = _exr_fault(file.parts, max_pixels)
        if why:
            raise _unusable(name, why)
        # Without `separate_channels` R, G and B would come as one array.
        with OpenEXR.File(str(path), separate_channels=True, num_threads=0) as file:
            channels = file.channels()
            depth = _depth_channel(channels)
            pixels = np.array(channels[depth].pixels)
            green = channels.get(f"{depth[:-1]}G") if depth.endswith("R") else None
            has_colors = green is not None and not np.array_equal(
                green.pixels, pixels, equal_nan=True
            )
    except (RuntimeError, ValueError, TypeError, LookupError, OSError, OpenEXR.error) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # the disk's fault, not the file's
        raise _unusable(name, "does not decode") from error
    if has_colors:
        raise _unusable(name, "has colours in place of one channel")
    if pixels.ndim != 2 or pixels.dtype.kind != "f":
        raise _unusable(name, _NO_CHANNEL)
    return pixels


def _depth_channel(names: Iterable[str]) -> str:
    """Which of an OpenEXR's channels holds depth; "" for none, or where it may be one of several.

    Renderers and Blender call it Z or V, apps R, OpenCV Y; a layer's name may stand before a dot.
    Beside X and Y, Z is a direction's; beside others, V and Y are colours'.
    """
    layers: dict[str, set[str]] = {}
    for name in names:
        layer, _, channel = name.rpartition(".")
        layers.setdefault(layer, set()).add(channel)
    called, colors = [], []
    for layer, channels in layers.items():
        before = f"{layer}." if layer else ""
        if "Z" in channels and not channels & {"X", "Y"}:
            called.append(f"{before}Z")
        elif channels == {"V"}:
            called.append(f"{before}V")
        elif "R" in channels:
            colors.append(f"{before}R")
        elif channels == {"Y"}:
            colors.append(f"{before}Y")
    found = called or colors
    return found[0] if len(found) == 1 else ""


def _exr_fault(parts: list[Any], max_pixels: int) -> str:
    """Why a file with these parts is not read, by its headers; "" where it is."""
    import OpenEXR

    if len(parts) != 1:
        return f"has {len(parts)} images"
    header = parts[0].header
    if header.get("type", OpenEXR.scanlineimage) != OpenEXR.scanlineimage:
        return "is tiled or deep"
    channels = header["channels"]
    by_name = {item.name: (item.xSampling, item.ySampling) for item in channels}
    if len(channels) > _MOST_CHANNELS or by_name.get(_depth_channel(by_name)) != (1, 1):
        return _NO_CHANNEL
    (left, top), (right, bottom) = ([int(value) for value in row] for row in header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1 or width * height > max_pixels:
        return f"has {width}x{height} pixels; {max_pixels} are allowed"
    return ""


def _unusable(name: str, why: str) -> CaptureError:
    return CaptureError(
        f'"{shown(name)}" {why}.',
        code="image_undecodable",
        hint="Export the capture again, or leave its depth out; pictures are used without.",
    )
