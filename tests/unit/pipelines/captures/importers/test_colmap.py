"""COLMAP models, written by COLMAP's own library: poses, every lens, several models, folders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch

from pipelines.captures import colmap_model
from pipelines.captures.importers import colmap
from pipelines.captures.sniff import sniff
from pipelines.exports.formats.ply import read_ply
from pipelines.nerf.space import lenses as formulas
from pipelines.registry import skipped_stages
from pipelines.sample.align import similarity
from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from pipelines.scene.colmap_lenses import COLMAP_LENSES, OTHER_LENSES, lens_from_colmap
from tests.sfm_writers import colmap_files, pictures_of, sparse_points, walked
from tests.unit.pipelines.captures.archives import nerfstudio_files, picture, write_zip
from tests.unit.pipelines.captures.ingesting import (
    Files,
    assert_poses,
    cameras,
    failure,
    ingest,
    sources,
    warning_with,
)

TRUTH = walked()
PICTURES = pictures_of(TRUTH)


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("folder", ["", "sparse/0/", "scan/colmap/sparse/"])
def test_poses_and_lens_are_those_that_were_written(tmp_path: Path, form: str, folder: str) -> None:
    files = PICTURES | colmap_files(TRUTH, form=form, folder=folder)
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "colmap"
    summary, ctx = ingest(tmp_path / "job", files)
    assert (summary["kind"], summary["num_posed"], summary["metric"]) == ("colmap", 10, False)
    assert skipped_stages("colmap") == {"frames"}
    assert_poses(ctx, TRUTH)
    assert cameras(ctx).cameras == TRUTH.cameras
    assert "applied_transform" not in cameras(ctx).notes, "a world that stands is not turned"


def test_points_that_enough_images_saw_are_kept_and_used(tmp_path: Path) -> None:
    for form in ("binary", "text"):
        _, ctx = ingest(tmp_path / form, PICTURES | colmap_files(TRUTH, form=form))
        cloud = read_ply(ctx.out / "points.ply")
        places, colors = sparse_points()
        np.testing.assert_allclose(cloud.points, places, atol=1e-6)
        np.testing.assert_array_equal(cloud.colors, colors)


def test_a_world_that_lies_is_turned_up_and_its_points_with_it(tmp_path: Path) -> None:
    """As COLMAP leaves it: the axes of its first camera, any scale."""
    first = np.linalg.inv(np.vstack([pose_matrix(TRUTH.images[0]), [0, 0, 0, 1]]))
    flipped = np.diag([1.0, -1.0, -1.0, 1.0]) @ first
    poses = [flipped @ np.vstack([pose_matrix(image), [0, 0, 0, 1]]) for image in TRUTH.images]
    model = _moved(TRUTH, poses)
    _, ctx = ingest(tmp_path, PICTURES | colmap_files(model))
    file = cameras(ctx)
    found = np.array([image.world_from_camera for image in file.images])
    truth = {image.file: pose_matrix(image)[:3] for image in TRUTH.images}
    true = np.array([truth[source] for source in sources(ctx)])
    move = similarity(found[:, :, 3], true[:, :, 3])
    np.testing.assert_allclose(move.apply_to_cameras(found), true, atol=1e-9)
    assert move.rotation[2, 2] > np.cos(np.radians(8.0)), "+Z is up, as a hand holds a phone"
    written = read_ply(ctx.out / "points.ply").points.astype(float)
    back = np.linalg.inv(np.vstack([file.notes["applied_transform"], [0, 0, 0, 1]]))
    np.testing.assert_allclose(
        written @ back[:3, :3].T + back[:3, 3], sparse_points()[0], atol=1e-6
    )


def _moved(truth: CamerasFile, poses: list[Any]) -> CamerasFile:
    images = tuple(
        replace(image, world_from_camera=tuple(map(tuple, pose[:3].tolist())))
        for image, pose in zip(truth.images, poses, strict=True)
    )
    return replace(truth, images=images)


@pytest.mark.parametrize("model", COLMAP_LENSES)
def test_every_lens_shows_points_where_colmap_shows_them(model: str) -> None:
    lens = COLMAP_LENSES[model]
    values = {"f": 512.0, "fl_x": 512.0, "fl_y": 498.0, "cx": 321.5, "cy": 238.25}
    values |= {"k1": -0.12, "k2": 0.03, "k3": -0.004, "k4": 0.001, "p1": 2e-3, "p2": -1e-3}
    params = [values.get(name, 0.0) for name in lens.terms]
    camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
    assert int(camera.model) == lens.number
    ours = lens_from_colmap(model, 640, 480, params)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (50, 2)), np.ones(50)])
    np.testing.assert_allclose(
        _shown(ours, points), np.array(camera.img_from_cam(points)), atol=1e-9
    )


def _shown(lens: Intrinsics, points: np.ndarray) -> np.ndarray:
    """Pixels of points in an OpenCV camera, by the formulas that training uses."""
    row = [lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2]
    terms = torch.tensor([row] * len(points), dtype=torch.float64)
    model = torch.full((len(points),), formulas.CAMERA_MODELS.index(lens.model))
    plane = formulas.distort(torch.from_numpy(points), terms, model).numpy()
    return plane * [lens.fl_x, lens.fl_y] + [lens.cx, lens.cy]


def test_the_table_knows_every_model_that_colmap_has() -> None:
    known = {lens.number: (name, len(lens.terms)) for name, lens in COLMAP_LENSES.items()}
    known |= OTHER_LENSES
    for number, (name, num_terms) in known.items():
        kind = pycolmap.CameraModelId(number)
        assert kind.name == name
        assert len(pycolmap.Camera.create_from_model_id(1, kind, 9.0, 6, 4).params) == num_terms
    with pytest.raises((ValueError, RuntimeError)):
        pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(len(known)), 9.0, 6, 4)


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("name", [name for name, _ in OTHER_LENSES.values()])
def test_a_lens_without_an_equal_is_refused_by_its_name(
    tmp_path: Path, name: str, form: str
) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, name, 60.0, 64, 48)
    error = failure(tmp_path, PICTURES | colmap_files(TRUTH, form=form, lenses=[camera]))
    assert error.code == "poses_malformed"
    assert name in error.message
    assert "undistort" in error.hint.lower()


def test_full_opencv_is_taken_as_long_as_nothing_divides(tmp_path: Path) -> None:
    params = [60.0, 61.0, 32.0, 24.0, -0.1, 0.02, 1e-3, 2e-3, 0.003, 0.0, 0.0, 0.0]
    lens = lens_from_colmap("FULL_OPENCV", 64, 48, params)
    assert (lens.model, lens.k3, lens.p2) == ("OPENCV", 0.003, 2e-3)
    camera = pycolmap.Camera(model="FULL_OPENCV", width=64, height=48, params=[*params[:-1], 0.1])
    error = failure(tmp_path, PICTURES | colmap_files(TRUTH, lenses=[camera]))
    assert "FULL_OPENCV with terms that divide" in error.message


def test_each_image_has_its_own_lens(tmp_path: Path) -> None:
    wide = Intrinsics(64, 48, 30.0, 31.0, 32.0, 24.0, "OPENCV_FISHEYE", 0.02, -0.01, 0.003, 7e-4)
    plain = Intrinsics(48, 64, 61.0, 60.0, 24.0, 32.0)
    truth = walked(wide, plain)
    _, ctx = ingest(tmp_path, pictures_of(truth) | colmap_files(truth, form="text"))
    assert_poses(ctx, truth)
    of = {image.file: truth.cameras[image.camera] for image in truth.images}
    for image, source in zip(cameras(ctx).images, sources(ctx), strict=True):
        assert cameras(ctx).cameras[image.camera] == of[source]


def test_the_model_with_most_pictures_is_read_and_the_others_told(tmp_path: Path) -> None:
    """COLMAP's model 0 is often a spurious one of a few images."""
    small = colmap_files(TRUTH, folder="sparse/0/", indices=[0, 1])
    large = colmap_files(TRUTH, folder="sparse/1/", indices=list(range(1, 10)))
    summary, ctx = ingest(tmp_path, PICTURES | small | large)
    assert (summary["num_posed"], summary["num_models"]) == (9, 2)
    assert_poses(ctx, TRUTH)
    told = warning_with(summary, "sparse/1/images.bin", "9 images", "sparse/0/images.bin")
    assert "2 images" in told
    assert warning_with(summary, "not listed in sparse/1/images.bin")
    assert len(summary["warnings"]) == 2


def test_pictures_at_full_size_come_before_their_reduced_copies(tmp_path: Path) -> None:
    reduced = {f"images_2/{name[7:]}": picture(32, 24, seed=7) for name in PICTURES}
    summary, ctx = ingest(tmp_path, reduced | PICTURES | colmap_files(TRUTH))
    assert all(source.startswith("images/") for source in sources(ctx))
    assert warning_with(summary, "images_2/", "not listed in sparse/0/images.bin")


def test_a_model_reads_its_reduced_pictures_where_only_those_came(tmp_path: Path) -> None:
    reduced = {f"images_2/{name[7:]}": picture(32, 24, seed=7) for name in PICTURES}
    _, ctx = ingest(tmp_path, {**reduced, **colmap_files(TRUTH)})
    (lens,) = cameras(ctx).cameras
    assert (lens.width, lens.fl_x, lens.cx) == (32, TRUTH.cameras[0].fl_x / 2, 32.75 / 2)


def test_names_from_another_machine_are_found_by_their_end(tmp_path: Path) -> None:
    files = colmap_files(TRUTH, form="text")
    text = files["sparse/0/images.txt"].decode()
    files["sparse/0/images.txt"] = (
        text.replace("IMG_", "C:\\shots\\IMG_").replace("left/C:", "C:").encode()
    )
    summary, ctx = ingest(tmp_path, PICTURES | files)
    assert_poses(ctx, TRUTH)
    assert warning_with(summary, "10 paths", "matched by the end of the name")


def test_masks_of_the_same_names_are_no_pictures_of_the_model(tmp_path: Path) -> None:
    masks = {f"masks/{name[7:]}": picture(seed=50) for name in PICTURES}
    _, ctx = ingest(tmp_path, {**masks, **PICTURES, **colmap_files(TRUTH)})
    assert all(source.startswith("images/") for source in sources(ctx))


def test_text_is_read_where_the_binary_beside_it_is_damaged(tmp_path: Path) -> None:
    both = colmap_files(TRUTH) | colmap_files(TRUTH, form="text")
    both["sparse/0/images.bin"] = both["sparse/0/images.bin"][:300]
    summary, ctx = ingest(tmp_path, PICTURES | both)
    assert_poses(ctx, TRUTH)
    assert warning_with(summary, "A model cannot be read", "sparse/0/images.bin is cut off")


def test_damaged_points_cost_the_points_alone(tmp_path: Path) -> None:
    files = colmap_files(TRUTH)
    files["sparse/0/points3D.bin"] = files["sparse/0/points3D.bin"][:-9]
    summary, ctx = ingest(tmp_path, PICTURES | files)
    assert not (ctx.out / "points.ply").exists()
    assert warning_with(summary, "points are not used", "points3D.bin is cut off")
    assert_poses(ctx, TRUTH)


def test_a_model_without_pictures_says_which_it_wants(tmp_path: Path) -> None:
    error = failure(tmp_path, colmap_files(TRUTH))
    assert error.code == "poses_missing"
    assert "lists 10 pictures" in error.message
    assert "send the pictures alone" in error.hint
    assert "IMG_9.jpg" in error.message


def test_transforms_json_comes_first(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", PICTURES | colmap_files(TRUTH) | nerfstudio_files(4))
    assert sniff(path, "c").kind == "nerfstudio"


@pytest.mark.parametrize(
    "files",
    [
        {"cameras.txt": "Bought: one Leica", "images.txt": "1 2 3"},
        {"cameras.bin": b"\xff" * 40, "images.bin": b""},
        {"cameras.bin": b"\0" * 8, "points3D.bin": b"\0" * 8},
        {"a/cameras.txt": "# x", "b/images.txt": "# x"},
    ],
)
def test_what_only_has_the_names_is_no_model(tmp_path: Path, files: Files) -> None:
    assert sniff(write_zip(tmp_path / "c", PICTURES | files), "c").kind == "images"


def rewritten(old: str, new: str, name: str = "images.txt") -> dict[str, bytes]:
    """The model as text with a change in one file."""
    files = colmap_files(TRUTH, form="text")
    text = files[f"sparse/0/{name}"].decode()
    assert old in text
    return files | {f"sparse/0/{name}": text.replace(old, new).encode()}


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        (" 1 left/", " 9 left/", "images.txt"),
        ("OPENCV", "FOV", "cameras.txt"),
        ("64 48", "0 0", "cameras.txt"),
        ("61.5", "nan", "cameras.txt"),
        ("61.5", "1e999", "cameras.txt"),
    ],
)
def test_faults_are_refused_by_name(tmp_path: Path, old: str, new: str, name: str) -> None:
    error = failure(tmp_path, PICTURES | rewritten(old, new, name))
    assert error.code == "poses_malformed"
    assert any(word in error.message for word in ("IMG_", "cameras.txt", "images.txt"))


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        (" 1 left/IMG_10.jpg", "", "images.txt"),
        ("\n99 ", "\n99 0 0 0 0 ", "images.txt"),
        ("64 48", "64", "cameras.txt"),
        ("-0.0", "nan", "cameras.txt"),
        ("IMG_", "DSC_other_", "images.txt"),
    ],
)
def test_a_model_of_no_use_is_told_and_leaves_plain_photos(
    tmp_path: Path, old: str, new: str, name: str
) -> None:
    """Cut off, garbled, or about other pictures: what another program left beside the photos."""
    files = PICTURES | rewritten(old, new, name)
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "images"
    summary, ctx = ingest(tmp_path / "job", files)
    assert (summary["kind"], summary["num_images"]) == ("images", 10)
    assert not (ctx.out / "cameras.json").exists()
    why = "names none of the pictures" if "other" in new else "cannot be read ("
    assert warning_with(summary, "sparse/0/", "a COLMAP model that", why)


def test_a_useful_model_behind_a_broken_one_is_read(tmp_path: Path) -> None:
    left = {"a.bin": b"", **colmap_files(TRUTH, folder="")}
    left["images.bin"] = left["images.bin"][:200]
    summary, ctx = ingest(tmp_path, PICTURES | left | colmap_files(TRUTH, folder="sparse/1/"))
    assert summary["kind"] == "colmap"
    assert_poses(ctx, TRUTH)


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("what", ["images", "cameras"])
def test_a_model_with_more_than_it_may_have_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, what: str
) -> None:
    truth = walked(*(replace(TRUTH.cameras[0], fl_x=60.0 + n) for n in range(9)), num=9)
    files = pictures_of(truth) | colmap_files(truth, form=form)
    monkeypatch.setattr(colmap_model, "MOST_IMAGES", 9)
    assert ingest(tmp_path / "enough", files)[0]["num_posed"] == 9
    if what == "images":
        truth = walked(*TRUTH.cameras[:1], num=10)
    else:
        truth = replace(truth, cameras=(*truth.cameras, truth.cameras[0]))
    files = pictures_of(truth) | colmap_files(truth, form=form)
    summary, _ = ingest(tmp_path / "more", files)
    assert summary["kind"] == "images"
    assert warning_with(summary, f"more than 9 {what}")


def test_of_very_many_models_some_are_looked_at_and_that_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap, "_MOST_MODELS", 2)
    files = dict(PICTURES)
    for n, indices in enumerate((range(4), range(10), range(5))):
        files |= colmap_files(TRUTH, folder=f"sparse/{n}/", indices=indices)
    summary, ctx = ingest(tmp_path, files)
    assert len(cameras(ctx).images) == 10
    assert warning_with(summary, "cannot be read: of 3 the first 2")


def test_an_empty_list_is_a_list_of_other_pictures(tmp_path: Path) -> None:
    empty = {"sparse/0/cameras.bin": b"\0" * 8, "sparse/0/images.bin": b"\0" * 8}
    summary, _ = ingest(tmp_path, PICTURES | empty)
    assert summary["kind"] == "images"
    assert warning_with(summary, "names none of the pictures")


def test_one_bad_pose_in_ten_is_left_out_by_name(tmp_path: Path) -> None:
    files = colmap_files(TRUTH, form="text")
    lines = files["sparse/0/images.txt"].decode().splitlines()
    row = next(n for n, line in enumerate(lines) if line.endswith("left/IMG_10.jpg"))
    lines[row] = " ".join(["99", "nan", *lines[row].split()[2:]])
    files["sparse/0/images.txt"] = "\n".join(lines).encode()
    summary, ctx = ingest(tmp_path, PICTURES | files)
    assert len(cameras(ctx).images) == 9
    assert "left/IMG_10.jpg" in warning_with(summary, "Left out")
