"""A patterned pillar on patterned ground, houses far behind it, the sky above, seen all round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.nerf.stereo.views import StereoView

WIDTH, HEIGHT, FOCAL, NUM_VIEWS = 120, 160, 120.0, 10
DISTANCE, EYE_HEIGHT, RADIUS, TALL = 4.0, 1.5, 0.5, 3.0
"""Of the cameras, to the pillar and above the ground; the pillar's radius and height."""
HOUSES, HIGH = 30.0, 6.0
"""How far from the pillar the houses stand, in a ring, and how high they are."""
SKY_COLOR = (0.93, 0.95, 0.98)
UP = np.array([0.0, 0.0, 1.0])
NOTHING, ON_GROUND, ON_PILLAR, ON_HOUSES = range(4)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Seen:
    """A view, its picture in colour, its true depth [H, W], and what is where."""

    view: StereoView
    picture: NDArray[np.uint8]
    depth: NDArray[np.float32]
    what: NDArray[np.int64]

    @property
    def is_sky(self) -> Bools:
        """[H, W]."""
        sky: Bools = self.what == NOTHING
        return sky

    def known(self) -> DepthMap:
        """What matching says: all that is there, and the sky in the pillar's depth beside it."""
        column = np.arange(WIDTH)[None, :]
        beside = self.is_sky & (np.abs(column - WIDTH / 2) < WIDTH / 3)
        z = np.where(beside, np.float32(DISTANCE), self.depth)
        return DepthMap(z.astype(np.float32), np.where(z > 0, 3, 0).astype(np.uint8))


def walk_round(
    *, houses: float = HOUSES, sky: tuple[float, float, float] = SKY_COLOR
) -> list[Seen]:
    """Cameras all around. houses: how far they are. sky: its colour, sRGB."""
    return [
        _look(angle, houses, sky)
        for angle in np.linspace(0.0, 2.0 * np.pi, NUM_VIEWS, endpoint=False)
    ]


def _look(angle: float, houses: float, sky: tuple[float, float, float]) -> Seen:
    eye = np.array([DISTANCE * np.cos(angle), DISTANCE * np.sin(angle), EYE_HEIGHT])
    ahead = np.array([-np.cos(angle), -np.sin(angle), 0.1])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, UP)
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(ahead, right), ahead])
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float64(1.0)), axis=-1)
    rays = rays @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[..., 2] < 0, -EYE_HEIGHT / rays[..., 2], np.inf)
    pillar = _to_cylinder(eye, rays, RADIUS, TALL)[0]
    ring = _to_cylinder(eye, rays, houses, HIGH)[1]
    to = np.stack([np.full(ground.shape, 1e6), ground, pillar, ring])
    depth, what = to.min(axis=0), to.argmin(axis=0)
    place = eye + rays * depth[..., None]
    scale = np.where(what == ON_HOUSES, 0.15, 1.0)[..., None] * place
    pattern = 0.45 + 0.25 * np.sin(17.0 * scale[..., 0] + 9.0 * scale[..., 2]) * np.cos(
        15.0 * scale[..., 1] + 7.0 * scale[..., 2]
    )
    color = pattern[..., None] * np.array([1.0, 0.9, 0.8])
    color = np.where((what == NOTHING)[..., None], np.array(sky), color)
    pose = np.column_stack([rotation, eye])
    lens = FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2
    view = StereoView(color.mean(axis=-1).astype(np.float32), lens, pose)
    picture = np.rint(255.0 * color).astype(np.uint8)
    return Seen(view, picture, np.where(what == NOTHING, 0.0, depth).astype(np.float32), what)


def _to_cylinder(eye: Floats, rays: Floats, radius: float, height: float) -> tuple[Floats, Floats]:
    """How far rays go to an upright cylinder's side around the origin, from outside and inside."""
    a = (rays[..., :2] ** 2).sum(axis=-1)
    b = rays[..., :2] @ eye[:2]
    root = b * b - a * (eye[:2] @ eye[:2] - radius * radius)
    found = []
    for sign in (-1.0, 1.0):
        to = (-b + sign * np.sqrt(np.maximum(root, 0.0))) / a
        top = eye[2] + rays[..., 2] * to
        on = (root > 0) & (to > 1e-6) & (top >= 0.0) & (top <= height)
        found.append(np.where(on, to, np.inf))
    return found[0], found[1]
