"""Points of matched features beside the depth that a sensor measured: its scale, and how well both
agree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.sensor_depth import load_sensor_depth
from pipelines.sfm.given_refinement import Refined

_FEWEST = 100
"""Places compared, for the result to mean anything."""


def depth_ratio(
    found: Refined, lenses: Sequence[Intrinsics], depths: Sequence[Path | None]
) -> tuple[float, float] | None:
    """How many times as far away as measured points are, the median, and the median deviation from
    that, as a share; None where too few places have both.

    depths: N, the maps of `pipelines.scene.sensor_depth`; those that cannot be read count as none.
    """
    logs = []
    for image, path in enumerate(depths):
        mine = np.flatnonzero(found.seen.image == image)
        if path is None or not len(mine):
            continue
        try:
            measured = load_sensor_depth(path)
        except ValueError:
            continue
        pose, lens = found.poses[image], lenses[image]
        away = found.points[found.seen.track[mine]] - pose[:, 3]
        z = away @ pose[:, 2]
        height, width = measured.shape
        cells = (found.seen.xy[mine] * (width / lens.width, height / lens.height)).astype(np.int64)
        column, row = np.clip(cells, 0, (width - 1, height - 1)).T
        there = measured[row, column]
        known = (there > 0) & (z > 0)
        logs.append(np.log(z[known] / there[known]))
    ratios = np.concatenate(logs) if logs else np.zeros(0)
    if len(ratios) < _FEWEST:
        return None
    middle = float(np.median(ratios))
    return float(np.exp(middle)), float(np.median(np.abs(ratios - middle)))
