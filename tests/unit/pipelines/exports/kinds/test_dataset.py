"""`dataset.zip` of a tiny trained job, read back by our importers and by COLMAP."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pycolmap
import pytest

from pipelines.errors import ExportError
from pipelines.exports.formats.ply import read_ply, write_points
from pipelines.exports.kinds.dataset import EXPORT, DatasetOptions
from pipelines.exports.placement import to_world
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.registered_depth import registered_depth
from pipelines.scene.sensor_depth import load_sensor_depth, save_sensor_depth
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.ingesting import cameras as ingested
from tests.unit.pipelines.captures.ingesting import ingest, sources
from tests.unit.pipelines.stages import tiny_job

POINTS = np.random.default_rng(2).uniform(-1.0, 1.0, (30, 3))
COLORS = np.random.default_rng(3).integers(0, 256, (30, 3), np.uint8)
KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")


def context_of(job: Workspace) -> StageContext:
    out = job.partial("dataset")
    out.mkdir(parents=True)
    return StageContext("dataset", job, out, job.checkpoint("dataset"))


def exported(
    job: Workspace, cameras: CamerasFile | None = None, **options: Any
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The summary, and the archive's files. cameras: in place of the trained scene's."""
    scene = TrainedScene.load(job.stage("train") / "model.zip")
    scene.cameras = cameras or scene.cameras
    ctx = context_of(job)
    summary = EXPORT.run(scene, DatasetOptions(**options), ctx)
    path = ctx.out / "dataset.zip"
    if not path.exists():
        return summary, {}
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        return summary, {name: archive.read(name) for name in archive.namelist()}


def trained_cameras(job: Workspace) -> CamerasFile:
    return CamerasFile.load(job.stage("train") / "cameras.json")


def assert_same_cameras(ctx: StageContext, wanted: CamerasFile) -> None:
    """What was read back is what was trained: every pose within 1e-6, every lens exactly."""
    file = ingested(ctx)
    by_file = {image.file: image for image in wanted.images}
    assert len(file.images) == len(wanted.images)
    for image, source in zip(file.images, sources(ctx), strict=True):
        original = by_file[source]
        np.testing.assert_allclose(image.world_from_camera, original.world_from_camera, atol=1e-6)
        lens, true = file.cameras[image.camera], wanted.cameras[original.camera]
        models = {"PINHOLE", "OPENCV"}
        assert lens.model == true.model or {lens.model, true.model} == models
        for key in KEYS[2:]:
            assert getattr(lens, key) == pytest.approx(getattr(true, key), abs=1e-9), key


def enriched(job: Workspace, *, metric: bool = True, scale: float = 1.0) -> CamerasFile:
    """The job's cameras with masks, depth and points on disk; picture 2 has neither of the first
    two. Every third picture has a lens of its own. Depth is below `4 * scale`."""
    cameras = trained_cameras(job)
    root = job.images_root
    (root / "masks").mkdir()
    (root / "depth").mkdir()
    images = []
    for index, image in enumerate(cameras.images):
        lens = cameras.cameras[image.camera]
        mask, depth = f"masks/{index:05d}.png", f"depth/{index:05d}.npz"
        if index == 2:
            images.append(replace(image, camera=0))
            continue
        pixels = np.full((lens.height, lens.width), 255, np.uint8)
        pixels[: 3 + index] = 0
        PIL.Image.fromarray(pixels).save(root / mask)
        z = scale * np.random.default_rng(index).uniform(0.5, 4.0, (16, 9))
        z[0] = 0.0
        save_sensor_depth(root / depth, z.astype(np.float32))
        images.append(replace(image, mask=mask, depth=depth, camera=index % 3 == 1))
    write_points(job.sparse_points, POINTS, COLORS)
    first = cameras.cameras[0]
    other = replace(first, model="OPENCV", fl_x=first.fl_x + 3, k1=-0.02, k2=0.01, p1=1e-3)
    return replace(cameras, cameras=(first, other), images=tuple(images), metric=metric)


def test_a_trained_job_goes_out_and_comes_back_the_same(job: Workspace, tmp_path: Path) -> None:
    summary = tiny_job.run(job, "dataset")["summary"]
    with zipfile.ZipFile(job.stage("dataset") / "dataset.zip") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    assert (summary["num_images"], summary["left_out"]) == (20, {})
    assert summary["bytes"] == (job.stage("dataset") / "dataset.zip").stat().st_size
    trained = trained_cameras(job)
    for image in trained.images:
        assert files[image.file] == (job.images_root / image.file).read_bytes()
    read, ctx = ingest(tmp_path / "nerfstudio", files)
    assert read["kind"] == "nerfstudio"
    assert_same_cameras(ctx, trained)
    del files["transforms.json"]
    read, ctx = ingest(tmp_path / "colmap", files)
    assert read["kind"] == "colmap"
    assert_same_cameras(ctx, trained)


def test_in_another_frame_cameras_points_and_depth_lie_in_one_place(
    job: Workspace, tmp_path: Path
) -> None:
    cameras = enriched(job)
    _, here = exported(job, cameras)
    shutil.rmtree(job.partial("dataset"))
    summary, there = exported(job, cameras, frame="normalised")
    scale = np.linalg.norm(np.array(summary["frame"]["from_world"])[0, :3])
    assert abs(scale - 1.0) > 0.01, "or this test would see nothing"
    before, after = (json.loads(files["transforms.json"]) for files in (here, there))
    ratio = after["depth_unit_scale_factor"] / before["depth_unit_scale_factor"]
    assert ratio == pytest.approx(scale)
    centers = [
        np.array([frame["transform_matrix"] for frame in one["frames"]])[:, :3, 3]
        for one in (before, after)
    ]
    np.testing.assert_allclose(to_world(centers[1], summary), centers[0], atol=1e-9)
    (tmp_path / "points.ply").write_bytes(there["sparse_pc.ply"])
    points = read_ply(tmp_path / "points.ply").points
    np.testing.assert_allclose(to_world(points, summary), POINTS, atol=1e-5)
    assert {name for name in there if "depth" in name} == {name for name in here if "depth" in name}


@pytest.mark.parametrize("form", ["binary", "text"])
def test_all_that_a_capture_has_goes_out_and_comes_back(
    job: Workspace, tmp_path: Path, form: str
) -> None:
    cameras = enriched(job)
    summary, files = exported(job, cameras, colmap=form)
    assert (summary["num_masks"], summary["num_depths"], summary["num_points"]) == (19, 19, 30)
    _, ctx = ingest(tmp_path / "nerfstudio", files)
    assert_same_cameras(ctx, cameras)
    file = ingested(ctx)
    by_file = {image.file: image for image in cameras.images}
    for image, source in zip(file.images, sources(ctx), strict=True):
        original = by_file[source]
        assert image.timestamp_s == original.timestamp_s
        mask = np.asarray(PIL.Image.open(ctx.out / str(image.mask)))
        if original.mask is None or original.depth is None:
            assert (mask == 255).all(), "nothing is to be ignored"
            assert image.depth is None or not load_sensor_depth(ctx.out / image.depth).any()
            continue
        wanted = np.asarray(PIL.Image.open(job.images_root / original.mask))
        np.testing.assert_array_equal(mask, wanted)
        z = load_sensor_depth(ctx.out / str(image.depth))
        true = load_sensor_depth(job.images_root / original.depth)
        np.testing.assert_allclose(z, true, atol=0.0005001)
        np.testing.assert_array_equal(z > 0, true > 0)
    del files["transforms.json"]
    read, ctx = ingest(tmp_path / "colmap", files)
    assert read["kind"] == "colmap"
    assert_same_cameras(ctx, cameras)
    np.testing.assert_allclose(read_ply(ctx.out / "points.ply").points, POINTS, atol=1e-6)


def test_depth_by_another_lens_goes_out_as_the_pictures_have_it(
    job: Workspace, tmp_path: Path
) -> None:
    cameras = enriched(job)
    sensor = replace(cameras.cameras[0], fl_x=1.2 * cameras.cameras[0].fl_x)
    images = tuple(
        replace(image, depth_lens=sensor if image.depth else None) for image in cameras.images
    )
    by_sensor = replace(cameras, images=images)
    _, files = exported(job, by_sensor)
    _, ctx = ingest(tmp_path, files)
    by_file = {image.file: image for image in by_sensor.images}
    num_moved = 0
    for image, source in zip(ingested(ctx).images, sources(ctx), strict=True):
        original = by_file[source]
        assert image.depth_lens is None
        if original.depth is None:
            continue
        z = load_sensor_depth(ctx.out / str(image.depth))
        wanted = registered_depth(job.images_root, original, cameras.cameras[original.camera])
        np.testing.assert_allclose(z, wanted, atol=0.0005001)
        stored = load_sensor_depth(job.images_root / original.depth)
        num_moved += int(np.abs(wanted - stored).max() > 0.1)
    assert num_moved == 19


@pytest.mark.parametrize("form", ["binary", "text"])
def test_colmap_reads_its_model(job: Workspace, tmp_path: Path, form: str) -> None:
    cameras = enriched(job)
    _, files = exported(job, cameras, colmap=form)
    suffix = {"binary": ".bin", "text": ".txt"}[form]
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}{suffix}").write_bytes(files[f"sparse/0/{name}{suffix}"])
    assert sum(name.startswith("sparse/") for name in files) == 3
    model = pycolmap.Reconstruction(str(tmp_path))
    by_file = {f"images/{image.name}": image for image in model.images.values()}
    assert set(by_file) == {image.file for image in cameras.images}
    for image in cameras.images:
        found = by_file[image.file]
        pose = np.array(image.world_from_camera)
        back = found.cam_from_world().inverse().matrix() * [1.0, -1.0, -1.0, 1.0]
        np.testing.assert_allclose(back, pose, atol=1e-9)
        lens, camera = cameras.cameras[image.camera], model.cameras[found.camera_id]
        assert (camera.width, camera.height) == (lens.width, lens.height)
        assert camera.model.name == lens.model
        terms = [lens.fl_x, lens.fl_y, lens.cx, lens.cy]
        terms += [lens.k1, lens.k2, lens.p1, lens.p2] if lens.model == "OPENCV" else []
        np.testing.assert_allclose(camera.params, terms)
    points = [model.points3D[number] for number in sorted(model.points3D)]
    np.testing.assert_allclose([point.xyz for point in points], POINTS, atol=1e-6)
    np.testing.assert_array_equal([point.color for point in points], COLORS)


def test_every_field_of_transforms_json(job: Workspace) -> None:
    """nerfstudio's own parser cannot be had here: its rules, written out."""
    cameras = enriched(job)
    _, files = exported(job, cameras)
    content = json.loads(files["transforms.json"])
    assert set(content) == {
        "camera_model",
        "orientation_override",
        "metric",
        "ply_file_path",
        "depth_unit_scale_factor",
        "train_filenames",
        "val_filenames",
        "test_filenames",
        "frames",
    }
    assert content["camera_model"] == "OPENCV"
    assert content["orientation_override"] == "none"
    assert content["depth_unit_scale_factor"] == 0.001
    paths = [frame["file_path"] for frame in content["frames"]]
    held_out = [image.file for image in cameras.images if image.split == "test"]
    assert content["test_filenames"] == content["val_filenames"] == held_out
    assert sorted(content["train_filenames"] + held_out) == sorted(paths)
    assert paths == [image.file for image in cameras.images]
    for number, (frame, image) in enumerate(zip(content["frames"], cameras.images, strict=True)):
        assert set(frame) == {
            "file_path",
            "mask_path",
            "depth_file_path",
            "timestamp",
            "transform_matrix",
            "colmap_im_id",
            *KEYS,
        }
        lens = cameras.cameras[image.camera]
        wanted = {"w": lens.width, "h": lens.height}
        assert {key: frame[key] for key in KEYS} == {
            key: wanted.get(key, getattr(lens, key, None)) for key in KEYS
        }
        assert frame["transform_matrix"] == [
            *(list(row) for row in image.world_from_camera),
            [0.0, 0.0, 0.0, 1.0],
        ]
        assert frame["timestamp"] == image.timestamp_s
        assert frame["colmap_im_id"] == number + 1
        assert frame["mask_path"] in files
        with PIL.Image.open(io.BytesIO(files[frame["mask_path"]])) as mask:
            assert (mask.mode, mask.size) == ("L", (lens.width, lens.height))
        with PIL.Image.open(io.BytesIO(files[frame["depth_file_path"]])) as depth:
            assert depth.mode == "I;16"
    assert content["ply_file_path"] in files


def test_points_lie_in_the_world_of_the_poses(job: Workspace, tmp_path: Path) -> None:
    _, files = exported(job, enriched(job))
    (tmp_path / "a.ply").write_bytes(files["sparse_pc.ply"])
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors, COLORS)


@pytest.mark.parametrize(
    ("metric", "scale", "applied"),
    [(True, 1.0, None), (True, 40.0, None), (False, 1e-3, None), (False, 5.0, 0.25)],
)
def test_depth_comes_back_in_the_unit_of_the_poses(
    job: Workspace, tmp_path: Path, metric: bool, scale: float, applied: float | None
) -> None:
    """Too far for millimetres, a tiny world, and one that nerfstudio had scaled before."""
    cameras = enriched(job, metric=metric, scale=scale)
    if applied is not None:
        cameras = replace(cameras, notes={"applied_scale": applied})
    _, files = exported(job, cameras)
    content = json.loads(files["transforms.json"])
    fits = metric and scale == 1.0
    assert (content["depth_unit_scale_factor"] == 0.001) is fits
    _, ctx = ingest(tmp_path, files)
    image = ingested(ctx).images[sources(ctx).index(cameras.images[0].file)]
    z = load_sensor_depth(ctx.out / str(image.depth))
    true = load_sensor_depth(job.images_root / str(cameras.images[0].depth))
    np.testing.assert_allclose(z, true, atol=(0.000501 if fits else 4.0 * scale / 65535))


def test_it_can_be_switched_off(job: Workspace) -> None:
    summary, files = exported(job, enabled=False)
    assert files == {}
    assert summary == {"left_out": {"dataset.zip": "dataset.enabled is off"}}


def test_pictures_that_are_too_large_stay_out_and_that_is_said(job: Workspace) -> None:
    summary, files = exported(job, enriched(job), max_mb=0)
    assert set(files) == {
        "transforms.json",
        "sparse_pc.ply",
        "sparse/0/cameras.bin",
        "sparse/0/images.bin",
        "sparse/0/points3D.bin",
    }
    assert "dataset.max_mb is 0" in summary["left_out"]["images/"]
    assert (summary["num_images"], summary["num_points"]) == (0, 30)
    frames = json.loads(files["transforms.json"])["frames"]
    assert not any(key in frame for frame in frames for key in ("mask_path", "depth_file_path"))


def test_without_masks_depth_and_points_there_are_none(job: Workspace) -> None:
    _, files = exported(job, colmap="none")
    assert {name.partition("/")[0] for name in files} == {"images", "transforms.json"}
    content = json.loads(files["transforms.json"])
    assert not {"ply_file_path", "depth_unit_scale_factor"} & set(content)


def test_a_lens_that_colmap_has_not_costs_the_model_alone(job: Workspace) -> None:
    cameras = trained_cameras(job)
    lens = replace(cameras.cameras[0], model="OPENCV", k4=0.01)
    summary, files = exported(job, replace(cameras, cameras=(lens,)))
    assert list(summary["left_out"]) == ["sparse/0/"]
    assert "k4" in summary["left_out"]["sparse/0/"]
    assert json.loads(files["transforms.json"])["k4"] == 0.01


def test_lenses_that_no_transforms_json_holds_cost_that_alone(job: Workspace) -> None:
    cameras = trained_cameras(job)
    first = cameras.cameras[0]
    fisheye = replace(first, model="OPENCV_FISHEYE", k1=0.01)
    images = tuple(replace(image, camera=n % 2) for n, image in enumerate(cameras.images))
    summary, files = exported(job, replace(cameras, cameras=(first, fisheye), images=images))
    assert list(summary["left_out"]) == ["transforms.json"]
    assert "sparse/0/images.bin" in files


def test_the_same_capture_gives_the_same_bytes(job: Workspace) -> None:
    cameras = enriched(job)
    exported(job, cameras)
    first = (job.partial("dataset") / "dataset.zip").read_bytes()
    job.partial("dataset").rename(job.root / "before")
    exported(job, cameras)
    assert (job.partial("dataset") / "dataset.zip").read_bytes() == first


def test_a_picture_that_is_gone_is_named(job: Workspace) -> None:
    cameras = trained_cameras(job)
    (job.images_root / cameras.images[4].file).unlink()
    with pytest.raises(ExportError, match=cameras.images[4].file.rpartition("/")[2]) as caught:
        exported(job)
    assert caught.value.code == "inputs_missing"
