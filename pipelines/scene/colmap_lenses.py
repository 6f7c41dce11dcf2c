"""COLMAP's camera models and ours: one table for what reads them and what writes them.

Symbols: a lens's terms in the order in which COLMAP lists them. `f` is both focal lengths; d4, d5
and d6 divide, and we have no such terms. Pixel coordinates are the same: the centre of the top-left
pixel is (0.5, 0.5). Standard library only.

Source: COLMAP, src/colmap/sensor/models.h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipelines.scene.cameras_file import Intrinsics

_FOCALS = ("fl_x", "fl_y", "cx", "cy")
_DIVISORS = ("d4", "d5", "d6")


@dataclass(frozen=True)
class ColmapLens:
    """number: in binary files. terms: see the module. ours: the model that it becomes."""

    number: int
    terms: tuple[str, ...]
    ours: str


COLMAP_LENSES: dict[str, ColmapLens] = {
    "SIMPLE_PINHOLE": ColmapLens(0, ("f", "cx", "cy"), "PINHOLE"),
    "PINHOLE": ColmapLens(1, _FOCALS, "PINHOLE"),
    "SIMPLE_RADIAL": ColmapLens(2, ("f", "cx", "cy", "k1"), "OPENCV"),
    "RADIAL": ColmapLens(3, ("f", "cx", "cy", "k1", "k2"), "OPENCV"),
    "OPENCV": ColmapLens(4, (*_FOCALS, "k1", "k2", "p1", "p2"), "OPENCV"),
    "OPENCV_FISHEYE": ColmapLens(5, (*_FOCALS, "k1", "k2", "k3", "k4"), "OPENCV_FISHEYE"),
    "FULL_OPENCV": ColmapLens(6, (*_FOCALS, "k1", "k2", "p1", "p2", "k3", *_DIVISORS), "OPENCV"),
    "SIMPLE_RADIAL_FISHEYE": ColmapLens(8, ("f", "cx", "cy", "k1"), "OPENCV_FISHEYE"),
    "RADIAL_FISHEYE": ColmapLens(9, ("f", "cx", "cy", "k1", "k2"), "OPENCV_FISHEYE"),
    "SIMPLE_FISHEYE": ColmapLens(14, ("f", "cx", "cy"), "OPENCV_FISHEYE"),
    "FISHEYE": ColmapLens(15, _FOCALS, "OPENCV_FISHEYE"),
}
"""The models that we can express."""

OTHER_LENSES: dict[int, tuple[str, int]] = {
    7: ("FOV", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Those that we cannot, by number: name, and how many terms are to be skipped."""


def lens_from_colmap(model: str, width: int, height: int, params: Sequence[float]) -> Intrinsics:
    """A COLMAP camera as ours. Raises ValueError, naming the fault, for one that has no equal."""
    lens = COLMAP_LENSES.get(model)
    if lens is None:
        raise ValueError(f"is of model {model}; {', '.join(COLMAP_LENSES)} can be used")
    if len(params) != len(lens.terms):
        raise ValueError(f"of model {model} has {len(params)} terms, not {len(lens.terms)}")
    if width < 1 or height < 1:
        raise ValueError(f"is {width}x{height} pixels large")
    values = {name: float(value) for name, value in zip(lens.terms, params, strict=True)}
    if not all(map(math.isfinite, values.values())):
        raise ValueError("has terms that are no finite numbers")
    focal = values.pop("f", None)
    if focal is not None:
        values |= {"fl_x": focal, "fl_y": focal}
    divisors = [values.pop(name, 0.0) for name in _DIVISORS]
    if any(divisors):
        raise ValueError(f"is of model {model} with terms that divide (k4, k5, k6)")
    return Intrinsics(width=width, height=height, model=lens.ours, **values)
