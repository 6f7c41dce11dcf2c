"""Which maps vote beside the field, and that nobody votes on what a mask hides."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.exports.surface.views import known_depths, render_views
from pipelines.nerf.stereo.maps import DepthMap
from pipelines.scene.depth_maps_file import DepthMapsWriter
from pipelines.scene.depth_views import Pinhole
from pipelines.stage import StageContext
from pipelines.workspace import MANIFEST, Workspace
from tests.unit.pipelines.exports.texture.glowing_ball import GlowingBall, scene_of


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


def test_a_view_knows_nothing_of_what_its_mask_hides(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    ball = GlowingBall()
    ball.config = replace(ball.config, near=0.1, far=4.0)
    scene = scene_of(ball, 3)
    whole, hidden, _ = scene.training_images()
    lens = scene.lens_of(whole)
    mask = Image.new("L", (lens.width, lens.height), 255)
    mask.paste(0, (0, 0, lens.width // 2, lens.height))
    workspace.images_root.mkdir(parents=True)
    mask.save(workspace.images_root / "mask.png")
    images = [whole, replace(hidden, mask="mask.png")]
    small = Pinhole.of(lens, 40)
    ctx = StageContext("mesh", workspace, tmp_path / "out", tmp_path / "saved")
    store = render_views(scene, images, [small] * 2, tmp_path / "views", ctx, (0.0, 1.0))
    seen, half = (view.z_depth > 0.0 for view in store)
    assert seen[:, :20].any()
    assert not half[:, :20].any()
    assert half[:, 21:].any()
