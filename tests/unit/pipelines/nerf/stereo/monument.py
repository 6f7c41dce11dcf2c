"""A patterned pillar on patterned ground, houses far behind it, the sky above, seen all round.

Or by one lamp in the dark, on a patterned disc.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.nerf.stereo.planes import ray_grid
from pipelines.nerf.stereo.views import StereoView

WIDTH, HEIGHT, FOCAL, NUM_VIEWS = 120, 160, 120.0, 10
DISTANCE, EYE_HEIGHT, RADIUS, TALL = 4.0, 1.5, 0.5, 3.0
"""Of the cameras, to the pillar and above the ground; the pillar's radius and height."""
HOUSES, HIGH = 30.0, 6.0
"""How far from the pillar the houses stand, in a ring, and how high they are."""
SKY_COLOR = (0.93, 0.95, 0.98)
BLACK = (0.02, 0.02, 0.03)
DISC, LAMP = 1.6, (1.0, 0.3)
"""Radius of what the pillar stands on in the dark, and the way, on the ground, to its lamp."""
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
    def is_void(self) -> Bools:
        """[H, W], where nothing stands."""
        void: Bools = self.what == NOTHING
        return void

    def known(self) -> DepthMap:
        """What matching says: all that is there, and nothing in the pillar's depth beside it."""
        column = np.arange(WIDTH)[None, :]
        beside = self.is_void & (np.abs(column - WIDTH / 2) < WIDTH / 3)
        z = np.where(beside, np.float32(DISTANCE), self.depth)
        return DepthMap(z.astype(np.float32), np.where(z > 0, 3, 0).astype(np.uint8))


def walk_round(
    *,
    houses: float = HOUSES,
    sky: tuple[float, float, float] = SKY_COLOR,
    num_views: int = NUM_VIEWS,
) -> list[Seen]:
    """Cameras all around. houses: how far they are. sky: its colour, sRGB."""
    return [
        _look(angle, houses, sky)
        for angle in np.linspace(0.0, 2.0 * np.pi, num_views, endpoint=False)
    ]


def in_the_dark(
    *, lamp: tuple[float, float] | None = None, num_views: int = NUM_VIEWS
) -> list[Seen]:
    """Cameras all around. lamp: the way to it: what looks away from it is black. None lights all of
    the pillar.
    """
    seen = walk_round(houses=0.0, sky=BLACK, num_views=num_views)
    return [_unlit(one, lamp) for one in seen]


def _unlit(one: Seen, lamp: tuple[float, float] | None) -> Seen:
    """The view without light beyond the disc, and on what looks away from the lamp."""
    place = one.view.center + rays_of(one.view) * one.depth[..., None].astype(np.float64)
    off = (one.what == ON_GROUND) & (np.linalg.norm(place[..., :2], axis=-1) > DISC)
    what, depth = np.where(off, NOTHING, one.what), np.where(off, np.float32(0.0), one.depth)
    black = what == NOTHING
    if lamp is not None:
        black |= (what == ON_PILLAR) & (place[..., :2] @ np.array(lamp) < 0.0)
    picture = np.where(black[..., None], np.rint(255.0 * np.array(BLACK)), one.picture)
    grey = (picture.mean(axis=-1) / 255.0).astype(np.float32)
    return Seen(replace(one.view, picture=grey), picture.astype(np.uint8), depth, what)


def _look(angle: float, houses: float, sky: tuple[float, float, float]) -> Seen:
    eye = np.array([DISTANCE * np.cos(angle), DISTANCE * np.sin(angle), EYE_HEIGHT])
    ahead = np.array([-np.cos(angle), -np.sin(angle), 0.1])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, UP)
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(ahead, right), ahead])
    blank = np.zeros((HEIGHT, WIDTH), np.float32)
    lens = FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2
    view = StereoView(blank, lens, np.column_stack([rotation, eye]))
    rays = rays_of(view)
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[..., 2] < 0, -EYE_HEIGHT / rays[..., 2], np.inf)
    pillar = _to_cylinder(eye, rays, RADIUS, TALL)[0]
    ring = _to_cylinder(eye, rays, houses, HIGH)[1] if houses else np.full(ground.shape, np.inf)
    to = np.stack([np.full(ground.shape, 1e6), ground, pillar, ring])
    depth, what = to.min(axis=0), to.argmin(axis=0)
    place = eye + rays * depth[..., None]
    scale = np.where(what == ON_HOUSES, 0.15, 1.0)[..., None] * place
    pattern = 0.45 + 0.25 * np.sin(17.0 * scale[..., 0] + 9.0 * scale[..., 2]) * np.cos(
        15.0 * scale[..., 1] + 7.0 * scale[..., 2]
    )
    color = pattern[..., None] * np.array([1.0, 0.9, 0.8])
    color = np.where((what == NOTHING)[..., None], np.array(sky), color)
    view = replace(view, picture=color.mean(axis=-1).astype(np.float32))
    picture = np.rint(255.0 * color).astype(np.uint8)
    return Seen(view, picture, np.where(what == NOTHING, 0.0, depth).astype(np.float32), what)


def rays_of(view: StereoView) -> Floats:
    """[H, W, 3], world, one along the camera's axis."""
    x, y = ray_grid(view)
    local = np.stack(np.broadcast_arrays(x, y, np.float64(1.0)), axis=-1)
    rays: Floats = local @ view.world_from_camera[:, :3].T
    return rays


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
