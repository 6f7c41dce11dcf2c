"""A spiral before what the cameras look at, as forward-facing captures are shown.

Around the captured pose that is nearest to the mean of all, in that camera's own picture plane; the
camera looks at what is in its middle, and goes a little nearer and farther once on the way.

Source: LLFF, arXiv:1905.00889, its `render_path_spiral`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.paths.flight import Flight, looking_at
from pipelines.exports.paths.options import PathOptions
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.focus import find_focus

Floats = NDArray[np.float64]

_DEPTHS = 0.5
"""Of the radius, how far the camera goes nearer and farther."""


def spiral(
    images: Sequence[PosedImage], options: PathOptions, num_frames: int, mesh: Path | None = None
) -> Flight:
    """[num_frames] poses; the last is one step before the first."""
    del mesh
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    away = np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(axis=0), axis=1)
    turned = np.linalg.norm(poses[:, :, 2] - poses[:, :, 2].mean(axis=0), axis=1)
    middle = poses[int(np.argmin(away / max(away.max(), 1e-9) + turned))]
    focus = find_focus(poses)
    if focus is None:
        # Nobody knows how far things are: as far as the cameras are apart, twice.
        distance = max(2.0 * float(away.max()), 1e-3)
    else:
        distance = float(np.linalg.norm(middle[:, 3] - focus))
    target = middle[:, 3] - distance * middle[:, 2]
    share = np.arange(num_frames) / num_frames
    angle = 2.0 * np.pi * options.spiral.turns * share
    local = np.stack([np.cos(angle), np.sin(angle), _DEPTHS * np.sin(2.0 * np.pi * share)], axis=-1)
    places = middle[:, 3] + options.spiral.radius * distance * local @ middle[:, :3].T
    return Flight(looking_at(places, target, middle[:, 1]))
