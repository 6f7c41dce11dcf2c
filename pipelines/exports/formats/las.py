"""A point cloud as LAS 1.2, and LAZ, the same compressed: what surveyors' programs read.

Positions are whole multiples of a step, a power of ten at most a millionth of the cloud's extent,
from an offset near its middle, a whole number where that is near enough; so coordinates of any
size stay exact. Colours are 16-bit (the 8 bits twice), normals extra dimensions `NormalX`,
`NormalY`, `NormalZ`. A record of the file's own says its frame. The date is always the same one,
since the same cloud gives the same bytes. Each point is return 1 of 1, as of a scanner's pulse that
met one thing: returns are counted from 1, and programs that show first or last returns pass over
what is none.

Source: ASPRS, LAS Specification 1.2; laspy, lazrs.
"""

from __future__ import annotations

import datetime
import math
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from pipelines.exports.frame import Frame

Floats = NDArray[np.float64]

_POINT_FORMAT = 2
_FINEST = 1e-6
_MOST_STEPS = 2.0**30
_DATE = datetime.date(1980, 1, 1)
"""That of our zip files, too. laspy writes today's where it is given none."""
_NORMALS = ("NormalX", "NormalY", "NormalZ")
_RECORD_ID = 1


def write_points(
    path: Path, points: Floats, colors: NDArray[np.uint8], normals: Floats, frame: Frame
) -> None:
    """Write a cloud of the world; the name's ending, .las or .laz, says which of the two.

    points: [P, 3]. colors: [P, 3], sRGB. normals: [P, 3], unit. frame: of the file.
    """
    positions, turned = frame.of_world(points), frame.of_world(normals)
    header = laspy.LasHeader(version="1.2", point_format=_POINT_FORMAT)
    header.creation_date = _DATE
    header.generating_software = "nerfworks"
    step = _step(positions)
    header.scales = np.full(3, step)
    header.offsets = _offset(positions, step)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.dtype("<f4")) for name in _NORMALS])
    header.vlrs.append(
        laspy.VLR("nerfworks", _RECORD_ID, "frame", "; ".join(frame.lines()).encode("ascii"))
    )
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = positions.T
    cloud.red, cloud.green, cloud.blue = colors.astype(np.uint16).T * 257
    cloud.return_number[:] = 1
    cloud.number_of_returns[:] = 1
    for name, column in zip(_NORMALS, turned.T, strict=True):
        cloud[name] = column.astype(np.float32)
    cloud.write(str(path))


def _step(positions: Floats) -> float:
    """Between two positions that the file can tell apart."""
    extent = float(np.ptp(positions, axis=0).max())
    return 10.0 ** math.floor(math.log10(_FINEST * extent)) if extent > 0 else _FINEST


def _offset(positions: Floats, step: float) -> Floats:
    """[3], from which positions are counted in 32 bits: whole where the cloud is large enough for
    that, else the middle to ten steps, as a whole number may be too many steps away."""
    middle = positions.mean(axis=0)
    whole: Floats = np.round(middle)
    if np.abs(positions - whole).max() / step < _MOST_STEPS:
        return whole
    digits = 1 - round(math.log10(step))
    near: Floats = np.round(middle, digits)
    return near
