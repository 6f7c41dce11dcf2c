"""How far apart two cameras are, before anything is known of what they show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def apart(poses: Floats, index: int) -> Floats:
    """How far cameras are from one of them, [N]: 1 is 30 degrees between their axes, or a quarter
    of the path's extent. poses: [N, 3, 4], whatever their axes but for Z along the gaze."""
    centers, axes = poses[:, :, 3], poses[:, :, 2]
    with np.errstate(over="ignore", invalid="ignore"):
        gaps = np.linalg.norm(centers - centers[index], axis=1)
        extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
        angles = np.degrees(np.arccos(np.clip(axes @ axes[index], -1.0, 1.0)))
        found: Floats = np.hypot(angles / 30.0, 4.0 * gaps / max(extent, 1e-12))
    return np.nan_to_num(found)
