"""How well the depth of one frame agrees with that of another: what shows that poses, lenses and
depth of an import fit together, on captures whose truth nobody knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.sensor_depth import load_sensor_depth

_LEAST_SHARED = 300
"""Pixels; what two frames share below says nothing."""


def disagreement(file: CamerasFile, root: Path, step: int) -> float:
    """Median over frames of the median relative difference between the depth of a frame seen from
    the one `step` later, and that one's own. Of a wrong convention it is 0.1 and more.

    root: folder that the paths of depth are relative to.
    """
    found = []
    for index in range(len(file.images) - step):
        seen, measured = _shared(file, root, index, index + step)
        if len(seen) >= _LEAST_SHARED:
            found.append(float(np.median(np.abs(seen - measured) / measured)))
    assert len(found) >= (len(file.images) - step) // 2, "most frames share nothing"
    return float(np.median(found))


def _shared(
    file: CamerasFile, root: Path, source: int, target: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths of the source's pixels as the target should see them, and as it does. [P] each."""
    world = _points(file, root, source)
    image = file.images[target]
    lens, pose = file.cameras[image.camera], pose_matrix(image)
    z = load_sensor_depth(root / str(image.depth))
    local = (world - pose[:, 3]) @ pose[:, :3]
    local = local[local[:, 2] < -0.05]
    depth = -local[:, 2]
    x = (lens.fl_x * local[:, 0] / depth + lens.cx) * z.shape[1] / lens.width
    y = (-lens.fl_y * local[:, 1] / depth + lens.cy) * z.shape[0] / lens.height
    inside = (x >= 0) & (x < z.shape[1]) & (y >= 0) & (y < z.shape[0])
    measured = z[y[inside].astype(int), x[inside].astype(int)].astype(np.float64)
    known = measured > 0
    return depth[inside][known], measured[known]


def _points(file: CamerasFile, root: Path, index: int) -> NDArray[np.float64]:
    """What the depth of a frame shows, [P, 3] in the world."""
    image = file.images[index]
    lens, pose = file.cameras[image.camera], pose_matrix(image)
    z = load_sensor_depth(root / str(image.depth))
    v, u = np.nonzero(z)
    depth = z[v, u].astype(np.float64)
    x = (u + 0.5) * lens.width / z.shape[1]
    y = (v + 0.5) * lens.height / z.shape[0]
    local = np.stack(
        [(x - lens.cx) / lens.fl_x * depth, -(y - lens.cy) / lens.fl_y * depth, -depth], axis=1
    )
    world: NDArray[np.float64] = local @ pose[:, :3].T + pose[:, 3]
    return world
