"""The texels of a picture on a mesh: which face each one lies on, and where in it.

A texel is the square of its column and row; its centre is 0.5 beside their corner. Symbols: U
corners, F faces, N texels.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ROWS = 256
"""Looked up at a time: of a picture of 8192 px, two million texels of some sixty bytes."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


@dataclass(frozen=True)
class Texels:
    """Some rows of a picture. rows: which. covered: [R, side], where a face is.

    face: [N], of each covered texel, row by row. weights: [N, 3], its centre's barycentric
    coordinates there.
    """

    rows: slice
    covered: Bools
    face: NDArray[np.int64]
    weights: Floats


def texels_of(
    uv: Floats, faces: NDArray[np.integer[Any]], side: int, rows: int = ROWS
) -> Iterator[Texels]:
    """The texels that faces cover, some rows at a time, until below the last face.

    uv: [U, 2], px. faces: [F, 3], which must not overlap in the picture.
    """
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor(flat.astype(np.float32)),
        _core.Tensor(np.ascontiguousarray(faces, np.uint32)),
    )
    columns = np.arange(side) + 0.5
    last = min(int(np.ceil(uv[:, 1].max())) + 1, side)
    for top in range(0, last, rows):
        lines = np.arange(top, min(top + rows, side)) + 0.5
        rays = np.zeros((len(lines), side, 6), np.float32)
        rays[..., 0], rays[..., 1] = columns[None, :], lines[:, None]
        rays[..., 2], rays[..., 5] = 1.0, -1.0
        found = scene.cast_rays(_core.Tensor(rays))
        covered = np.isfinite(found["t_hit"].numpy())
        u, v = found["primitive_uvs"].numpy()[covered].T
        yield Texels(
            rows=slice(top, top + len(lines)),
            covered=covered,
            face=found["primitive_ids"].numpy()[covered].astype(np.int64),
            weights=np.stack([1.0 - u - v, u, v], axis=1),
        )


def moving(
    on_progress: Callable[[float], None], begin: float, end: float, calls: int
) -> Callable[[], None]:
    """What tells progress from begin to end, a step further each time it is called."""
    made = itertools.count(1)
    return lambda: on_progress(begin + (end - begin) * min(next(made) / calls, 1.0))


def spread(
    values: NDArray[Any], covered: Bools, passes: int, on_pass: Callable[[], None] = lambda: None
) -> None:
    """Carry values [H, W, C] so many pixels beyond what is covered [H, W], both in place."""
    for _ in range(passes):
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            on_pass()
            into, out = [slice(None)] * 2, [slice(None)] * 2
            into[axis], out[axis] = (
                (slice(1, None), slice(None, -1)) if step > 0 else (slice(None, -1), slice(1, None))
            )
            take = ~covered[tuple(into)] & covered[tuple(out)]
            values[tuple(into)][take] = values[tuple(out)][take]
            covered[tuple(into)] |= take
