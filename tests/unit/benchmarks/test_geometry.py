"""The geometry benchmark judges a finished job: exact assets score as exact, pictures show it."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.captures.record import CaptureRecord
from pipelines.exports.formats import glb
from pipelines.exports.formats.ply import write_mesh, write_points
from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TriangleMesh
from pipelines.sample.film import phone_camera, walk
from pipelines.sample.scene import depth_image, pixel_rays, pose_matrix, raycast
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.scene.cameras_file import CamerasFile
from pipelines.workspace import Workspace
from tests.benchmarks import geometry
from tests.benchmarks.geometry_pictures import depth_picture, error_picture
from tests.benchmarks.geometry_truth import read_depth_png
from tests.benchmarks.scene_capture import scene_capture
from tests.benchmarks.turntable import turntable

FRAMES, LONG_SIDE = 8, 120
TAKE = TAKES["object"]
SHIFT = np.array([2.0, -1.0, 0.5])
REPORT: dict[str, Any] = {
    "metrics": {"psnr": 30.0, "ssim": 0.9, "floaters": {"depth_inconsistency": 0.01}},
    "assets": {"mesh": {"coverage": 0.8, "psnr": 25.0, "psnr_with_holes": 18.0}},
    "warnings": [],
    "timings": {"train_s": 60.0, "mesh_s": 20.0},
}


@pytest.fixture
def job(tmp_path: Path) -> Workspace:
    """A finished job whose mesh is the true surface, its whole world moved by SHIFT.

    The mesh's normals all point up, the cloud's are right, and that lies in a frame of its own.
    """
    workspace = Workspace(tmp_path / "job")
    for stage in ("ingest", "train", "mesh", "pointcloud", "report"):
        workspace.stage(stage).mkdir(parents=True)
    truth = walk(FRAMES, phone_camera(LONG_SIDE), take=TAKE)
    vertices, normals, faces, offset, images = [], [], [], 0, []
    for number, image in enumerate(truth.images):
        pose = pose_matrix(image)
        y, x = np.mgrid[0:LONG_SIDE, 0 : truth.cameras[0].width]
        pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        origins, directions = pixel_rays(truth.cameras[0], pose, pixels)
        hits = raycast(origins, directions, TAKE.scene)
        t = hits.t
        normals.append(hits.normal)
        vertices.append(origins + t[:, None] * directions + SHIFT)
        index = np.arange(len(t)).reshape(x.shape)
        corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], -1)
        quads = corners[np.ptp(t[corners], axis=-1) < 0.05]
        faces += [offset + quads[:, [0, 2, 1]], offset + quads[:, [2, 3, 1]]]
        offset += len(t)
        moved = np.column_stack([pose[:, :3], pose[:, 3] + SHIFT])
        rows = tuple(tuple(map(float, row)) for row in moved)
        file, split = f"images/{number:05d}.png", "train" if number % 2 else "test"
        images.append(replace(image, file=file, world_from_camera=rows, split=split))
    replace(truth, images=tuple(images)).save(workspace.stage("train") / "cameras.json")
    points = np.concatenate(vertices)
    grey, upward = np.full_like(points, 0.5), np.tile([0.0, 0.0, 1.0], (len(points), 1))
    mesh = TriangleMesh(points, np.concatenate(faces).astype(np.int32), grey, upward)
    write_mesh(workspace.stage("mesh") / "mesh.ply", mesh)
    glb.write_mesh(workspace.stage("mesh") / "mesh.glb", mesh)
    turned = np.array([[0.0, -2, 0, 7], [2, 0, 0, 8], [0, 0, 2, 9]])
    frame = Frame(world="another", from_world=tuple(map(tuple, turned.tolist())))
    write_points(
        workspace.stage("pointcloud") / "pointcloud.ply",
        points @ turned[:, :3].T + turned[:, 3],
        normals=np.concatenate(normals) @ turned[:, :3].T / 2.0,
        frame=frame,
    )
    (workspace.stage("report") / "report.json").write_text(json.dumps(REPORT), "utf-8")
    return workspace


def test_a_finished_job_is_judged_without_running_it(job: Workspace, tmp_path: Path) -> None:
    out, result = tmp_path / "out", tmp_path / "result.json"
    arguments = ["object", "--job", str(job.root), "--frames", str(FRAMES)]
    arguments += ["--long-side", str(LONG_SIDE), "--out", str(out), "--json", str(result)]
    assert geometry.main(arguments) == 0
    (found,) = json.loads(result.read_text())["results"]
    assert found["poses"]["mean_center_error"] < 1e-6
    assert found["surface"]["precision"]["0.02"] > 0.99
    assert found["surface"]["recall"]["0.02"] > 0.9
    assert found["cloud"]["precision"]["0.01"] > 0.99
    assert found["cloud"]["accuracy"] < 1e-5
    assert found["cloud"]["recall"]["0.01"] > 0.8
    normals = found["surface"]["normals"]
    assert normals["cloud"]["num_points"] > 500
    assert normals["cloud"]["median_deg"] < 0.1
    assert normals["cloud"]["over_30_deg"] < 0.01
    assert 0.2 < normals["mesh"]["over_30_deg"] < 0.9
    assert found["depth"]["within_5_percent"] > 0.98
    assert found["depth"]["coverage"] > 0.8
    assert found["job_s"] == 80.0
    with Image.open(out / "object" / "turntable.png") as opened:
        assert np.asarray(opened).std() > 10
    with Image.open(out / "object" / "depth.png") as opened:
        assert opened.width == 4 * 68


def test_a_folder_with_sensor_depth_is_judged_at_held_out_views(
    job: Workspace, tmp_path: Path
) -> None:
    capture = tmp_path / "capture"
    (capture / "depth").mkdir(parents=True)
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    (job.stage("ingest") / "images").mkdir()
    frames, listed = [], []
    for number, image in enumerate(cameras.images):
        pose = pose_matrix(image)
        pose[:, 3] -= SHIFT
        depth = np.rint(1000 * depth_image(cameras.cameras[0], pose, TAKE.scene))
        Image.fromarray(depth.astype(np.uint16)).save(capture / "depth" / f"{number}.png")
        Image.new("RGB", (68, 120)).save(job.stage("ingest") / image.file)
        frames.append({"file_path": f"rgb/{number}.png", "depth_file_path": f"depth/{number}.png"})
        listed.append({"file": image.file, "source": f"packed/rgb/{number}.png"})
    (capture / "transforms.json").write_text(
        json.dumps({"depth_unit_scale_factor": 0.001, "frames": frames}), "utf-8"
    )
    CaptureRecord("nerfstudio", "a.zip", "00", images=listed).save(job.stage("ingest"))
    given = geometry.build_parser().parse_args([str(capture), "--job", str(job.root)])
    found = geometry.judge(str(capture), job, tmp_path / "out", given)
    assert found["depth"]["within_5_percent"] > 0.98
    assert 0.8 < found["depth"]["covered_and_within_5_percent"] <= found["depth"]["coverage"]
    assert (tmp_path / "out" / "depth.png").is_file()
    assert len(geometry.row_of(found)) == len(geometry.HEADER)


def test_a_posed_capture_of_a_scene_holds_its_exact_poses_and_depth(tmp_path: Path) -> None:
    path = scene_capture(tmp_path, TAKES["room"], 3, 64, posed=True)
    truth = walk(3, phone_camera(64), take=TAKES["room"])
    with zipfile.ZipFile(path) as archive:
        transforms = json.loads(archive.read("transforms.json"))
        for frame, image in zip(transforms["frames"], truth.images, strict=True):
            pose = pose_matrix(image)
            assert np.array(frame["transform_matrix"])[:3] == pytest.approx(pose)
            assert frame["timestamp"] == image.timestamp_s
            with archive.open(frame["depth_file_path"]) as file, Image.open(file) as opened:
                stored = np.asarray(opened) * transforms["depth_unit_scale_factor"]
            exact = depth_image(truth.cameras[0], pose, TAKES["room"].scene)
            assert stored == pytest.approx(exact, abs=0.00051)
    written = path.stat().st_mtime_ns
    assert scene_capture(tmp_path, TAKES["room"], 3, 64, posed=True).stat().st_mtime_ns == written


def test_a_folder_is_packed_as_it_lies(tmp_path: Path) -> None:
    (tmp_path / "capture" / "images").mkdir(parents=True)
    (tmp_path / "capture" / "images" / "a.png").write_bytes(b"a")
    archive = geometry.packed(tmp_path / "capture", tmp_path)
    with zipfile.ZipFile(archive) as made:
        assert made.namelist() == ["images/a.png"]
    assert geometry.packed(archive, tmp_path) == archive


def test_what_is_no_capture_or_too_many_for_a_job_is_refused(tmp_path: Path) -> None:
    for arguments in (["nothing-here"], ["room", "object", "--job", str(tmp_path)]):
        with pytest.raises(SystemExit):
            geometry.main(arguments)


def test_a_turntable_shows_colours_above_shades_below_and_no_backs() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    outwards = np.array([[q[a], q[b], q[c]] for q in sides for a, b, c in ((0, 1, 2), (0, 2, 3))])
    red = np.tile([1.0, 0.0, 0.0], (8, 1))
    picture = turntable(corners, outwards, red, num_views=2, side_px=40)
    assert picture.shape == (80, 80, 3)
    assert picture[20, 20].tolist() == [255, 0, 0]
    assert np.ptp(picture[60, 20].astype(int)) == 0
    assert len(np.unique(picture[40:, :40, 0])) >= 4
    # Seen from its inside-out twin, the near faces are open and the far ones show.
    inwards = turntable(corners, outwards[:, ::-1], red, num_views=2, side_px=40)
    assert inwards[20, 20].tolist() == [255, 0, 0]
    assert not np.array_equal(picture[40:], inwards[40:])
    assert turntable(corners, outwards[:0], red, 2, 40).max() == 0
    # Of a far copy beside it nothing is left in a ball around the first.
    pair = np.concatenate([corners, corners + 50.0])
    both = np.concatenate([outwards, outwards + 8])
    ball = (np.array([0.5, 0.5, 0.5]), 1.0)
    alone = turntable(pair, both, np.tile(red, (2, 1)), 2, 40, ball)
    assert np.array_equal(alone, turntable(corners, outwards, red, 2, 40, ball))
    assert alone[20, 20].tolist() == [255, 0, 0]


def test_errors_are_red_before_blue_behind_and_black_where_nothing_is() -> None:
    truth = np.array([[2.0, 2.0, 2.0, 2.0, 0.0]])
    found = np.array([[2.0, 1.7, 2.3, 0.0, 2.0]])
    right, before, behind, missing, unknown = error_picture(found, truth)[0].tolist()
    assert right == [255, 255, 255]
    assert before[0] > before[2]
    assert behind[2] > behind[0]
    assert missing == [0, 0, 0]
    assert unknown == [110, 110, 110]
    near, far, nothing = depth_picture(np.array([[1.0, 3.0, 0.0]]), 1.0, 3.0)[0].tolist()
    assert near == [253, 231, 37]
    assert far == [68, 1, 84]
    assert nothing == [0, 0, 0]


def test_millimetres_are_read_at_another_size_without_mixing_depths(tmp_path: Path) -> None:
    stored = np.full((20, 30), 1500, np.uint16)
    stored[:, 15:] = 4000
    stored[:5] = 0
    Image.fromarray(stored).save(tmp_path / "depth.png")
    depth = read_depth_png(tmp_path / "depth.png", 0.001, (10, 15))
    assert sorted(np.unique(depth).tolist()) == pytest.approx([0.0, 1.5, 4.0])
    assert depth[9, 0] == pytest.approx(1.5)
    assert (depth[:2] == 0).all()
    larger = read_depth_png(tmp_path / "depth.png", 0.001, (40, 60))
    assert larger.shape == (40, 60)
    assert larger[39, 59] == pytest.approx(4.0)


def test_what_is_no_depth_picture_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "grey.png")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "rgb.png")
    (tmp_path / "text.png").write_text("no picture")
    for name in ("grey.png", "rgb.png", "text.png", "absent.png"):
        with pytest.raises(ValueError, match=name):
            read_depth_png(tmp_path / name, 0.001, (4, 4))
