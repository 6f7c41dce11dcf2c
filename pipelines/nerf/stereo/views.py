"""What stereo looks at: undistorted grey pictures with their cameras.

Cameras here are OpenCV's (+X right, +Y down, +Z forward), in world units, float64; the centre of
the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StereoView:
    """picture: [H, W] float32, brightness in [0, 1], negative where there is none.

    lens: fx, fy, cx, cy in px. world_from_camera: [3, 4].
    """

    picture: NDArray[np.float32]
    lens: tuple[float, float, float, float]
    world_from_camera: Floats

    @property
    def center(self) -> Floats:
        """[3], where the camera is."""
        return self.world_from_camera[:, 3]

    @property
    def axis(self) -> Floats:
        """[3], unit, where it looks."""
        return self.world_from_camera[:, 2]

    def matrix(self) -> Floats:
        """[3, 3], for pixel centres at integers."""
        fx, fy, cx, cy = self.lens
        return np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """x of each column [W] and y of each row [H] at z = 1."""
        fx, fy, cx, cy = self.lens
        height, width = self.picture.shape
        x = (np.arange(width) + 0.5 - cx) / fx
        y = (np.arange(height) + 0.5 - cy) / fy
        return x.astype(np.float32), y.astype(np.float32)

    def from_other(self, other: StereoView) -> NDArray[np.float32]:
        """[3, 4], from the other camera's frame to this one's."""
        turn = self.world_from_camera[:, :3].T
        rotation = turn @ other.world_from_camera[:, :3]
        shift = turn @ (other.center - self.center)
        return np.column_stack([rotation, shift]).astype(np.float32)

    def seen(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths [P] of world points [P, 3], and which of them the picture shows."""
        z, _, _, shown = self.projected(points)
        return z, shown

    def seen_at(self, points: Floats) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
        """Depths, rows and columns, [S] each, of the world points [P, 3] that the picture shows."""
        z, u, v, shown = self.projected(points)
        return z[shown], v[shown].astype(np.int64), u[shown].astype(np.int64)

    def shown_at(
        self, points: Floats
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Which of the world points [P, 3] the picture shows, [S], and their rows and columns."""
        _, u, v, shown = self.projected(points)
        return np.flatnonzero(shown), v[shown].astype(np.int64), u[shown].astype(np.int64)

    def projected(self, points: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """z, u and v [P] of world points [P, 3], and which of them the picture shows."""
        local = (points - self.center) @ self.world_from_camera[:, :3]
        z = local[:, 2]
        safe = np.where(z > 0, z, np.inf)
        fx, fy, cx, cy = self.lens
        u, v = fx * local[:, 0] / safe + cx, fy * local[:, 1] / safe + cy
        height, width = self.picture.shape
        return z, u, v, (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)

    def reduced(self, factor: int) -> StereoView:
        """The view at 1 / factor of its size; squares that are not whole have no picture."""
        height, width = (side // factor * factor for side in self.picture.shape)
        squares = self.picture[:height, :width].reshape(
            height // factor, factor, width // factor, factor
        )
        mean = squares.mean(axis=(1, 3), dtype=np.float32)
        mean[squares.min(axis=(1, 3)) < 0] = -1.0
        fx, fy, cx, cy = (value / factor for value in self.lens)
        return StereoView(mean, (fx, fy, cx, cy), self.world_from_camera)


def camera_extent(views: Sequence[StereoView]) -> float:
    """The largest distance between two cameras, world units; 1 for cameras in one place."""
    centers = np.array([view.center for view in views])
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return 2.0 * spread if spread > 0 else 1.0
