"""Captures as the benchmarks read them, from folders written here."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import DataConfig, TrainConfig
from tests.benchmarks import reference
from tests.benchmarks.capture_data import load_capture, upright_rotation
from tests.benchmarks.made_capture import ring_pose, write_made_capture

ANGLES = (0.2, 1.1, 2.9, 4.0)


def pose_rows(angle: float) -> list[list[float]]:
    rows = np.eye(4)
    rows[:3] = ring_pose(angle)
    return rows.tolist()


def write_posed(folder: Path, **top: object) -> None:
    """Four listed pictures, the second of which is not there, in the reverse order of names."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, angle in enumerate(ANGLES):
        name = f"images/{9 - index}.png"
        frames.append({"file_path": name, "transform_matrix": pose_rows(angle)})
        if index != 1:
            shade = np.full((20, 10, 3), 40 * index, np.uint8)
            Image.fromarray(shade).save(folder / name)
    values = {"w": 10.0, "h": 20.0, "fl_x": 14.0, "fl_y": 15.0, **top, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))


def test_listed_pictures_that_are_missing_are_left_out_and_counted(tmp_path: Path) -> None:
    write_posed(tmp_path)
    capture = load_capture(tmp_path, DataConfig(eval_mode="none"))
    assert capture.names == ["6", "7", "9"]
    assert capture.num_missing == 1
    assert (capture.train, capture.test) == ([0, 1, 2], [])
    # Shades went 0, 40, 80, 120 with falling names: each picture is beside its own pose.
    shades = [int(capture.images.image(index)[0, 0, 0] * 255 + 0.5) for index in range(3)]
    assert shades == [120, 80, 0]


def test_poses_and_lens_are_those_of_the_file(tmp_path: Path) -> None:
    write_posed(tmp_path, cx=4.0, cy=11.0, k1=0.1, p2=-0.02)
    capture = load_capture(tmp_path, DataConfig(eval_mode="none"), orient=False)
    poses = np.stack([ring_pose(angle) for angle in (ANGLES[3], ANGLES[2], ANGLES[0])])
    center = poses[:, :, 3].mean(axis=0)
    scale = 1.0 / np.abs(poses[:, :, 3] - center).max()
    expected = poses.copy()
    expected[:, :, 3] = scale * (poses[:, :, 3] - center)
    torch.testing.assert_close(
        capture.cameras.scene_from_camera.double(), torch.from_numpy(expected), atol=1e-6, rtol=0
    )
    assert capture.cameras.focal[0].tolist() == [14.0, 15.0]
    assert capture.cameras.principal[0].tolist() == [4.0, 11.0]
    terms = capture.cameras.distortion[0].tolist()
    assert terms == pytest.approx([0.1, 0.0, 0.0, 0.0, 0.0, -0.02])


def test_a_smaller_long_side_scales_pictures_and_lens_alike(tmp_path: Path) -> None:
    write_posed(tmp_path)
    capture = load_capture(tmp_path, DataConfig(eval_mode="none", long_side_px=32))
    assert capture.images.sizes[0].tolist() == [10, 20]  # never enlarged
    wide = tmp_path / "wide"
    write_made_capture(wide, 4, 64, 128)
    half = load_capture(wide, DataConfig(eval_mode="none", long_side_px=64))
    assert half.images.sizes[0].tolist() == [32, 64] == half.cameras.size[0].tolist()
    assert half.cameras.focal[0].tolist() == pytest.approx([0.7 * 64, 0.7 * 64])


def test_focal_length_from_field_of_view(tmp_path: Path) -> None:
    folder = tmp_path / "angles"
    write_posed(folder)
    values = json.loads((folder / "transforms.json").read_text())
    del values["fl_x"], values["fl_y"]
    values["camera_angle_x"], values["camera_angle_y"] = 2 * math.atan(0.5), 2 * math.atan(1.0)
    (folder / "transforms.json").write_text(json.dumps(values))
    capture = load_capture(folder, DataConfig(eval_mode="none"))
    assert capture.cameras.focal[0].tolist() == pytest.approx([10.0, 10.0])


def test_unknown_camera_model_and_foreign_folder_are_refused(tmp_path: Path) -> None:
    write_posed(tmp_path / "odd", camera_model="THIN_PRISM")
    with pytest.raises(NerfError, match="THIN_PRISM"):
        load_capture(tmp_path / "odd", DataConfig())
    with pytest.raises(NerfError, match="neither"):
        load_capture(tmp_path, DataConfig())


@pytest.mark.parametrize("tilt", [0.0, 0.7, 2.5, math.pi])
def test_upright_rotation_turns_mean_up_to_z_and_keeps_distances(tilt: float) -> None:
    about_x = np.array(
        [[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]]
    )
    poses = np.stack([about_x @ ring_pose(2.0 * math.pi * i / 7) for i in range(7)])
    rotation = upright_rotation(poses)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    up = (rotation @ poses)[:, :, 1].mean(axis=0)
    assert up / np.linalg.norm(up) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def write_blender(folder: Path) -> None:
    for part, angles in (("train", ANGLES[:3]), ("val", ANGLES[3:])):
        (folder / part).mkdir(parents=True)
        frames = []
        for index, angle in enumerate(angles):
            rgba = np.zeros((8, 8, 4), np.uint8)
            rgba[:4] = (255, 0, 0, 255)
            rgba[4:6] = (0, 0, 0, 128)
            Image.fromarray(rgba).save(folder / part / f"r_{index}.png")
            frames.append(
                {"file_path": f"./{part}/r_{index}", "transform_matrix": pose_rows(angle)}
            )
        values = {"camera_angle_x": 2 * math.atan(0.4), "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(values))


def test_synthetic_scene_is_over_white_and_split_by_its_files(tmp_path: Path) -> None:
    write_blender(tmp_path)
    capture = load_capture(tmp_path, DataConfig(eval_mode="none"))
    assert (capture.train, capture.test) == ([0, 1, 2], [3])
    picture = capture.images.image(0)
    assert picture[0, 0].tolist() == [1.0, 0.0, 0.0]
    assert picture[5, 0].tolist() == pytest.approx([127 / 255] * 3, abs=1.5 / 255)
    assert picture[7, 7].tolist() == [1.0, 1.0, 1.0]
    assert capture.cameras.focal[0].tolist() == pytest.approx([10.0, 10.0])
    assert capture.cameras.principal[0].tolist() == [4.0, 4.0]


def test_synthetic_scene_fills_the_cube_and_brings_its_bounds(tmp_path: Path) -> None:
    write_blender(tmp_path)
    capture = load_capture(tmp_path, DataConfig())
    assert capture.scene.scene_from_world([1.5, -1.5, 0.0]).tolist() == [1.0, -1.0, 0.0]
    centers = capture.cameras.scene_from_camera[:, :, 3].norm(dim=1)
    assert centers.tolist() == pytest.approx([math.hypot(1.0, 0.3) / 1.5] * 4)
    suited = capture.suited(TrainConfig())
    assert (suited.model.near, suited.model.far) == pytest.approx((2 / 1.5, 6 / 1.5))
    assert suited.model.background == "white"


def test_real_capture_changes_no_option(tmp_path: Path) -> None:
    write_posed(tmp_path)
    capture = load_capture(tmp_path, DataConfig(eval_mode="none"))
    assert capture.suited(TrainConfig()) == TrainConfig()


def test_made_capture_looks_at_its_centre(tmp_path: Path) -> None:
    write_made_capture(tmp_path / "made", 6, 30, 40)
    capture = load_capture(tmp_path / "made", DataConfig(eval_mode="none"))
    assert len(capture.images) == 6
    target = torch.from_numpy(capture.scene.scene_from_world([0.0, 0.0, 0.0])).float()
    pixels, depth = capture.cameras.project(target.expand(6, 3), torch.arange(6))
    torch.testing.assert_close(pixels, torch.tensor([15.0, 20.0]).expand(6, 2), atol=1e-3, rtol=0)
    assert (depth > 0).all()


@pytest.mark.captures
@pytest.mark.skipif(
    "NERFWORKS_CAPTURES" not in os.environ,
    reason="real captures are NOT tested: NERFWORKS_CAPTURES does not name their folder",
)
def test_fox_is_split_as_the_reference_split_it() -> None:
    folder = Path(os.environ["NERFWORKS_CAPTURES"]) / "photos-fox"
    capture = load_capture(folder, DataConfig(long_side_px=48))
    assert tuple(capture.names[index] for index in capture.test) == reference.HELD_OUT
    assert (len(capture.names), capture.num_missing, len(capture.train)) == (50, 17, 45)
