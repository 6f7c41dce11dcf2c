"""A capture with cameras of every lens, for tests of what exports them."""

from __future__ import annotations

import numpy as np

from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from tests.unit.pipelines.scene.synthetic_views import look_at

PINHOLE = Intrinsics(640, 480, 512.25, 510.5, 318.75, 243.125)
OPENCV = Intrinsics(
    1080, 1920, 1375.52, 1374.49, 554.558, 965.268, "OPENCV", 0.0578, -0.0805, 0.0, 0.0, -1e-3, 2e-4
)
FULL = Intrinsics(800, 600, 700.0, 690.0, 410.0, 290.0, "OPENCV", 0.1, -0.05, 0.01, 0.0, 1e-3, 2e-3)
FISHEYE = Intrinsics(
    1000, 1000, 330.0, 331.0, 502.0, 497.0, "OPENCV_FISHEYE", 0.02, -0.01, 0.003, -0.0007
)


def posed(*lenses: Intrinsics, num: int = 12, masks: bool = False) -> CamerasFile:
    """Cameras in a helix around (3, -2, 1), every fourth held out, lenses in turn."""
    images = []
    for index in range(num):
        angle = 0.7 * index
        place = np.array([3.0 + 2.0 * np.cos(angle), -2.0 + 2.0 * np.sin(angle), 0.5 + 0.1 * index])
        pose = look_at(place, np.array([3.0, -2.0, 1.0]))
        # Rolled by a quarter turn for every third: no axis may be mistaken for another.
        roll = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        if index % 3 == 2:
            pose[:, :3] = pose[:, :3] @ roll
        images.append(
            PosedImage(
                file=f"images/{index + 1:05d}.jpg",
                camera=index % len(lenses),
                world_from_camera=tuple(tuple(float(v) for v in row) for row in pose),
                timestamp_s=0.25 * index,
                split="test" if index % 4 == 3 else "train",
                mask=f"masks/{index + 1:05d}.png" if masks else None,
            )
        )
    return CamerasFile(cameras=lenses, images=tuple(images), source="test")
