"""The assess stage on a job whose mesh and cloud are known: it needs no trained model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.errors import ExportError
from pipelines.exports.formats import glb
from pipelines.exports.formats.ply import read_ply, write_mesh, write_points
from pipelines.exports.frame import FrameName
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.placement import placement_of
from pipelines.nerf.data.light import exposed
from pipelines.nerf.stereo.maps import DepthMap
from pipelines.sample.film import phone_camera
from pipelines.sample.scene import depth_image, pixel_rays, pose_matrix, raycast
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.depth_maps_file import DepthMapsWriter
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.sensor_depth import save_sensor_depth
from pipelines.workspace import MANIFEST, Workspace
from tests.texture_pictures import photo
from tests.unit.pipelines.exports.test_placement import MOVED
from tests.unit.pipelines.stages import tiny_job


@pytest.fixture
def job(tmp_path: Path) -> Workspace:
    """A tiny capture with every fourth image held out, as training writes it down."""
    workspace = tiny_job.make_capture(tmp_path / "job")
    cameras = CamerasFile.load(workspace.stage("ingest") / "cameras.json")
    images = tuple(
        replace(image, split="train" if number % 4 else "test")
        for number, image in enumerate(cameras.images)
    )
    workspace.stage("train").mkdir()
    replace(cameras, images=images).save(workspace.stage("train") / "cameras.json")
    _publish(workspace, "train")
    return workspace


_SPECK = (1e-3 * np.eye(3), np.array([[0, 1, 2]], np.int32), np.eye(3), np.eye(3))
"""A mesh of one tiny triangle."""


def _publish(job: Workspace, stage: str) -> None:
    job.stage(stage).mkdir(exist_ok=True)
    manifest = {"stage": stage, "content": stage, "summary": {}, "timings": {"wall_s": 1.0}}
    (job.stage(stage) / MANIFEST).write_text(
        json.dumps({**manifest, "options": {}, "files": []}), "utf-8"
    )


def _exact_assets(job: Workspace, keep: float = 1.0, floaters: float | None = 0.004) -> None:
    """Mesh and cloud of the true surface as all cameras see it, in the scene's own colours.

    keep: share of each picture's columns that the mesh covers, from the left.
    """
    lens = phone_camera(96)
    vertices, colors, faces, offset = [], [], [], 0
    for image in CamerasFile.load(job.stage("train") / "cameras.json").images:
        pose = pose_matrix(image)
        y, x = np.mgrid[0 : lens.height, 0 : round(keep * lens.width)]
        pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        origins, directions = pixel_rays(lens, pose, pixels)
        hits = raycast(origins, directions)
        vertices.append(origins + hits.t[:, None] * directions)
        colors.append(hits.color)
        index = np.arange(len(pixels)).reshape(x.shape)
        corners = np.stack([index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]], -1)
        quads = corners[np.ptp(hits.t[corners], axis=-1) < 0.1]
        faces += [offset + quads[:, [0, 1, 2]], offset + quads[:, [2, 1, 3]]]
        offset += len(pixels)
    shades = np.concatenate(colors)
    painted = np.rint(255 * shades).astype(np.uint8)
    for stage in ("mesh", "pointcloud", "evaluate"):
        _publish(job, stage)
    points = np.concatenate(vertices)
    upward = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    mesh = TriangleMesh(points, np.concatenate(faces).astype(np.int32), shades, upward)
    write_mesh(job.stage("mesh") / "mesh.ply", mesh)
    glb.write_mesh(job.stage("mesh") / "mesh.glb", mesh)
    write_points(job.stage("pointcloud") / "pointcloud.ply", points, painted)
    found = None if floaters is None else {"depth_inconsistency": floaters}
    (job.stage("evaluate") / "metrics.json").write_text(json.dumps({"floaters": found}), "utf-8")


def test_the_true_surface_covers_the_photos_and_looks_like_them(job: Workspace) -> None:
    _exact_assets(job)
    assets = tiny_job.run(job, "assess", long_side_px=64, num_pictures=2)["summary"]
    assert assets == json.loads((job.stage("assess") / "assets.json").read_text())
    assert assets["views"]["held_out"] is True
    assert assets["views"]["num_views"] == len(assets["per_view"]) == 5
    assert (assets["views"]["width"], assets["views"]["height"]) == (36, 64)
    # Faces across edges of things are left out, so a few pixels stay open.
    assert assets["mesh"]["coverage"] > 0.88
    assert assets["mesh"]["psnr"] > 22.0
    assert assets["mesh"]["ssim"] > 0.85
    assert assets["cloud"]["coverage"] > 0.97
    # The nearest of many points of fine paint: a pixel's neighbour as often as not.
    assert assets["cloud"]["psnr"] > 15.0
    assert assets["cloud"]["median_spacing"] > 0.0
    assert assets["warnings"] == []
    assert (assets["depth"], assets["depth_agreement"], assets["void"]) == (None, None, None)
    assert assets["depth_reason"]
    assert assets["depth_agreement_reason"]
    pictures = sorted((job.stage("assess") / "images").iterdir())
    assert len(pictures) == 2
    with Image.open(pictures[0]) as opened:
        assert opened.size == (3 * 36, 64)


def test_assets_in_other_formats_are_judged_by_what_lies_beside_them(job: Workspace) -> None:
    _exact_assets(job)
    wanted = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    mesh, cloud = job.stage("mesh"), job.stage("pointcloud")
    (mesh / "mesh.glb").rename(mesh / "judged.glb")
    (cloud / "pointcloud.ply").rename(cloud / "judged.ply")
    assert tiny_job.run(job, "assess", long_side_px=64)["summary"] == wanted
    glb.write_mesh(mesh / "mesh.glb", TriangleMesh(*_SPECK))
    assert tiny_job.run(job, "assess", long_side_px=64)["summary"] != wanted, (
        "delivered comes first"
    )


@pytest.mark.parametrize(
    ("factor", "expected"), [(1.0, "agrees"), (0.9, "behind"), (1.1, "before")]
)
def test_the_mesh_is_compared_with_depth_that_views_agree_on(
    job: Workspace, factor: float, expected: str
) -> None:
    _exact_assets(job)
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    writer = DepthMapsWriter(job.stage("depth"))
    for image in cameras.images[::3]:
        lens = cameras.cameras[image.camera]
        z = (factor * depth_image(lens, pose_matrix(image))).astype(np.float32)
        writer.append(image.file, Pinhole.of(lens, 64), DepthMap(z, np.ones(z.shape, np.uint8)))
    writer.close()
    _publish(job, "depth")
    found = tiny_job.run(job, "assess", long_side_px=64)["summary"]["depth_agreement"]
    assert found[expected] > 0.8
    assert found["agrees"] + found["before"] + found["behind"] + found["missing"] == pytest.approx(
        1.0, abs=1e-3
    )
    assert found["num_pixels"] > 6 * 36 * 64


@pytest.mark.parametrize("name", ["source", "normalised"])
def test_assets_of_another_frame_are_brought_back(job: Workspace, name: FrameName) -> None:
    _exact_assets(job)
    here = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    place = placement_of(name, replace(cameras, notes=MOVED))
    mesh, cloud = job.stage("mesh") / "mesh.glb", job.stage("pointcloud") / "pointcloud.ply"
    glb.write_mesh(mesh, place.mesh(glb.read_mesh(mesh)), place.frame())
    read = read_ply(cloud)
    points = place.points(read.points.astype(np.float64))
    assert np.abs(points - read.points).max() > 0.1
    write_points(cloud, points, read.colors, None, place.frame())
    there = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert there["mesh"] == pytest.approx(here["mesh"], rel=1e-2)
    assert there["cloud"] == pytest.approx(here["cloud"], rel=1e-2)


def test_a_ktx2_texture_is_judged_as_a_jpeg_is(job: Workspace) -> None:
    _exact_assets(job)
    path = job.stage("mesh") / "mesh.glb"
    bare = glb.read_mesh(path)
    low, size = bare.vertices.min(axis=0), np.ptp(bare.vertices, axis=0)
    uv = ((bare.vertices - low) / size)[:, :2]
    mesh = TexturedMesh(bare.vertices, bare.faces, bare.normals, uv, photo(256))
    scores = []
    for style in (glb.GlbStyle(), glb.GlbStyle(texture="ktx2")):
        glb.write_mesh(path, mesh, style=style)
        scores.append(tiny_job.run(job, "assess", long_side_px=64)["summary"]["mesh"])
    assert scores[1] == pytest.approx(scores[0], rel=1e-2)


def test_the_photos_are_the_held_out_ones(job: Workspace) -> None:
    _exact_assets(job)
    assets = tiny_job.run(job, "assess", num_views=3)["summary"]
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    split = {image.file: image.split for image in cameras.images}
    assert [split[row["file"]] for row in assets["per_view"]] == ["test"] * 3


def test_without_held_out_photos_training_ones_are_taken_and_it_is_said(job: Workspace) -> None:
    _exact_assets(job)
    path = job.stage("train") / "cameras.json"
    cameras = CamerasFile.load(path)
    replace(cameras, images=tuple(replace(i, split="train") for i in cameras.images)).save(path)
    assets = tiny_job.run(job, "assess", num_views=4)["summary"]
    assert assets["views"]["held_out"] is False
    assert assets["views"]["num_views"] == 4
    assert "trained on" in assets["views"]["note"]


def test_a_mesh_of_islands_is_warned_of_and_by_option_refused(job: Workspace) -> None:
    _exact_assets(job, keep=0.08, floaters=0.12)
    assets = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    (warning,) = assets["warnings"]
    assert warning["code"] == "geometry_poor"
    assert warning["hint"]
    assert assets["mesh"]["coverage"] < 0.5
    assert assets["depth_inconsistency"] == 0.12
    with pytest.raises(ExportError, match="do not hold together") as raised:
        tiny_job.run(job, "assess", long_side_px=64, require_geometry=True)
    assert raised.value.code == "geometry_poor"
    lenient = {"min_coverage": 0.0, "max_depth_inconsistency": 1.0, "require_geometry": True}
    assert tiny_job.run(job, "assess", long_side_px=64, **lenient)["summary"]["warnings"] == []


def test_floaters_that_were_not_measured_leave_coverage_to_judge(job: Workspace) -> None:
    _exact_assets(job, floaters=None)
    assets = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert assets["depth_inconsistency"] is None
    assert assets["warnings"] == []


def test_a_model_unlike_the_photos_is_warned_of_beside_its_surfaces(job: Workspace) -> None:
    _exact_assets(job, keep=0.08)
    path = job.stage("evaluate") / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "psnr": 12.6}))
    assets = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert [warning["code"] for warning in assets["warnings"]] == ["geometry_poor", "model_poor"]
    assert (
        json.loads((job.stage("assess") / "assets.json").read_text())["warnings"]
        == assets["warnings"]
    )
    kind = {"min_psnr": 12.0, "min_coverage": 0.0, "require_geometry": True}
    assert tiny_job.run(job, "assess", long_side_px=64, **kind)["summary"]["warnings"] == []


def _with_depth(job: Workspace, zoom: float = 1.0) -> None:
    """Give every image exact depth. zoom: of the lens by which it was written."""
    path = job.stage("train") / "cameras.json"
    cameras = CamerasFile.load(path)
    (job.images_root / "depth").mkdir()
    images = []
    for number, image in enumerate(cameras.images):
        lens = cameras.cameras[0]
        if zoom != 1.0:
            lens = replace(lens, fl_x=zoom * lens.fl_x, fl_y=zoom * lens.fl_y)
        depth = depth_image(lens, pose_matrix(image))
        file = f"depth/{number:05d}.npz"
        save_sensor_depth(job.images_root / file, depth.astype(np.float32))
        images.append(replace(image, depth=file, depth_lens=None if zoom == 1.0 else lens))
    replace(cameras, images=tuple(images)).save(path)


@pytest.mark.parametrize("zoom", [1.0, 1.15], ids=["by the picture's lens", "by another lens"])
def test_the_mesh_is_compared_with_the_captures_own_depth(job: Workspace, zoom: float) -> None:
    _exact_assets(job)
    _with_depth(job, zoom)
    assets = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert assets["depth_reason"] is None
    depth = assets["depth"]
    assert depth["scale"] == 1.0
    assert depth["median_relative_error"] < 0.01
    assert depth["within_5_percent"] > 0.97
    assert depth["covered_and_within_5_percent"] == pytest.approx(
        depth["coverage"] * depth["within_5_percent"], abs=1e-3
    )


def test_a_damaged_depth_map_costs_the_comparison_and_not_the_job(job: Workspace) -> None:
    _exact_assets(job)
    _with_depth(job)
    for path in (job.images_root / "depth").iterdir():
        path.write_bytes(b"no map")
    assets = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert assets["depth"] is None
    assert "no depth map" in assets["depth_reason"]


def test_a_mask_leaves_its_pixels_out(job: Workspace) -> None:
    _exact_assets(job, keep=0.5)
    before = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    mask = np.zeros((64, 36), np.uint8)
    mask[:, :10] = 255
    Image.fromarray(mask).save(job.images_root / "mask.png")
    path = job.stage("train") / "cameras.json"
    cameras = CamerasFile.load(path)
    replace(cameras, images=tuple(replace(i, mask="mask.png") for i in cameras.images)).save(path)
    after = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert after["mesh"]["coverage"] != before["mesh"]["coverage"]
    assert after["mesh"]["psnr_with_holes"] != before["mesh"]["psnr_with_holes"]


def test_assets_in_the_mean_light_are_seen_in_that_of_each_photo(job: Workspace) -> None:
    """Only where training levelled the pictures: else an asset that is too dark is too dark."""
    _exact_assets(job)
    root = job.stage("ingest")
    bend = 0.5
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    for number, image in enumerate(cameras.images):
        gain = 0.7 if number % 8 else 1.4
        with Image.open(root / image.file) as opened:
            lit = exposed(np.asarray(opened) / 255.0, gain, bend)
        Image.fromarray(np.rint(255.0 * lit).astype(np.uint8)).save(root / image.file)
    dark = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert dark["views"]["light"] == "as it is"
    lights = tuple(
        replace(image, light=(1.0, 1.0, 1.0, bend) if image.split == "train" else None)
        for image in cameras.images
    )
    replace(cameras, images=lights).save(job.stage("train") / "cameras.json")
    lit_assets = tiny_job.run(job, "assess", long_side_px=64)["summary"]
    assert lit_assets["views"]["light"] == "halves"
    # The cloud's own noise (above) leaves little between a right exposure and a wrong one.
    for asset, gained in (("mesh", 4.0), ("cloud", 1.5)):
        assert lit_assets[asset]["psnr"] > dark[asset]["psnr"] + gained
        assert lit_assets[asset]["coverage"] == dark[asset]["coverage"]
    assert lit_assets["mesh"]["psnr"] > 20.0
