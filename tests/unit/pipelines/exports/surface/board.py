"""A coloured board before a wall: exact photos of it, and meshes that are a little off."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.stereo_views import ColorView
from tests.unit.pipelines.exports.surface.test_refinement import grid

Floats = NDArray[np.float64]

HALF, BOARD_Z, WALL_Z = 0.5, -2.0, -3.0
LENS = Pinhole(320, 240, 280.0, 280.0, 160.0, 120.0)
PIXEL = -BOARD_Z / LENS.fl_x
"""Of the photos, on the board, world units."""
ORIGIN = np.array([500.0, -30.0, 12.0])
CELLS = 40
_FINE = 4


def board_color(x: Floats, y: Floats) -> Floats:
    """[..., 3]"""
    return _shaded([0.8, 0.45, 0.2], 0.05 * np.sin(9.0 * x) * np.cos(7.0 * y))


def wall_color(x: Floats, y: Floats) -> Floats:
    """[..., 3]"""
    return _shaded([0.25, 0.4, 0.6], 0.05 * np.cos(5.0 * x + 3.0 * y))


@functools.cache
def photos() -> list[ColorView]:
    """Five of them, each from elsewhere, in a world whose origin is far away."""
    eyes = ((0.0, 0.0), (0.5, 0.1), (-0.5, -0.1), (0.1, 0.4), (-0.2, -0.4))
    return [_photo(np.array([x, y, 0.0])) for x, y in eyes]


def mesh(off: Floats, *, flap: int = 0) -> TriangleMesh:
    """The board, bordered `off` [4 * CELLS] px beyond where it ends, and a wall with wide margins.

    flap: so many outer rows of vertices have the wall's colour.
    """
    side = np.linspace(-1.0, 1.0, CELLS + 1)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    on_rim = np.maximum(np.abs(x), np.abs(y))
    grown = np.zeros(len(x))
    rim = np.flatnonzero(on_rim > 1.0 - 1e-9)
    grown[rim] = off
    scale = HALF + PIXEL * grown
    colors = board_color(HALF * x, HALF * y)
    outer = on_rim > 1.0 - 2.0 * (flap - 0.5) / CELLS
    colors[outer] = wall_color(1.5 * HALF * x, 1.5 * HALF * y)[outer]
    board = _sheet(np.stack([scale * x, scale * y, np.full(len(x), BOARD_Z)], axis=1), colors)
    wide = 2.5
    colors = wall_color(wide * x, wide * y)
    wall = _sheet(np.stack([wide * x, wide * y, np.full(len(x), WALL_Z)], axis=1), colors)
    return joined([board, wall])


def rim_errors(found: TriangleMesh) -> Floats:
    """Px by which the vertices of the board's rim, but for its corners, are beyond its true end."""
    side = np.linspace(-1.0, 1.0, CELLS + 1)
    x, y = (np.abs(part.ravel()) for part in np.meshgrid(side, side))
    rim = np.flatnonzero((np.maximum(x, y) > 1.0 - 1e-9) & (np.minimum(x, y) < 0.9))
    places = np.abs(found.vertices[rim, :2] - ORIGIN[:2])
    errors: Floats = (places.max(axis=1) - HALF) / PIXEL
    return errors


def _photo(eye: Floats) -> ColorView:
    """Each pixel is the mean of smaller ones."""
    fine = Pinhole(*(_FINE * value for value in vars(LENS).values()))
    ways = fine.directions()
    near, far = eye[:2] - BOARD_Z * ways[..., :2], eye[:2] - WALL_Z * ways[..., :2]
    on_board = np.abs(near).max(axis=-1) <= HALF
    colors = np.where(
        on_board[..., None],
        board_color(near[..., 0], near[..., 1]),
        wall_color(far[..., 0], far[..., 1]),
    )
    mean = colors.reshape(LENS.height, _FINE, LENS.width, _FINE, 3).mean(axis=(1, 3))
    picture = np.rint(255.0 * mean).astype(np.uint8)
    pose = np.column_stack([np.eye(3), eye + ORIGIN])
    return ColorView(picture, np.ones(picture.shape[:2], np.bool_), LENS, pose)


def _sheet(vertices: Floats, colors: Floats) -> TriangleMesh:
    faces = grid(CELLS + 1, CELLS + 1)[:, ::-1]
    normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    return TriangleMesh(vertices + ORIGIN, np.ascontiguousarray(faces), colors, normals)


def _shaded(color: list[float], shade: Floats) -> Floats:
    shown: Floats = np.asarray(color) + shade[..., None]
    return shown
