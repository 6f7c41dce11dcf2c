"""nerfstudio's `camera_path.json`: its frames as they are, or its keyframes, expanded here.

Source: nerfstudio, `cameras/camera_paths.py` and `viewer/render_panel.py`, version 1.1.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.paths.flight import Flight
from pipelines.exports.paths.options import PathOptions
from pipelines.exports.paths.spline import through
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.rotations import quaternions, rotation_matrices

Floats = NDArray[np.float64]


def as_in_file(
    images: Sequence[PosedImage], options: PathOptions, num_frames: int, mesh: Path | None = None
) -> Flight:
    """The frames of the file, or so many along its keyframes where it has no other."""
    del images, mesh
    file = options.camera_path
    assert file is not None, "options were checked"
    if file.camera_path:
        poses = _poses([pose.camera_to_world for pose in file.camera_path])
        return Flight(poses, np.asarray([pose.fov for pose in file.camera_path]))
    return through(
        _poses([one.matrix for one in file.keyframes]),
        np.asarray([one.fov for one in file.keyframes]),
        np.asarray(file.transitions_s()),
        num_frames,
        tension=file.smoothness_value,
        loop=file.is_cycle,
    )


def _poses(matrices: Sequence[Sequence[float]]) -> Floats:
    """[N, 3, 4] of 4x4 matrices by rows, with exact rotations."""
    whole = np.asarray(matrices, np.float64).reshape(-1, 4, 4)[:, :3]
    rotation = rotation_matrices(quaternions(whole[:, :, :3]))
    poses: Floats = np.concatenate((rotation, whole[:, :, 3:]), axis=2)
    return poses
