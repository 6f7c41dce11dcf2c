"""A white table on a patterned floor, with a patterned box on it, seen by some cameras; or a
patterned chest before a white wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.morphology import dilation, disk
from skimage.segmentation import expand_labels

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.nerf.stereo.views import StereoView

WIDTH, HEIGHT, FOCAL = 240, 180, 190.0
FLOOR, TOP, RADIUS, MIDDLE = 1.6, 0.8, 0.75, np.array([0.0, 0.8, 2.4])
"""y of the floor and of the table's top (down), which is round; its middle."""
BOX = np.array([[-0.1, 0.45, 2.3], [0.1, 0.8, 2.5]])
CHEST = np.array([[-0.8, 0.8, 2.2], [0.8, 1.6, 2.7]])
WALL = 2.8
"""z of the wall behind the chest."""
REACH_PX = 5
NOTHING, ON_FLOOR, ON_TABLE, ON_BOX, ON_WALL = range(5)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Seen:
    """A view, its true depth [H, W], and what is where."""

    view: StereoView
    depth: NDArray[np.float32]
    what: NDArray[np.int64]

    @property
    def on_table(self) -> Bools:
        """[H, W]."""
        on: Bools = self.what == ON_TABLE
        return on

    def known(self) -> DepthMap:
        """What stereo would know: all but the plain top, its rim, and some of its pixels beside the
        box with the box's depth.
        """
        plain = np.isin(self.what, (ON_TABLE, ON_WALL))
        z = np.where(plain, np.float32(0.0), self.depth)
        beside_floor = dilation(np.isin(self.what, (ON_FLOOR, NOTHING)), disk(REACH_PX))
        z = np.where(plain & beside_floor & self.on_table, self.depth, z)
        z = np.where(plain & self.beside_box, self._nearest_box_depth(), z)
        return DepthMap(z.astype(np.float32), np.where(z > 0, 4, 0).astype(np.uint8))

    @property
    def beside_box(self) -> Bools:
        """[H, W]: what matching gives the box's depth."""
        near: Bools = dilation(self.what == ON_BOX, disk(REACH_PX)) & (self.what != ON_BOX)
        return near

    def _nearest_box_depth(self) -> NDArray[np.float32]:
        places = np.arange(self.depth.size).reshape(self.depth.shape) + 1
        nearest = expand_labels(np.where(self.what == ON_BOX, places, 0), 2 * REACH_PX)
        return self.depth.ravel()[nearest - 1]


def walk_round(chest: bool = False) -> list[Seen]:
    """Eight cameras in an arc before the table, or the chest."""
    around = np.radians(np.linspace(-35.0, 35.0, 8))
    return [
        look(MIDDLE + 2.4 * np.array([np.sin(a), -0.45 - 0.03 * k, -np.cos(a)]), chest=chest)
        for k, a in enumerate(around)
    ]


def look(eye: Floats, *, chest: bool = False) -> Seen:
    """A camera at a place that looks at the middle."""
    ahead = (MIDDLE - eye) / np.linalg.norm(MIDDLE - eye)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(ahead, right), ahead])
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float64(1.0)), axis=-1)
    rays = rays @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = _ahead((FLOOR - eye[1]) / rays[..., 1])
        to = [np.full(floor.shape, 1e3), floor]
        if chest:
            wall = _ahead((WALL - eye[2]) / rays[..., 2])
            to += [np.full(floor.shape, 1e3), _to_box(eye, rays, CHEST), wall]
        else:
            top = _ahead((TOP - eye[1]) / rays[..., 1])
            place = eye + rays * np.minimum(top, 1e3)[..., None]
            off = np.linalg.norm((place - MIDDLE)[..., [0, 2]], axis=-1) > RADIUS
            to += [np.where(off, np.inf, top), _to_box(eye, rays, BOX), np.full(floor.shape, 1e3)]
    depth = np.min(to, axis=0)
    what = np.argmin(to, axis=0)
    place = eye + rays * depth[..., None]
    pattern = 0.45 + 0.3 * np.sin(17.0 * place[..., 0] + 9.0 * place[..., 1]) * np.cos(
        15.0 * place[..., 2] + 2.0 * np.sin(11.0 * place[..., 0])
    )
    picture = np.where(np.isin(what, (ON_TABLE, ON_WALL, NOTHING)), 0.95, pattern)
    picture = np.where(what == NOTHING, 0.1, picture)
    pose = np.column_stack([rotation, eye])
    view = StereoView(picture.astype(np.float32), (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), pose)
    return Seen(view, np.where(depth < 1e3, depth, 0.0).astype(np.float32), what)


def _ahead(distance: Floats) -> Floats:
    return np.where(distance > 1e-6, distance, np.inf)


def _to_box(eye: Floats, rays: Floats, box: Floats) -> Floats:
    low, high = (box[0] - eye) / rays, (box[1] - eye) / rays
    near = np.minimum(low, high).max(axis=-1)
    far = np.maximum(low, high).min(axis=-1)
    return np.where((near > 1e-6) & (near < far), near, np.inf)
