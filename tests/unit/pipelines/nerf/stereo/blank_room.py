"""A patterned floor that ends at a blank wall, seen by some cameras; or ends before nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.nerf.stereo.views import StereoView

WIDTH, HEIGHT, FOCAL = 240, 180, 165.0
FLOOR, WALL = 1.6, 4.0
"""y of the floor (down) and z of the wall."""


@dataclass(frozen=True)
class Seen:
    """A view, its true depth [H, W], and where the floor is."""

    view: StereoView
    depth: NDArray[np.float32]
    on_floor: NDArray[np.bool_]

    def known(self) -> DepthMap:
        """What stereo would know of it: the floor."""
        z = np.where(self.on_floor, self.depth, np.float32(0.0))
        return DepthMap(z, np.where(z > 0, 4, 0).astype(np.uint8))


def look(
    center: tuple[float, float, float],
    *,
    turn: float = 0.0,
    backdrop: float = WALL,
    box: tuple[float, float] | None = None,
    hung: tuple[float, float, float, float] | None = None,
) -> Seen:
    """A camera at a place, 12 degrees down, turned to the right by so many radians.

    backdrop: z of what is blank behind the floor, which ends at `WALL`. box: a blank board that
    hangs before the floor, upright, at that z and up to that y. hung: from x to x and from y to y,
    a patterned picture flat on the backdrop.
    """
    down = np.radians(12.0)
    tilt = np.array(
        [[1, 0, 0], [0, np.cos(down), np.sin(down)], [0, -np.sin(down), np.cos(down)]], np.float64
    )
    pan = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]], np.float64
    )
    rotation = pan @ tilt
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float64(1.0)), axis=-1)
    rays = rays @ rotation.T
    eye = np.array(center)
    with np.errstate(divide="ignore"):
        to_floor = np.where(rays[..., 1] > 1e-6, (FLOOR - eye[1]) / rays[..., 1], np.inf)
        to_blank = np.where(rays[..., 2] > 1e-6, (backdrop - eye[2]) / rays[..., 2], np.inf)
    to_floor = np.where(to_floor * rays[..., 2] + eye[2] <= WALL, to_floor, np.inf)
    depth, on_floor = np.minimum(to_floor, to_blank), to_floor < to_blank
    place = eye + rays * np.where(on_floor, to_floor, 0.0)[..., None]
    pattern = 0.45 + 0.3 * np.sin(9.0 * place[..., 0] + 2.0 * np.sin(5.0 * place[..., 2])) * np.cos(
        8.0 * place[..., 2]
    )
    picture = np.where(on_floor, pattern, 0.9 + 0.03 * x[None, :])
    if hung is not None:
        shows = is_hung(eye + rays * to_blank[..., None], hung) & ~on_floor
        place = eye + rays * np.where(shows, to_blank, 0.0)[..., None]
        painted = 0.45 + 0.3 * np.sin(11.0 * place[..., 0]) * np.cos(9.0 * place[..., 1])
        picture = np.where(shows, painted, picture)
    if box is not None:
        to_box = np.where(rays[..., 2] > 1e-6, (box[0] - eye[2]) / rays[..., 2], np.inf)
        hit = eye + rays * np.where(np.isfinite(to_box), to_box, 0.0)[..., None]
        shows = (np.abs(hit[..., 0]) < 0.5) & (hit[..., 1] < box[1]) & (hit[..., 1] > box[1] - 0.9)
        shows &= to_box < depth
        depth, on_floor = np.where(shows, to_box, depth), on_floor & ~shows
        picture = np.where(shows, 0.15, picture)
    pose = np.column_stack([rotation, eye])
    view = StereoView(picture.astype(np.float32), (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), pose)
    return Seen(view, np.where(np.isfinite(depth), depth, 0.0).astype(np.float32), on_floor)


def is_hung(
    places: NDArray[np.float64], hung: tuple[float, float, float, float]
) -> NDArray[np.bool_]:
    """Which places [..., 3] on the backdrop are the picture's."""
    low_x, high_x, low_y, high_y = hung
    x, y = places[..., 0], places[..., 1]
    shows: NDArray[np.bool_] = (low_x < x) & (x < high_x) & (low_y < y) & (y < high_y)
    return shows


def walk() -> list[tuple[float, float, float]]:
    """Where eight cameras are that come nearer to the wall, and not straight."""
    return [(-0.8 + 0.22 * i, -0.1 * (i % 3), 0.18 * i) for i in range(8)]
