"""Which maps vote beside the field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.exports.surface.views import known_depths
from pipelines.nerf.stereo.maps import DepthMap
from pipelines.scene.depth_maps_file import DepthMapsWriter
from pipelines.scene.depth_views import Pinhole
from pipelines.workspace import MANIFEST, Workspace


@pytest.mark.parametrize(
    ("wanted", "measured", "count", "taken"),
    [
        ("auto", True, 40, True),
        ("auto", False, 40, False),
        ("auto", False, 39, True),
        ("on", False, 40, True),
        ("off", True, 39, False),
    ],
)
def test_maps_vote_where_a_sensor_measured_or_they_are_few_or_asked_to(
    tmp_path: Path, wanted: str, measured: bool, count: int, taken: bool
) -> None:
    workspace = Workspace(tmp_path)
    assert known_depths(workspace, wanted) is None, "there are no maps yet"
    folder = workspace.stage("depth")
    writer = DepthMapsWriter(folder)
    ones = np.ones((4, 6), np.float32)
    for index in range(count):
        found = DepthMap(ones, ones.astype(np.uint8))
        writer.append(f"{index}.jpg", Pinhole(6, 4, 5.0, 5.0, 3.0, 2.0), found)
    writer.close(measured=measured)
    (folder / MANIFEST).write_text('{"stage": "depth"}', "utf-8")
    known = known_depths(workspace, wanted)
    assert (known is not None) == taken
    if known is not None:
        assert known.measured == measured
