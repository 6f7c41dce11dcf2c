"""A table with a patterned top before a patterned wall: with a white front below its near edge, on
a patterned floor, or with none, on a white one. What is white has thin lines on it, or none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.nerf.stereo.views import StereoView

WIDTH, HEIGHT, FOCAL = 240, 180, 170.0
TOP, FLOOR, FRONT, WALL = 0.7, 1.5, 2.0, 2.9
"""y of the top and of the floor (down); z of the front and of the wall."""
HALF = 1.0
"""Of the table's width, x."""
LINE, LEG = 0.012, 0.06
"""Half of the widths of a line and of a leg."""
ON_TOP, ON_FRONT, ON_FLOOR, ON_WALL = range(4)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Seen:
    """A view, its true depth [H, W], and what is white there."""

    view: StereoView
    depth: NDArray[np.float32]
    white: Bools

    def known(self) -> DepthMap:
        """What stereo would know of it: what has a pattern."""
        z = np.where(self.white, np.float32(0.0), self.depth)
        return DepthMap(z, np.where(z > 0, 4, 0).astype(np.uint8))


def walk(
    *, front: bool = True, lines: bool = True, whole: bool = True, legs: bool = False
) -> list[Seen]:
    """Ten cameras that pass by, up and down a little. lines: on what is white. whole: whether the
    pictures hold its ends and its foot. legs: two dark ones, below the ends of the near edge,
    before a white floor and a white wall."""
    half, floor = HALF if whole else 3.0 * HALF, FLOOR if whole and not legs else 2.0 * FLOOR
    eyes = [np.array([-0.5 + 0.11 * k, -0.1 - 0.12 * (k % 3), 0.1]) for k in range(10)]
    return [look(eye, front, lines, half, floor, legs) for eye in eyes]


def look(eye: Floats, front: bool, lines: bool, half: float, floor: float, legs: bool) -> Seen:
    """A camera that looks ahead and down by 20 degrees."""
    down = np.radians(20.0)
    cosine, sine = np.cos(down), np.sin(down)
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float64(1.0)), axis=-1)
    rays = rays @ rotation.T
    to = [
        _hits(eye, rays, 1, TOP, lambda at: (np.abs(at[..., 0]) < half) & (at[..., 2] > FRONT)),
        _hits(eye, rays, 2, FRONT, lambda at: (np.abs(at[..., 0]) < half) & (at[..., 1] > TOP)),
        _hits(eye, rays, 1, floor, lambda at: at[..., 2] < WALL),
        _hits(eye, rays, 2, WALL, lambda at: at[..., 1] < floor),
    ]
    if legs:
        leg = _hits(
            eye,
            rays,
            2,
            FRONT,
            lambda at: (
                (np.abs(np.abs(at[..., 0]) - half + LEG) < LEG)
                & (at[..., 1] > TOP)
                & (at[..., 1] < floor)
            ),
        )
        to[ON_FRONT] = leg
    elif not front:
        to[ON_FRONT][:] = np.inf
    depth, what = np.min(to, axis=0), np.argmin(to, axis=0)
    place = eye + rays * depth[..., None]
    pattern = 0.45 + 0.3 * np.sin(13.0 * place[..., 0] + 7.0 * place[..., 1]) * np.cos(
        12.0 * place[..., 2] + 9.0 * place[..., 1] + 2.0 * np.sin(9.0 * place[..., 0])
    )
    white = what == (ON_FRONT if front else ON_FLOOR)
    if legs:
        white |= what == ON_WALL
    dark = what == ON_FRONT if legs else np.zeros_like(white)
    picture = np.where(dark, 0.15, np.where(white, 0.95, pattern))
    if lines:
        gaps = np.abs(place[..., 0][..., None] - [-0.75, 0.0, 0.75]).min(axis=-1) < LINE
        across = np.where(what == ON_FRONT, place[..., 1] - 0.85, place[..., 2] - 2.4)
        picture = np.where(white & (gaps | (np.abs(across) < LINE)), 0.2, picture)
    pose = np.column_stack([rotation, eye])
    view = StereoView(picture.astype(np.float32), (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), pose)
    return Seen(view, depth.astype(np.float32), white)


def _hits(eye: Floats, rays: Floats, axis: int, at: float, within: Any) -> Floats:
    """Depth where rays meet a plane, infinite where they do not, or not within it."""
    with np.errstate(divide="ignore"):
        depth = (at - eye[axis]) / rays[..., axis]
    depth = np.where(np.isfinite(depth) & (depth > 1e-6), depth, 1e6)
    place = eye + rays * depth[..., None]
    return np.where(within(place) & (depth < 1e6), depth, np.inf)
