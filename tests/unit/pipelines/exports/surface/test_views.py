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
    ("wanted", "measured", "taken"),
    [
        ("auto", True, True),
        ("auto", False, False),
        ("on", False, True),
        ("off", True, False),
    ],
)
def test_maps_vote_where_a_sensor_measured_or_they_are_asked_to(
    tmp_path: Path, wanted: str, measured: bool, taken: bool
) -> None:
    workspace = Workspace(tmp_path)
    assert known_depths(workspace, wanted) is None, "there are no maps yet"
    folder = workspace.stage("depth")
    writer = DepthMapsWriter(folder)
    ones = np.ones((4, 6), np.float32)
    writer.append("a.jpg", Pinhole(6, 4, 5.0, 5.0, 3.0, 2.0), DepthMap(ones, ones.astype(np.uint8)))
    writer.close(measured=measured)
    (folder / MANIFEST).write_text('{"stage": "depth"}', "utf-8")
    known = known_depths(workspace, wanted)
    assert (known is not None) == taken
    if known is not None:
        assert known.measured == measured
