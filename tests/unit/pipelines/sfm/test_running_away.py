"""Flat things far away: their lens runs away with what they cannot tell, and is then held."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.options import PosesOptions
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from pipelines.sfm.held_lens import lens_ran_away
from pipelines.stage import StageContext
from pipelines.stages.poses import run
from pipelines.tools import colmap
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_settings import CameraGroup, FeatureSettings, MapperSettings
from pipelines.workspace import Workspace
from tests.unit.pipelines.sfm.synthetic_room import (
    HEIGHT,
    WIDTH,
    arc_poses,
    blobs,
    picked,
    pose_looking_at,
    render,
    save_video_frames,
)
from tests.unit.pipelines.sfm.test_tears import model_of, true_poses

NUM, FOCAL_PX, DISTANCE, RADIUS = 12, 3000.0, 24.0, 1.5


def disc_poses() -> np.ndarray:
    """[NUM, 3, 4]: around a disc and far from it, looking past its middle."""
    random = np.random.default_rng(0)
    poses = []
    for angle in np.linspace(0, 2 * np.pi, NUM, endpoint=False):
        way = np.array([0.57 * np.cos(angle), 0.57 * np.sin(angle), 0.82])
        poses.append(pose_looking_at(DISTANCE * way, random.normal(0, 4, 3) * (1, 1, 0)))
    return np.stack(poses)


def cut_out(pose: np.ndarray, texture: np.ndarray) -> Image.Image:
    """The disc alone, cut out of a photo with its middle in the middle."""
    middle = -pose[:, 3] @ pose[:, :3]
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x = (u - WIDTH / 2) / FOCAL_PX - middle[0] / middle[2]
    y = -(v - HEIGHT / 2) / FOCAL_PX - middle[1] / middle[2]
    rays = np.stack([x, y, -np.ones_like(u)], axis=-1) @ pose[:, :3].T
    hit = pose[:, 3] - rays * (pose[2, 3] / rays[..., 2])[..., None]
    picture = np.full((HEIGHT, WIDTH, 3), 255.0)
    here = np.hypot(hit[..., 0], hit[..., 1]) < RADIUS
    scale = 511 / (2 * RADIUS)
    picture[here] = picked(texture, *((hit[here][:, axis] + RADIUS) * scale for axis in (0, 1)))
    return Image.fromarray(picture.round().astype(np.uint8))


def test_cut_outs_of_a_flat_thing_far_away_are_all_placed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    texture = blobs(0)
    save_video_frames(tmp_path, [cut_out(pose, texture) for pose in disc_poses()])
    out = tmp_path / "out"
    out.mkdir()
    workspace = Workspace(tmp_path)
    ctx = StageContext("poses", workspace, out, workspace.checkpoint("poses"))
    options = PosesOptions(num_features=800, max_image_px=400, upsample="off", num_threads=1)
    with caplog.at_level(logging.INFO):
        run(options, ctx)
    assert "the lens ran away, or nothing is placed" in caplog.text, "else this shows nothing"
    report = json.loads((out / "report.json").read_text("utf-8"))
    assert [attempt["rung"] for attempt in report["attempts"]] == ["quick"]
    found = CamerasFile.load(out / "cameras.json")
    assert len(found.images) == NUM
    (lens,) = found.cameras
    assert lens.fl_x == pytest.approx(FOCAL_PX, rel=0.3), "nor does it run away when it is judged"
    assert abs(lens.k1) * (WIDTH / 2 / FOCAL_PX) ** 2 < 0.02
    assert (lens.k2, lens.p1, lens.p2) == (0.0, 0.0, 0.0)
    assert "focal_length_weak" in [warning["code"] for warning in report["warnings"]]


def test_a_lens_ran_away_where_most_is_seen_through_what_is_no_lens() -> None:
    bent = Intrinsics(400, 300, 9000.0, 9000.0, 200.0, 150.0, k1=-3.0)
    poses = true_poses(10)
    plain = model_of(poses[:2], (0, 1))
    odd = replace(model_of(poses[:2], (5, 6)), cameras=(bent,))
    assert lens_ran_away([plain, odd])
    short = Intrinsics(400, 300, 2.0, 2.0, 200.0, 150.0)
    assert lens_ran_away([replace(odd, cameras=(short,)), plain])
    assert lens_ran_away([])
    assert not lens_ran_away([plain])
    pieces = [odd, model_of(poses[:5], tuple(range(5)))]
    assert not lens_ran_away(pieces), "a bent piece of two beside five that are not"


def nothing(_done: int) -> None:
    return


def test_mapping_that_begins_anew_for_ever_ends_with_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(12)]
    pictures = [render(pose) for pose in arc_poses(6)]
    for i, path in enumerate(paths):
        picture = pictures[i % 6]
        (picture if i < 6 else picture.transpose(Image.Transpose.ROTATE_180)).save(path)
    reconstructor = Reconstructor(tmp_path / "colmap.db", paths, tmp_path / "s", num_threads=1)
    reconstructor.extract(
        (CameraGroup(tuple(range(12)), "SIMPLE_RADIAL"),),
        FeatureSettings(400, 1500, upsample=False, num_threads=1),
        nothing,
    )
    sides = (range(6), range(6, 12))
    reconstructor.match([(i, j) for one in sides for i in one for j in one if i < j], nothing)
    both = reconstructor.map(MapperSettings(), nothing)
    assert sorted(len(model.indices) for model in both) == [6, 6]
    monkeypatch.setattr(colmap, "_FEW", 0)
    monkeypatch.setattr(colmap, "_MOST_TIMES", 0.5)
    cut = reconstructor.map(MapperSettings(), nothing)
    assert sorted(len(model.indices) for model in cut) == [4, 6], "so far the second had come"
