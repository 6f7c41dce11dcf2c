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
    """Some rows of a picture. rows: which. covered: [R, W], where a face is.

    face: [N], of each covered texel, row by row. weights: [N, 3], its centre's barycentric
    coordinates there.
    """

    rows: slice
    covered: Bools
    face: NDArray[np.int64]
    weights: Floats


def texels_of(
    uv: Floats, faces: NDArray[np.integer[Any]], size: tuple[int, int], rows: int = ROWS
) -> Iterator[Texels]:
    """The texels that faces cover, some rows at a time, until below the last face.

    uv: [U, 2], px. faces: [F, 3], which must not overlap in the picture. size: width and height.
    """
    width, height = size
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor(flat.astype(np.float32)),
        _core.Tensor(np.ascontiguousarray(faces, np.uint32)),
    )
    columns = np.arange(width) + 0.5
    last = min(int(np.ceil(uv[faces, 1].max())) + 1, height)
    for top in range(0, last, rows):
        lines = np.arange(top, min(top + rows, height)) + 0.5
        rays = np.zeros((len(lines), width, 6), np.float32)
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


def fill(picture: NDArray[np.uint8], known: Bools) -> None:
    """Give all other texels of a picture [H, W, 3] the colours of those known [H, W], in place.

    A texel takes the mean of what is known of the smallest block of 2, 4, 8... of them that has
    any, so that copies of a half, a quarter... of the size hardly mix in anything else (pull-push,
    Gortler et al., "The lumigraph", SIGGRAPH 1996, section 3.5). With nothing known all stays.
    """
    if known.all() or not known.any():
        return
    height, width = known.shape
    sums = np.zeros((-(-height // 2), -(-width // 2), 4), np.float32)
    for top in range(0, height, ROWS):
        here = known[top : top + ROWS, :, None]
        mine = np.concatenate([picture[top : top + ROWS] * here, here], axis=2)
        sums[top // 2 : (top + ROWS) // 2] = _summed(mine)
    means = _filled(sums)
    for top in range(0, height, ROWS):
        missing = ~known[top : top + ROWS]
        around = means[top // 2 : (top + ROWS + 1) // 2].repeat(2, axis=0).repeat(2, axis=1)
        around = around[: len(missing), :width]
        picture[top : top + ROWS][missing] = np.rint(around[missing]).astype(np.uint8)


def _summed(values: NDArray[Any]) -> NDArray[np.float32]:
    """[H, W, C] with 2 x 2 as one, their sum; as if zeros followed odd sides."""
    height, width = values.shape[:2]
    even = np.pad(values, ((0, height % 2), (0, width % 2), (0, 0)))
    total: NDArray[np.float32] = even[::2, ::2].astype(np.float32)
    for down, right in ((0, 1), (1, 0), (1, 1)):
        total += even[down::2, right::2]
    return total


def _filled(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """The means [H, W, 3] of sums [H, W, 4] whose last channel counts, and where nothing was
    counted that of the block around."""
    counts = sums[..., 3:]
    means = np.asarray(sums[..., :3] / np.maximum(counts, 1.0), np.float32)
    if counts.min() == 0.0 and max(counts.shape) > 1:
        around = _filled(_summed(sums)).repeat(2, axis=0).repeat(2, axis=1)
        means[counts[..., 0] == 0.0] = around[: len(means), : means.shape[1]][counts[..., 0] == 0.0]
    return means
