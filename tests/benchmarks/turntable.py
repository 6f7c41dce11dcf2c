"""Turntables of a mesh as pictures, without a screen: coloured, and shaded so that bumps show.

World frame: +Z up. Faces that look away from the camera are left out, so that a room is seen from
outside with its near walls open, like a doll's house. Symbols: V vertices, F faces, H x W pixels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.judging.asset_views import Texture

Floats = NDArray[np.floating[Any]]

SIDE_PX = 320
NUM_VIEWS = 6
ELEVATION_DEG = 30.0
_FOV_DEG = 40.0
_MAX_LAYERS = 6
_BACKGROUND = 0.12

_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def turntable(
    vertices: Floats,
    faces: NDArray[np.integer[Any]],
    colors: Floats | Texture | None,
    num_views: int = NUM_VIEWS,
    side_px: int = SIDE_PX,
    ball: tuple[Floats, float] | None = None,
) -> NDArray[np.uint8]:
    """[2 side, num_views side, 3] uint8: coloured above, shaded below, all round.

    vertices: [V, 3] world. faces: [F, 3]. colors: [V, 3] in [0, 1], a texture, or None. ball:
    middle [3] and radius of what is shown, the rest is left out; without it the middle 98 % of the
    vertices fill the picture.
    """
    if ball is not None:
        outside = np.linalg.norm(vertices - ball[0], axis=1) > ball[1]
        faces = np.asarray(faces)[~outside[faces].any(axis=1)]
    if len(faces) == 0:
        return np.zeros((2 * side_px, num_views * side_px, 3), np.uint8)
    low, high = np.percentile(vertices[np.unique(faces)], (1, 99), axis=0)
    middle, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    if ball is not None:
        middle, reach = ball
    local = np.ascontiguousarray((vertices - middle) / reach, np.float32)
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor.from_numpy(local),
        _core.Tensor.from_numpy(np.ascontiguousarray(faces, np.uint32)),
    )
    paint = _Paint(local, np.asarray(faces), colors, side_px)
    columns = []
    for step in range(num_views):
        eye, directions = _rays(2 * math.pi * step / num_views, side_px)
        colored, shaded = _look(scene, eye, directions, paint)
        columns.append(np.concatenate([colored, shaded]).reshape(2 * side_px, side_px, 3))
    strip = np.concatenate(columns, axis=1)
    picture: NDArray[np.uint8] = np.rint(255 * np.clip(strip, 0, 1)).astype(np.uint8)
    return picture


def _rays(azimuth: float, side_px: int) -> tuple[Floats, Floats]:
    """Eye [3] and unit directions [side^2, 3] of a picture of the unit ball."""
    elevation = math.radians(ELEVATION_DEG)
    back = np.array(
        [
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        ]
    )
    half = math.tan(math.radians(_FOV_DEG / 2))
    eye = back / math.sin(math.radians(_FOV_DEG / 2))
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = np.cross(back, right)
    steps = ((np.arange(side_px) + 0.5) / side_px * 2 - 1) * half
    directions = (-back + steps[None, :, None] * right - steps[:, None, None] * up).reshape(-1, 3)
    return eye, directions / np.linalg.norm(directions, axis=1, keepdims=True)


class _Paint:
    """What colours a mesh: its vertices, or a texture."""

    def __init__(
        self,
        vertices: Floats,
        faces: NDArray[np.integer[Any]],
        colors: Floats | Texture | None,
        side_px: int,
    ) -> None:
        self._faces = faces
        self._texture = colors if isinstance(colors, Texture) else None
        if isinstance(colors, Texture):
            self._values = np.asarray(colors.uv)
            self._density = colors.density(vertices, faces)
            self._angle = math.radians(_FOV_DEG) / side_px
        else:
            grey = np.full((len(vertices), 3), 0.7)
            self._values = grey if colors is None else np.asarray(colors)

    def at(self, met: NDArray[np.integer[Any]], uv: Floats, distance: Floats) -> Floats:
        """Colours [N, 3] in places of faces."""
        u, v = uv.T
        weights = np.stack([1 - u - v, u, v], axis=1)
        values: Floats = np.einsum("nc,ncd->nd", weights, self._values[self._faces[met]])
        if self._texture is None:
            return values
        return self._texture.colors(values, self._density[met] * distance * self._angle)


def _look(scene: Any, eye: Floats, directions: Floats, paint: _Paint) -> tuple[Floats, Floats]:
    """Colours and shades [N, 3] of the first faces that look at the eye."""
    colored = np.full((len(directions), 3), _BACKGROUND)
    shaded = colored.copy()
    start = np.full(len(directions), 0.0)
    open_rays = np.arange(len(directions))
    for _ in range(_MAX_LAYERS):
        ways = directions[open_rays]
        origins = eye + start[open_rays, None] * ways
        rays = np.concatenate([origins, ways], axis=1).astype(np.float32)
        found = scene.cast_rays(_core.Tensor.from_numpy(rays))
        t, normals = found["t_hit"].numpy(), found["primitive_normals"].numpy()
        met = np.isfinite(t)
        facing = -(normals * ways).sum(axis=1)
        front = met & (facing > 0)
        rows, lit = open_rays[front], facing[front]
        colored[rows] = paint.at(
            found["primitive_ids"].numpy()[front],
            found["primitive_uvs"].numpy()[front],
            start[rows] + t[front],
        )
        shaded[rows] = (0.15 + 0.8 * lit**2)[:, None]
        behind = met & ~front
        start[open_rays[behind]] += t[behind] + 1e-4
        open_rays = open_rays[behind]
        if len(open_rays) == 0:
            break
    return colored, shaded
