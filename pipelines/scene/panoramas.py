"""Panoramas of the whole sphere, and the plain views that stand for them behind `poses`.

A panorama is equirectangular: columns are longitudes, rows latitudes, twice as wide as high. Poses
are found for the panorama itself (COLMAP has that camera model), so the views cut from it hang
together as a rig without any error of their own: `world_from_view` is a rotation of its pose.
Everything behind, which knows plain lenses, is trained on the views.

Camera axes here are OpenCV's (+X right, +Y down, +Z forward): the middle of a panorama looks along
+Z, as in `pipelines.nerf.space.lenses`. A view is square and 90 degrees wide, so that four stand
around the horizon edge to edge, and two more close the sphere.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.cameras_file import Intrinsics

MODEL = "EQUIRECTANGULAR"
LEVEL, WHOLE = 4, 6
"""Numbers of views that there are: around the horizon alone, or those and up and down."""
MIN_WIDTH_PX = 256

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


def is_whole(width: int, height: int) -> bool:
    """Whether a picture of that size can be a panorama of the whole sphere; a pixel counts not."""
    return height > 0 and abs(width - 2 * height) <= 2


def panorama_lens(width: int, height: int) -> Intrinsics:
    """A panorama as a camera: found poses are of such, files for later stages never."""
    return Intrinsics(width, height, width / 2, float(height), width / 2, height / 2, MODEL)


def view_side(width: int) -> int:
    """Pixels along a view's side: in its middle as fine as the panorama of that width is."""
    return max(2, round(width / math.pi / 2) * 2)


def view_lens(width: int) -> Intrinsics:
    """The lens of all views cut from a panorama of that width."""
    side = view_side(width)
    half = side / 2
    return Intrinsics(side, side, half, half, half, half)


def pano_from_views(num: int) -> list[Floats]:
    """Rotations [3, 3] from each view to its panorama: ahead, right, behind, left, up, down."""
    turns = [_about_y(90.0 * k) for k in range(LEVEL)] + [_about_x(90.0), _about_x(-90.0)]
    return turns[:num]


def cut_views(panorama: Picture, num: int) -> list[Picture]:
    """The views of a panorama [H, W, 3] uint8, [S, S, 3] each, between pixels linearly."""
    height, width = panorama.shape[:2]
    # A column more on both sides joins the ends; beyond a pole its own row is repeated.
    padded = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    return [_sampled(padded, *places) for places in _places(width, height, num)]


def world_from_views(world_from_camera: Floats, num: int) -> list[Floats]:
    """Poses [3, 4] of a panorama's views, of its own; OpenCV axes."""
    turn, center = world_from_camera[:, :3], world_from_camera[:, 3:]
    return [np.hstack([turn @ rotation, center]) for rotation in pano_from_views(num)]


@functools.lru_cache(maxsize=2)
def _places(width: int, height: int, num: int) -> Sequence[tuple[NDArray[np.float32], ...]]:
    """Where each view's pixels lie in the padded panorama: columns and rows, [S, S] float32 each,
    pixel centres at integers."""
    side = view_side(width)
    across = (np.arange(side) + 0.5) / (side / 2) - 1.0
    x, y = np.meshgrid(across, across)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    found = []
    for rotation in pano_from_views(num):
        turned = rays @ rotation.T
        longitude = np.arctan2(turned[..., 0], turned[..., 2])
        latitude = np.arctan2(-turned[..., 1], np.hypot(turned[..., 0], turned[..., 2]))
        columns = (longitude / (2 * np.pi) + 0.5) * width - 0.5 + 1.0
        rows = np.clip((0.5 - latitude / np.pi) * height - 0.5, 0.0, height - 1.0)
        found.append((columns.astype(np.float32), rows.astype(np.float32)))
    return found


def _sampled(padded: Picture, columns: NDArray[np.float32], rows: NDArray[np.float32]) -> Picture:
    height, width = padded.shape[:2]
    i = np.clip(columns.astype(np.int32), 0, width - 2)
    j = np.clip(rows.astype(np.int32), 0, height - 2)
    u, v = (columns - i)[..., None], (rows - j)[..., None]
    top = padded[j, i] * (1 - u) + padded[j, i + 1] * u
    bottom = padded[j + 1, i] * (1 - u) + padded[j + 1, i + 1] * u
    values: Picture = np.rint(top * (1 - v) + bottom * v).astype(np.uint8)
    return values


def _about_y(degrees: float) -> Floats:
    """A turn to the right."""
    c, s = _cos_sin(degrees)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _about_x(degrees: float) -> Floats:
    """A turn upwards."""
    c, s = _cos_sin(degrees)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _cos_sin(degrees: float) -> tuple[float, float]:
    angle = math.radians(degrees)
    return round(math.cos(angle), 15), round(math.sin(angle), 15)
