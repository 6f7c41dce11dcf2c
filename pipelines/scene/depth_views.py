"""Views with depth: what point clouds and meshes are made from.

A `DepthView` is an undistorted (pinhole) picture of a trained scene with z-depth, in the world
frame: OpenGL camera, pixel centres at +0.5, x right, y down, z-depth = distance along the camera's
-Z axis, 0 where nothing is known. Shapes: [H, W]. `ViewStore` keeps any number of them on disk, so
that memory does not grow with the capture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from pipelines.scene.cameras_file import Intrinsics

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MIN_ACCUMULATION = 0.5
"""Rays that gather less opacity than this met no surface."""
_MAX_FOV_DEG = 110.0
_MEDIAN_TRUST = 0.05
_STEEPEST_SLOPE = 10.0
_SMALLEST_JUMP = 0.02


@dataclass(frozen=True)
class Pinhole:
    """An undistorted lens; lengths in pixels."""

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float

    @classmethod
    def of(cls, lens: Intrinsics, long_side_px: int, multiple: int = 1) -> Pinhole:
        """The lens without its distortion, with this long side; sides are multiples of `multiple`.

        A fisheye's field of view is cut to 110 degrees, which a plane can still show.
        """
        shrink = long_side_px / max(lens.width, lens.height)
        width = max(multiple, round(lens.width * shrink / multiple) * multiple)
        height = max(multiple, round(lens.height * shrink / multiple) * multiple)
        sx, sy = width / lens.width, height / lens.height
        least = max(lens.width, lens.height) / 2.0 / math.tan(math.radians(_MAX_FOV_DEG / 2.0))
        zoom = max(1.0, least / min(lens.fl_x, lens.fl_y))
        return cls(
            width, height, lens.fl_x * sx * zoom, lens.fl_y * sy * zoom, lens.cx * sx, lens.cy * sy
        )

    def intrinsics(self) -> Intrinsics:
        """The same as a lens of `cameras.json`."""
        return Intrinsics(self.width, self.height, self.fl_x, self.fl_y, self.cx, self.cy)

    def directions(self) -> Floats:
        """[H, W, 3] rays in camera coordinates, scaled so that -z = 1."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fl_x
        y = -(np.arange(self.height) + 0.5 - self.cy) / self.fl_y
        grid: Floats = np.stack(
            np.broadcast_arrays(x[None, :], y[:, None], np.float64(-1.0)), axis=-1
        )
        return grid

    def matrix(self) -> Floats:
        """[3, 3], for OpenCV's x right, y down, z forward and pixel centres at +0.5."""
        return np.array(
            [[self.fl_x, 0.0, self.cx], [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]], np.float64
        )


@dataclass(frozen=True)
class DepthView:
    """rgb: [H, W, 3] uint8, sRGB. z_depth: [H, W] float32, world units, 0 where unknown.

    is_partial: whether what is unknown may be anything, as in a map of what could be matched or
    measured; else nothing stands there.
    """

    lens: Pinhole
    world_from_camera: Floats
    rgb: NDArray[np.uint8]
    z_depth: NDArray[np.float32]
    is_partial: bool = False

    def points(self) -> Floats:
        """[H, W, 3] world positions; meaningless where `z_depth` is 0."""
        local = self.lens.directions() * self.z_depth[..., None].astype(np.float64)
        world: Floats = local @ self.world_from_camera[:, :3].T + self.world_from_camera[:, 3]
        return world

    def seen_at(self, points: NDArray[np.floating]) -> tuple[Floats, Floats]:
        """Depths [P] of world points [P, 3], and what the view shows at their pixels [P]: depths,
        0 where unknown, and NaN for points that are not in the picture.
        """
        local = (points - self.world_from_camera[:, 3]) @ self.world_from_camera[:, :3]
        depth, lens = -local[:, 2], self.lens
        before = depth > 0.0
        safe = np.where(before, depth, 1.0)
        column = np.floor(lens.fl_x * local[:, 0] / safe + lens.cx)
        row = np.floor(-lens.fl_y * local[:, 1] / safe + lens.cy)
        inside = before & (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
        shown = np.full(len(points), np.nan)
        shown[inside] = self.z_depth[row[inside].astype(int), column[inside].astype(int)]
        return depth, shown

    def camera_from_world_cv(self, origin: Floats) -> Floats:
        """[4, 4] from (world - origin) to the OpenCV camera (y down, z forward)."""
        rotation = self.world_from_camera[:, :3] @ np.diag([1.0, -1.0, -1.0])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T
        matrix[:3, 3] = -rotation.T @ (self.world_from_camera[:, 3] - origin)
        return matrix

    def smooth_mask(self) -> Bools:
        """[H, W] true where depth is known and no neighbour is nearer by a jump.

        At a jump a pixel's depth may lie between two surfaces, on neither: such a pixel is the
        farther one of a pair, and so is the first of what lies behind. The last one of what lies
        before stays, or the edges of things would be eaten away. A jump is a step steeper than a
        surface seen at 84 degrees, and at least 2 % of the depth. Beside what is unknown depth may
        be wrong, too; but where nothing stands, a thing of a pixel or two has no other pixels.
        """
        angle = 1.0 / min(self.lens.fl_x, self.lens.fl_y)
        return without_jumps(self.z_depth, angle, keep_thin=not self.is_partial)


def without_jumps(depth: NDArray[np.floating], angle: float, *, keep_thin: bool = False) -> Bools:
    """`DepthView.smooth_mask` of any depth [H, W]. angle: between neighbouring pixels, radians.

    keep_thin: pixels beside unknown ones stay where none that is not lies in the 3x3 around them.
    """
    limit = max(_SMALLEST_JUMP, _STEEPEST_SLOPE * angle)
    known = depth > 0
    good, inner = known.copy(), known.copy()
    for axis in (0, 1):
        near, far = [slice(None)] * 2, [slice(None)] * 2
        near[axis], far[axis] = slice(None, -1), slice(1, None)
        a, b = depth[tuple(near)], depth[tuple(far)]
        both = known[tuple(near)] & known[tuple(far)]
        jump = both & (np.abs(a - b) > limit * np.minimum(a, b))
        good[tuple(near)] &= ~jump | (a < b)
        good[tuple(far)] &= ~jump | (b < a)
        inner[tuple(near)] &= known[tuple(far)]
        inner[tuple(far)] &= known[tuple(near)]
    inner &= good
    if keep_thin:
        inner |= good & ~binary_dilation(inner, np.ones((3, 3), np.bool_))
    return inner


def z_depth_of(
    lens: Pinhole,
    median: NDArray[np.floating],
    expected: NDArray[np.floating],
    accumulation: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Z-depth of the surface from distances along the rays, as of `surface_distance`."""
    distance = surface_distance(median, expected, accumulation)
    z: NDArray[np.float32] = (distance / np.linalg.norm(lens.directions(), axis=-1)).astype(
        np.float32
    )
    return z


def surface_distance(
    median: NDArray[np.floating],
    expected: NDArray[np.floating],
    accumulation: NDArray[np.floating],
) -> Floats:
    """How far along each ray the surface is.

    median, expected: [H, W] distances in world units; accumulation: [H, W] in [0, 1]. The expected
    distance is smooth but is pulled away where a ray meets two surfaces; the median is steady but
    quantised by the samples. So: the expected one where both agree within 5 %, else the median.
    Returns [H, W], 0 where the ray met no surface.
    """
    agree = np.abs(expected - median) <= _MEDIAN_TRUST * median
    distance = np.where(agree, expected, median)
    known = (accumulation >= MIN_ACCUMULATION) & np.isfinite(distance) & (distance > 0)
    found: Floats = np.where(known, distance, 0.0)
    return found


class ViewStore:
    """Depth views in files, read one at a time and as often as wanted."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._cameras: list[tuple[Pinhole, Floats, bool]] = []

    def __len__(self) -> int:
        return len(self._cameras)

    def append(self, view: DepthView) -> None:
        """Write one more view."""
        index = len(self._cameras)
        np.save(self._folder / f"{index:06d}.rgb.npy", view.rgb)
        np.save(self._folder / f"{index:06d}.z.npy", view.z_depth)
        self._cameras.append((view.lens, view.world_from_camera, view.is_partial))

    def __getitem__(self, index: int) -> DepthView:
        lens, pose, is_partial = self._cameras[index]
        return DepthView(
            lens=lens,
            world_from_camera=pose,
            rgb=np.load(self._folder / f"{index:06d}.rgb.npy"),
            z_depth=np.load(self._folder / f"{index:06d}.z.npy"),
            is_partial=is_partial,
        )

    def __iter__(self) -> Iterator[DepthView]:
        for index in range(len(self)):
            yield self[index]
