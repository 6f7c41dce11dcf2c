"""The poses stage on small rendered pictures: real COLMAP, known cameras."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from pipelines.errors import Cancelled, PosesError
from pipelines.exports.formats.ply import read_ply
from pipelines.options import PosesOptions
from pipelines.sample.align import similarity
from pipelines.scene.cameras_file import CamerasFile
from pipelines.sfm.rungs import RUNGS
from pipelines.stage import StageContext
from pipelines.stages.poses import run
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import (
    SparseModel,
    image_index,
    read_statistics,
    sparse_model,
)
from pipelines.workspace import Workspace
from tests.unit.pipelines.sfm.synthetic_room import (
    FOCAL,
    arc_poses,
    downward_poses,
    pose_looking_at,
    render,
    save_photos,
    save_video_frames,
    turning_poses,
)

OPTIONS = PosesOptions(num_features=1500, max_image_px=400, subpixel=True)


def context(root: Path, **more: Any) -> StageContext:
    out = root / ".partial" / "poses"
    out.mkdir(parents=True, exist_ok=True)
    workspace = Workspace(root)
    return StageContext("poses", workspace, out, workspace.checkpoint("poses"), **more)


def failed_report(root: Path) -> dict[str, Any]:
    """What a stage that raised left behind, and that it left nothing else."""
    (left,) = (root / ".partial/poses").iterdir()
    assert left.name == "report.json"
    report: dict[str, Any] = json.loads(left.read_text("utf-8"))
    return report


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], list[Any]]:
    """A finished stage on 12 views; the third frame is blank."""
    root = tmp_path_factory.mktemp("job")
    pictures = [render(pose) for pose in arc_poses(12)]
    pictures[2] = Image.new("RGB", pictures[2].size, (90, 90, 90))
    save_video_frames(root, pictures)
    reports: list[Any] = []
    saved: list[int] = []
    ctx = context(
        root,
        on_progress=lambda *report: reports.append(report),
        on_checkpoint=lambda: saved.append(len(reports)),
    )
    summary = run(OPTIONS, ctx)
    assert len(saved) == 2
    return root, summary, reports


def test_cameras_match_the_truth_up_to_a_similarity(job: tuple[Path, Any, Any]) -> None:
    cameras = CamerasFile.load(job[0] / ".partial/poses/cameras.json")
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = np.delete(arc_poses(12), 2, axis=0)
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    extent = np.ptp(truth[:, :, 3], axis=0).max()
    errors = np.linalg.norm(move.apply_to_points(poses[:, :, 3]) - truth[:, :, 3], axis=1)
    assert errors.mean() < 0.01 * extent
    turned = move.apply_to_cameras(poses)[:, :, :3]
    angles = np.degrees(np.arccos(((turned * truth[:, :, :3]).sum((1, 2)) - 1) / 2))
    assert angles.max() < 1.0


def test_what_masks_hide_moves_no_poses(tmp_path: Path) -> None:
    """A poster that stands still in all pictures, whatever the camera does: half of each."""
    poster = np.random.default_rng(3).integers(0, 255, (60, 40, 3), np.uint8)
    pictures = [render(pose) for pose in arc_poses(10)]
    width, height = pictures[0].size
    still = Image.fromarray(poster).resize((width // 2, height), Image.Resampling.BICUBIC)
    mask = Image.new("L", (width, height), 255)
    mask.paste(0, (0, 0, width // 2, height))
    for picture in pictures:
        picture.paste(still, (0, 0))
    save_photos(tmp_path, pictures)
    listing = tmp_path / "ingest" / "capture.json"
    images = json.loads(listing.read_text("utf-8"))["images"]
    (tmp_path / "ingest" / "masks").mkdir()
    for number, image in enumerate(images):
        image["mask"] = f"masks/{number:02d}.png"
        image["cut"] = f"cuts/{number:02d}.png"
        mask.save(tmp_path / "ingest" / image["mask"])
    listing.write_text(json.dumps({"images": images}), "utf-8")
    run(OPTIONS, context(tmp_path))
    cameras = CamerasFile.load(tmp_path / ".partial/poses/cameras.json")
    assert [image.mask for image in cameras.images] == [image["mask"] for image in images]
    assert [image.cut for image in cameras.images] == [image["cut"] for image in images]
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = arc_poses(10)
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    errors = np.linalg.norm(move.apply_to_points(poses[:, :, 3]) - truth[:, :, 3], axis=1)
    assert errors.mean() < 0.02 * np.ptp(truth[:, :, 3], axis=0).max()


def test_the_world_is_upright_and_cameras_fill_the_unit_cube(job: tuple[Path, Any, Any]) -> None:
    cameras = CamerasFile.load(job[0] / ".partial/poses/cameras.json")
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = np.delete(arc_poses(12), 2, axis=0)
    np.testing.assert_allclose(poses[:, 2, :3], truth[:, 2, :3], atol=0.03)
    assert np.abs(poses[:, :, 3]).max() == pytest.approx(1.0)
    assert cameras.notes["up_from"] == "vertical"


def test_the_lens_and_the_times_are_those_of_the_film(job: tuple[Path, Any, Any]) -> None:
    cameras = CamerasFile.load(job[0] / ".partial/poses/cameras.json")
    (lens,) = cameras.cameras
    assert lens.fl_x == lens.fl_y == pytest.approx(FOCAL, rel=0.01)
    assert (lens.k2, lens.p1, lens.p2) == (0.0, 0.0, 0.0)
    assert [image.file for image in cameras.images][:3] == [
        "images/frame_00001.jpg",
        "images/frame_00002.jpg",
        "images/frame_00004.jpg",
    ]
    assert [image.timestamp_s for image in cameras.images][:3] == [0.0, 0.5, 1.5]


def test_sparse_points_lie_on_the_walls(job: tuple[Path, Any, Any]) -> None:
    cameras = CamerasFile.load(job[0] / ".partial/poses/cameras.json")
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = np.delete(arc_poses(12), 2, axis=0)
    sparse = read_ply(job[0] / ".partial/poses/points.ply")
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    points = move.apply_to_points(sparse.points.astype(np.float64))
    assert len(points) > 100
    assert np.median(np.abs(points).min(axis=1)) < 0.02
    assert sparse.colors is not None
    assert sparse.colors.std() > 10


def test_the_report_says_which_frame_is_missing_and_why(job: tuple[Path, Any, Any]) -> None:
    root, summary, _ = job
    report = json.loads((root / ".partial/poses/report.json").read_text("utf-8"))
    assert (report["num_images"], report["num_registered"]) == (12, 11)
    assert report["registered_ratio"] == pytest.approx(11 / 12)
    assert report["mean_reprojection_error_px"] < 1.0
    refined = report["subpixel"]
    assert refined["num_moved"] > 0.5 * refined["num_observations"] > 100
    assert refined["error_after_px"] < 0.8 * refined["error_before_px"]
    assert report["mean_reprojection_error_px"] < 1.2 * refined["error_after_px"]
    assert report["metric"] is False
    found = report["intrinsics"]
    assert (found["model"], found["num_images"]) == ("SIMPLE_RADIAL", 11)
    assert found["focal_px"] == pytest.approx(FOCAL, rel=0.01)
    assert found["focal_spread_percent"] < 5.0
    assert [one["model"] for one in found["candidates"]] == ["SIMPLE_RADIAL", "RADIAL", "OPENCV"]
    assert report["warnings"] == []
    (missing,) = report["unregistered"]
    assert missing["file"] == "images/frame_00003.jpg"
    assert missing["timestamp_s"] == 1.0
    assert missing["reason"] == "too few features (0)"
    assert report["gaps_s"] == [[1.0, 1.0]]
    assert {key: report[key] for key in summary if key != "gaps_s"} == {
        key: summary[key] for key in summary if key != "gaps_s"
    }


def test_progress_never_goes_back_and_ends_at_one(job: tuple[Path, Any, list[Any]]) -> None:
    fractions = [fraction for fraction, _, _ in job[2]]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_a_second_attempt_takes_features_and_matches_from_the_checkpoint(
    job: tuple[Path, Any, Any],
) -> None:
    messages: list[str] = []
    ctx = context(job[0], on_progress=lambda _fraction, message, _eta: messages.append(message))
    assert run(OPTIONS, ctx)["num_registered"] == 11
    assert not [text for text in messages if "features" in text or "matching" in text]


def test_where_too_few_register_colmaps_own_way_is_tried_and_kept_for_a_second_attempt(
    tmp_path: Path,
) -> None:
    pictures = [render(pose) for pose in arc_poses(8)]
    pictures[3] = Image.new("RGB", pictures[3].size, (90, 90, 90))
    save_video_frames(tmp_path, pictures)
    options = OPTIONS.model_copy(
        update={"retry_below_ratio": 1.0, "upsample": "off", "num_features": 800}
        | {"min_registered": 5}
    )
    assert run(options, context(tmp_path))["num_registered"] == 7
    report = json.loads((tmp_path / ".partial/poses/report.json").read_text("utf-8"))
    assert [(a["thorough"], a["relaxed"]) for a in report["attempts"]] == [
        (False, False),
        (True, False),
        (True, True),
    ]
    checkpoint = tmp_path / ".checkpoint/poses"
    features = [
        read_statistics(checkpoint / name, 8).num_features.mean()
        for name in ("colmap.db", "thorough.db")
    ]
    assert features[1] > features[0], "the thorough way doubles the images"
    messages: list[str] = []
    ctx = context(tmp_path, on_progress=lambda _fraction, message, _eta: messages.append(message))
    run(options, ctx)
    assert not [text for text in messages if "features" in text or "matching" in text]


def test_photos_in_no_order_are_matched_by_their_looks(tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(16)
    save_photos(tmp_path, [render(pose) for pose in arc_poses(16)[order]])
    options = OPTIONS.model_copy(update={"matcher": "retrieval", "retrieval_neighbours": 4})
    assert run(options, context(tmp_path))["num_registered"] == 16
    report = json.loads((tmp_path / ".partial/poses/report.json").read_text("utf-8"))
    assert report["matching"]["num_pairs"] < 90
    cameras = CamerasFile.load(tmp_path / ".partial/poses/cameras.json")
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = arc_poses(16)[order]
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    errors = np.linalg.norm(move.apply_to_points(poses[:, :, 3]) - truth[:, :, 3], axis=1)
    assert errors.mean() < 0.01 * np.ptp(truth[:, :, 3], axis=0).max()


@pytest.mark.parametrize(("few", "attempts"), [(8, 3), (7, 1)])
def test_of_few_photos_each_is_sought(tmp_path: Path, few: int, attempts: int) -> None:
    eye = np.array([2.2, 2.2, 1.4])
    aside = pose_looking_at(eye, eye + np.array([0.3, -1.0, -0.25]))  # shows what no other does
    save_photos(tmp_path, [render(pose) for pose in (*arc_poses(7), aside)])
    options = OPTIONS.model_copy(
        update={"few_photos": few, "upsample": "off", "num_features": 800, "min_registered": 5}
    )
    assert run(options, context(tmp_path))["registered_ratio"] == 7 / 8 > options.retry_below_ratio
    report = json.loads((tmp_path / ".partial/poses/report.json").read_text("utf-8"))
    assert len(report["attempts"]) == attempts


def test_an_image_that_was_placed_wrong_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    mapped = Reconstructor.map

    def astray(self: Reconstructor, *given: Any) -> list[SparseModel]:
        """As COLMAP maps, but for the third image, which it turns by 30 degrees."""
        (model,) = mapped(self, *given)
        assert model.stored is not None
        whole = pycolmap.Reconstruction(model.stored)
        (image,) = [each for each in whole.images.values() if image_index(each.name) == 2]
        turn = pycolmap.Rotation3d(np.array([0.0, np.sin(0.26), 0.0, np.cos(0.26)]))
        pose = image.cam_from_world()
        image.frame.rig_from_world = pycolmap.Rigid3d(turn * pose.rotation, pose.translation)
        whole.write(model.stored)
        return [sparse_model(whole, model.stored)]

    monkeypatch.setattr(Reconstructor, "map", astray)
    save_video_frames(tmp_path, [render(pose) for pose in arc_poses(10)])
    with caplog.at_level("INFO"):
        assert run(OPTIONS, context(tmp_path))["num_registered"] == 9
    assert "their matches contradict their poses: images/frame_00003.jpg" in caplog.text
    cameras = CamerasFile.load(tmp_path / ".partial/poses/cameras.json")
    assert "images/frame_00003.jpg" not in [image.file for image in cameras.images]
    report = json.loads((tmp_path / ".partial/poses/report.json").read_text("utf-8"))
    (left,) = report["unregistered"]
    assert (left["file"], left["code"]) == ("images/frame_00003.jpg", "pose_rejected")
    poses = np.array([image.world_from_camera for image in cameras.images])
    truth = np.delete(arc_poses(10), 2, axis=0)
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    errors = np.linalg.norm(move.apply_to_points(poses[:, :, 3]) - truth[:, :, 3], axis=1)
    assert errors.max() < 0.02 * np.ptp(truth[:, :, 3], axis=0).max()


def test_photos_of_a_floor_lie_flat_where_the_camera_says_that_it_looked_down(
    tmp_path: Path,
) -> None:
    exif: dict[str, object] = {"up": [0.0, 0.0, 1.0], "focal_35mm": 36.0 * FOCAL / 400}
    save_photos(tmp_path, [render(pose) for pose in downward_poses(9)], exif)
    assert run(OPTIONS, context(tmp_path))["num_registered"] == 9
    cameras = CamerasFile.load(tmp_path / ".partial/poses/cameras.json")
    assert cameras.notes["up_from"] == "measured"
    poses = np.array([image.world_from_camera for image in cameras.images])
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=0.01)
    assert np.ptp(poses[:, 2, 3]) < 0.05 * np.ptp(poses[:, 0, 3])


def test_flat_pictures_have_no_features(tmp_path: Path) -> None:
    flat = [Image.new("RGB", (320, 240), (v, v, 128)) for v in range(100, 110)]
    save_video_frames(tmp_path, flat)
    with pytest.raises(PosesError) as caught:
        run(OPTIONS, context(tmp_path))
    assert caught.value.code == "no_features"
    assert caught.value.message.startswith("0 of 10 images")
    report = failed_report(tmp_path)
    assert (report["error"]["code"], report["attempts"]) == ("no_features", [])
    assert report["reasons"] == {"too_few_features": 10}
    assert report["metric"] is False


def test_unrelated_pictures_do_not_register(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [
        Image.fromarray(rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)).resize((320, 240))
        for _ in range(9)
    ]
    save_video_frames(tmp_path, noise)
    with pytest.raises(PosesError) as caught:
        run(OPTIONS, context(tmp_path))
    assert caught.value.code == "too_few_registered"
    assert caught.value.message == "0 of 9 frames registered, at least 8 are needed."
    assert caught.value.details["reasons"] == {"too_few_matches": 9}
    report = failed_report(tmp_path)
    assert (report["num_images"], report["num_registered"], report["num_needed"]) == (9, 0, 8)
    assert report["error"]["code"] == "too_few_registered"
    assert [attempt["rung"] for attempt in report["attempts"]] == [rung.name for rung in RUNGS[1:]]
    assert len(report["unregistered"]) == 9
    assert report["reasons"] == {"too_few_matches": 9}
    assert "more overlap" in report["advice"][-1]


def test_turning_on_the_spot_is_told_from_bad_matching(tmp_path: Path) -> None:
    save_video_frames(tmp_path, [render(pose) for pose in turning_poses(10)])
    with pytest.raises(PosesError) as caught:
        run(OPTIONS, context(tmp_path))
    assert caught.value.code == "no_parallax"
    assert "Move sideways" in caught.value.hint
    assert failed_report(tmp_path)["matching"]["num_one_homography"] > 0


def test_a_cancel_ends_the_running_call(tmp_path: Path) -> None:
    save_video_frames(tmp_path, [render(pose) for pose in arc_poses(10)])
    with pytest.raises(Cancelled):
        run(OPTIONS, context(tmp_path, is_cancelled=lambda: True))
    assert not (tmp_path / ".checkpoint/poses/state.json").exists()
