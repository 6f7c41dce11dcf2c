"""The poses stage on real captures: reduced sizes, so that each takes a minute or two."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pipelines.options import PosesOptions
from pipelines.sample.align import similarity
from pipelines.scene.cameras_file import CamerasFile
from pipelines.stage import StageContext
from pipelines.stages.poses import run
from pipelines.workspace import Workspace

pytestmark = [pytest.mark.captures, pytest.mark.slow]


@pytest.fixture(scope="module")
def captures() -> Path:
    folder = os.environ.get("NERFWORKS_CAPTURES")
    if not folder:
        pytest.skip("real captures are NOT tested: NERFWORKS_CAPTURES does not name their folder")
    return Path(folder)


def find_poses(root: Path, **options: Any) -> tuple[dict[str, Any], CamerasFile]:
    workspace = Workspace(root)
    out = workspace.partial("poses")
    out.mkdir(parents=True)
    ctx = StageContext("poses", workspace, out, workspace.checkpoint("poses"))
    summary = run(PosesOptions(**options), ctx)
    return summary, CamerasFile.load(out / "cameras.json")


def ingest_photos(root: Path, photos: Path, long_side_px: int) -> None:
    """The ingest folder of these photos, reduced."""
    folder = root / "ingest" / "images"
    folder.mkdir(parents=True)
    images = []
    for path in sorted(photos.glob("*.[jJ][pP][gG]")):
        with Image.open(path) as image:
            image.thumbnail((long_side_px, long_side_px))
            image.convert("RGB").save(folder / path.name, quality=95)
        images.append({"file": f"images/{path.name}"})
    (root / "ingest" / "capture.json").write_text(json.dumps({"images": images}), "utf-8")


def test_fox_photos_agree_with_the_published_poses(captures: Path, tmp_path: Path) -> None:
    ingest_photos(tmp_path, captures / "photos-fox" / "images", 960)
    summary, cameras = find_poses(tmp_path, num_features=2048, max_image_px=960)
    assert summary["num_registered"] >= 48
    lens = summary["intrinsics"]
    assert lens["model"] in ("RADIAL", "OPENCV"), "the published lens has two radial terms"
    assert lens["focal_px"] == pytest.approx(1375.0 * 960 / 1920, rel=0.01)
    assert lens["focal_spread_percent"] < 3.0
    published = json.loads((captures / "photos-fox" / "transforms.json").read_text("utf-8"))
    pose_of = {Path(f["file_path"]).name: f["transform_matrix"] for f in published["frames"]}
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = np.array([pose_of[Path(image.file).name] for image in cameras.images])[:, :3]
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    aligned = move.apply_to_cameras(poses)
    extent = float(np.ptp(truth[:, :, 3], axis=0).max())
    errors = np.linalg.norm(aligned[:, :, 3] - truth[:, :, 3], axis=1)
    assert errors.mean() < 0.01 * extent
    cosines = ((aligned[:, :, :3] * truth[:, :, :3]).sum((1, 2)) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 3.0
    assert np.median(poses[:, 2, 1]) > 0.7, "the phone was held upright"


def test_eleven_photos_of_a_castle_register(captures: Path, tmp_path: Path) -> None:
    ingest_photos(tmp_path, captures / "photos-sceaux-castle" / "images", 1200)
    summary, cameras = find_poses(tmp_path, num_features=3000, max_image_px=1200)
    assert summary["num_registered"] == 11
    poses = np.array([image.world_from_camera for image in cameras.images])
    heights = np.ptp(poses[:, 2, 3]) / np.ptp(poses[:, :2, 3], axis=0).max()
    assert heights < 0.1, "the photographer walked on level ground"


def test_a_handheld_film_registers(captures: Path, tmp_path: Path) -> None:
    film = captures / "video-phone-box" / "box.mp4"
    folder = tmp_path / "frames" / "images"
    folder.mkdir(parents=True)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(film)]
    command += ["-vf", "select='not(mod(n,15))',scale=640:-2", "-fps_mode", "passthrough"]
    subprocess.run([*command, "-q:v", "2", str(folder / "%05d.jpg")], check=True, timeout=120)
    frames = [
        {"file": f"images/{path.name}", "timestamp_s": 0.5 * index}
        for index, path in enumerate(sorted(folder.iterdir()))
    ]
    (tmp_path / "frames" / "frames.json").write_text(json.dumps({"frames": frames}), "utf-8")
    (tmp_path / "frames" / "manifest.json").write_text("{}", "utf-8")
    summary, cameras = find_poses(tmp_path, num_features=2048, max_image_px=640)
    assert summary["registered_ratio"] >= 0.8
    assert summary["mean_reprojection_error_px"] < 1.5
    poses = np.array([image.world_from_camera for image in cameras.images])
    assert (poses[:, 2, 1] > 0).all(), "every camera's up points up"
    assert (-poses[:, 2, 2] < 0).mean() > 0.8, "the box stands on a desk below the camera"
