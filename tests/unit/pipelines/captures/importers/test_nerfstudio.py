"""nerfstudio's layout: poses, lenses and masks are kept; what is missing or ignored is told."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.errors import CaptureError
from pipelines.sample.film import phone_camera, walk
from pipelines.sample.scene import pose_matrix
from tests.unit.pipelines.captures.archives import (
    depth_exr,
    depth_png,
    exif,
    nerfstudio_files,
    picture,
    pose,
    red_corner,
)
from tests.unit.pipelines.captures.ingesting import (
    cameras,
    code_of,
    depth_of,
    failure,
    ingest,
    sources,
    warning_with,
)


def frames_of(count: int, **keys: Any) -> list[dict[str, Any]]:
    return [
        {"file_path": f"images/{n}.jpg", "transform_matrix": pose(float(n)), **keys}
        for n in range(count)
    ]


def test_nerfstudio_poses_and_lens_are_kept(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, nerfstudio_files(k1=0.1, p2=0.02))
    file = cameras(ctx)
    assert (summary["kind"], len(file.images), file.metric) == ("nerfstudio", 4, False)
    assert [image.world_from_camera[0][3] for image in file.images] == [0, 1, 2, 3]
    (lens,) = file.cameras
    assert (lens.model, lens.k1, lens.p2, lens.fl_y, lens.cx) == ("OPENCV", 0.1, 0.02, 61.0, 31.0)


def test_nerfstudio_pictures_pair_by_name_and_gaps_are_warned_of(tmp_path: Path) -> None:
    files = nerfstudio_files(6)
    del files["images/1.jpg"]
    files["images/other.jpg"] = picture()
    summary, ctx = ingest(tmp_path, {"top/" + name: data for name, data in files.items()})
    assert [image.world_from_camera[0][3] for image in cameras(ctx).images] == [0, 2, 3, 4, 5]
    assert (summary["num_missing"], summary["num_unlisted"]) == (1, 1)
    assert "images/1.jpg" in summary["warnings"][0]


def test_nerfstudio_lens_is_scaled_to_the_real_size(tmp_path: Path) -> None:
    _, ctx = ingest(tmp_path, nerfstudio_files(w=128.0, h=96.0, fl_x=120.0, fl_y=122.0))
    (lens,) = cameras(ctx).cameras
    assert (lens.width, lens.height, lens.fl_x, lens.fl_y, lens.cx) == (64, 48, 60.0, 61.0, 15.5)


def test_nerfstudio_lens_from_its_field_of_view(tmp_path: Path) -> None:
    files = nerfstudio_files()
    top = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames_of(4)}
    files["transforms.json"] = json.dumps(top)
    _, ctx = ingest(tmp_path, files)
    (lens,) = cameras(ctx).cameras
    assert (lens.fl_x, lens.fl_y) == (pytest.approx(64.0), pytest.approx(64.0))
    assert (lens.model, lens.cx, lens.cy) == ("PINHOLE", 32.0, 24.0)


def test_nerfstudio_lens_per_frame_masks_and_fisheye(tmp_path: Path) -> None:
    mask = io.BytesIO()
    PIL.Image.new("L", (64, 48), 255).save(mask, "PNG")
    frames = frames_of(4)
    frames[1] |= {"fl_x": 70.0, "mask_path": "masks/1.png"}
    top = {"camera_model": "OPENCV_FISHEYE", "distortion_params": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]}
    files = nerfstudio_files(4, frames=frames, **top) | {"masks/1.png": mask.getvalue()}
    summary, ctx = ingest(tmp_path, files)
    file = cameras(ctx)
    assert [file.cameras[image.camera].fl_x for image in file.images] == [60.0, 70.0, 60.0, 60.0]
    lens = file.cameras[0]
    assert (lens.model, lens.k4, lens.p1) == ("OPENCV_FISHEYE", 0.4, 0.0)
    assert [image.mask for image in file.images] == [None, "masks/00002.png", None, None]
    assert (ctx.out / "masks" / "00002.png").is_file()
    assert summary["num_unlisted"] == 0


def test_posed_pictures_are_not_turned_by_their_exif(tmp_path: Path) -> None:
    files = nerfstudio_files(4)
    files |= {f"images/{n}.jpg": picture(seed=n, exif=exif(6)) for n in range(4)}
    _, ctx = ingest(tmp_path, files)
    path = ctx.out / "images" / "00001.jpg"
    assert red_corner(path) == (True, True)
    with PIL.Image.open(path) as image:
        assert image.size == (64, 48)
        assert not image.getexif()


@pytest.mark.parametrize("path", ["../../etc/passwd.jpg", "/etc/passwd", "C:/x.jpg", "..\\x.jpg"])
def test_path_out_of_the_archive_leads_nowhere(tmp_path: Path, path: str) -> None:
    frames = frames_of(6)
    frames[2]["file_path"] = path
    summary, ctx = ingest(tmp_path, nerfstudio_files(6, frames=frames))
    assert sources(ctx) == [f"images/{n}.jpg" for n in (0, 1, 3, 4, 5)]
    assert path in warning_with(summary, "not in the archive")


@pytest.mark.parametrize(
    "folder",
    [
        "/home/somebody/scan/images/",
        "C:\\scan\\images\\",
        "../slike\\",
        "../images/",
        "elsewhere/",
        "",
    ],
)
def test_paths_of_another_machine_are_matched_by_the_end_of_the_name(
    tmp_path: Path, folder: str
) -> None:
    frames = frames_of(4)
    for n, frame in enumerate(frames):
        frame["file_path"] = f"{folder}{n}.JPG"
    summary, ctx = ingest(tmp_path, nerfstudio_files(frames=frames))
    assert [image.world_from_camera[0][3] for image in cameras(ctx).images] == [0, 1, 2, 3]
    assert "0.JPG" in warning_with(summary, "4 paths", "end of the name")


def test_of_equal_names_the_one_with_most_folders_in_common_is_matched(tmp_path: Path) -> None:
    frames = [
        {"file_path": f"/x/{folder}/{n}.jpg", "transform_matrix": pose(float(n), float(row))}
        for row, folder in enumerate(("left", "right"))
        for n in range(3)
    ]
    files = nerfstudio_files(frames=frames)
    files = {name: data for name, data in files.items() if not name.startswith("images/")}
    files |= {
        f"data/{folder}/{n}.jpg": picture(seed=10 * row + n)
        for row, folder in enumerate(("left", "right"))
        for n in range(3)
    }
    _, ctx = ingest(tmp_path, files)
    places = [image.world_from_camera[1][3] for image in cameras(ctx).images]
    assert sources(ctx)[3] == "data/right/0.jpg"
    assert places == [0, 0, 0, 1, 1, 1]


def test_neither_an_ambiguous_name_nor_a_mask_is_matched(tmp_path: Path) -> None:
    frames = frames_of(6)
    frames[0]["file_path"] = "gone/9.jpg"  # in two folders
    frames[1]["file_path"] = "gone/8.jpg"  # only as a mask
    files = nerfstudio_files(6, frames=frames)
    files |= {"a/9.jpg": picture(), "b/9.jpg": picture(), "masks/8.jpg": picture()}
    summary, ctx = ingest(tmp_path, files)
    assert sources(ctx) == [f"images/{n}.jpg" for n in range(2, 6)]
    assert summary["num_missing"] == 2


SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
NAN = [[float("nan"), 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    "matrix", [SHEARED, MIRRORED, NAN, [[1, 2], [3, 4]], "text", [[0] * 4] * 4, [[True] * 4] * 4]
)
def test_malformed_pose_is_refused(tmp_path: Path, matrix: Any) -> None:
    frames = frames_of(4)
    frames[3]["transform_matrix"] = matrix
    assert code_of(tmp_path, nerfstudio_files(frames=frames)) == "poses_malformed"


@pytest.mark.parametrize(
    ("top", "code"),
    [
        ({"frames": []}, "poses_missing"),
        ({"frames": None}, "poses_missing"),
        ({"frames": [{"file_path": "images/0.jpg"}]}, "poses_missing"),
        ({"frames": frames_of(1, file_path="images/none.jpg")}, "poses_missing"),
        ({"frames": ["x"]}, "poses_malformed"),
        ({"camera_model": "FISHEYE624"}, "poses_malformed"),
        ({"camera_model": ["OPENCV"]}, "poses_malformed"),
        ({"camera_model": {}}, "poses_malformed"),
        ({"w": 48, "h": 64}, "poses_malformed"),
        ({"w": 0}, "poses_malformed"),
        ({"fl_x": -5.0}, "poses_malformed"),
        ({"fl_x": "wide"}, "poses_malformed"),
        ({"cx": 1e9}, "poses_malformed"),
        ({"applied_transform": [[1, 0]]}, "poses_malformed"),
    ],
)
def test_unusable_transforms_are_refused(tmp_path: Path, top: dict[str, Any], code: str) -> None:
    assert code_of(tmp_path, nerfstudio_files(**top)) == code


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "\xff\xfe", '{"frames": 1e999}'])
def test_transforms_that_are_no_json_are_refused(tmp_path: Path, text: str) -> None:
    files = nerfstudio_files() | {"transforms.json": text.encode("latin-1")}
    assert code_of(tmp_path, files) in ("poses_malformed", "poses_missing")


def test_unsupported_camera_model_names_those_that_are(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="OPENCV_FISHEYE"):
        ingest(tmp_path, nerfstudio_files(camera_model="EQUIRECTANGULAR"))


# --- what cannot be used, and what is not ---------------------------------------------------


@pytest.mark.parametrize(
    "spoil",
    [
        {"transform_matrix": NAN},
        {"transform_matrix": SHEARED},
        {"transform_matrix": None},
        {"fl_x": -1.0},
        {"file_path": 7},
        {"mask_path": "images/other_size.png"},
    ],
)
def test_one_bad_frame_in_ten_is_left_out_by_name(tmp_path: Path, spoil: dict[str, Any]) -> None:
    frames = frames_of(10)
    frames[3] |= spoil
    files = nerfstudio_files(10, frames=frames)
    if "mask_path" in spoil:
        files["images/other_size.png"] = picture(32, 24, kind="PNG")
    summary, ctx = ingest(tmp_path, files)
    assert [image.world_from_camera[0][3] for image in cameras(ctx).images] == [
        n for n in range(10) if n != 3
    ]
    written = {path.name for path in (ctx.out / "images").iterdir()}
    assert written == {Path(image.file).name for image in cameras(ctx).images}
    told = warning_with(summary, "Left out")
    if "file_path" not in spoil:
        assert summary["warnings"] == [told]
    assert "images/3.jpg" in told or "Frame 3" in told or "other_size" in told


def test_two_bad_frames_in_ten_fail_the_capture(tmp_path: Path) -> None:
    frames = frames_of(10)
    frames[3]["transform_matrix"] = frames[4]["transform_matrix"] = NAN
    error = failure(tmp_path, nerfstudio_files(10, frames=frames))
    assert (error.code, error.message[:8]) == ("poses_malformed", "2 of 10 ")


def test_fewer_posed_pictures_than_training_needs_are_refused(tmp_path: Path) -> None:
    assert code_of(tmp_path, nerfstudio_files(3)) == "too_few_images"


def test_mask_that_is_not_there_is_told(tmp_path: Path) -> None:
    frames = frames_of(4)
    frames[2]["mask_path"] = "masks/2.png"
    summary, ctx = ingest(tmp_path, nerfstudio_files(frames=frames))
    assert "masks/2.png" in warning_with(summary, "masks", "used whole")
    assert cameras(ctx).images[2].mask is None


def test_picture_listed_twice_keeps_its_first_pose_and_is_told(tmp_path: Path) -> None:
    frames = [*frames_of(4), {"file_path": "images/1.jpg", "transform_matrix": pose(9.0)}]
    summary, ctx = ingest(tmp_path, nerfstudio_files(frames=frames))
    assert [image.world_from_camera[0][3] for image in cameras(ctx).images] == [0, 1, 2, 3]
    assert "images/1.jpg" in warning_with(summary, "more than once")


def test_what_the_file_says_and_nobody_heeds_is_told(tmp_path: Path) -> None:
    top: dict[str, Any] = {
        "train_filenames": ["images/0.jpg"],
        "ply_file_path": "sparse_pc.ply",
        "orientation_override": "pca",
    }
    files = nerfstudio_files(**top) | {"sparse_pc.ply": "ply"}
    files |= {f"images_2/{n}.jpg": picture(32, 24, seed=n) for n in range(4)}
    summary, ctx = ingest(tmp_path, files)
    assert len(cameras(ctx).images) == 4
    for words in (
        ("names a point cloud",),
        ("hold out",),
        ("orientation_override",),
        ("4 pictures in images_2/", "not listed"),
        ("(sparse_pc.ply)", "point clouds are not read"),
    ):
        assert warning_with(summary, *words)


# --- depth ----------------------------------------------------------------------------------


COUNTS = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) * 300
"""Depth at a quarter of the pictures' size; the first count, 0, is unknown."""


def with_depth(count: int = 4, **top: Any) -> dict[str, bytes | str]:
    frames = frames_of(count)
    for n, frame in enumerate(frames):
        frame["depth_file_path"] = f"depth/{n}.png"
    files = nerfstudio_files(count, **({"frames": frames} | top))
    return files | {f"depth/{n}.png": depth_png(COUNTS) for n in range(count)}


def test_depth_is_kept_in_the_poses_unit(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, with_depth())
    file = cameras(ctx)
    assert [image.depth for image in file.images] == [f"depth/{n:05d}.npz" for n in range(1, 5)]
    assert (summary["num_depths"], summary["warnings"], file.metric) == (4, [], False)
    assert summary["num_unlisted"] == 0
    z = depth_of(ctx, 2)
    assert (z.dtype, z.shape) == (np.float32, (12, 16))
    np.testing.assert_allclose(z, COUNTS * 0.001, rtol=1e-6)
    assert not list(ctx.out.glob(".raw*"))


def test_depth_unit_and_applied_scale_multiply_and_a_frame_has_its_own(tmp_path: Path) -> None:
    """As nerfstudio does: depth is in the original world's unit, poses are in the file's."""
    frames = frames_of(4)
    for n, frame in enumerate(frames):
        frame["depth_file_path"] = f"depth/{n}.png"
    frames[1]["depth_unit_scale_factor"] = 0.5
    top: dict[str, Any] = {"frames": frames, "depth_unit_scale_factor": 0.01, "applied_scale": 0.25}
    _, ctx = ingest(tmp_path, with_depth(**top))
    np.testing.assert_allclose(depth_of(ctx, 0), COUNTS * 0.0025, rtol=1e-6)
    np.testing.assert_allclose(depth_of(ctx, 1), COUNTS * 0.125, rtol=1e-6)


@pytest.mark.parametrize("unit", [0, -0.001, "mm", None, True, 1e999])
def test_depth_in_no_unit_is_not_used_and_told(tmp_path: Path, unit: Any) -> None:
    summary, ctx = ingest(tmp_path, with_depth(depth_unit_scale_factor=unit))
    assert [image.depth for image in cameras(ctx).images] == [None] * 4
    assert not (ctx.out / "depth").exists()
    (told,) = summary["warnings"]
    assert told.startswith("4 depth maps are not used")


def test_depth_that_is_not_there_is_told_and_its_picture_kept(tmp_path: Path) -> None:
    files = with_depth()
    del files["depth/1.png"], files["depth/3.png"]
    summary, ctx = ingest(tmp_path, files)
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, False, True, False]
    assert "depth/1.png, depth/3.png" in warning_with(summary, "2 of 4 depth maps", "not in the")


def test_depth_on_another_machine_is_matched_but_never_with_a_picture(tmp_path: Path) -> None:
    frames = frames_of(4)
    for n, frame in enumerate(frames):
        frame["depth_file_path"] = f"/home/somebody/depth/{n}.png"
    frames[3]["depth_file_path"] = "z/3.jpg"
    files = with_depth(frames=frames)
    summary, ctx = ingest(tmp_path, files)
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, True, True, False]
    assert warning_with(summary, "3 depth maps", "end of the name")
    assert warning_with(summary, "1 of 4 depth maps", "z/3.jpg")


UNUSABLE = {
    "is neither": b"a map of depth" + bytes(60),
    "does not decode": depth_png(COUNTS)[:90],
    "8 bits": depth_png(np.full((12, 16), 9, np.uint8)),
    "colours": picture(16, 12, kind="PNG"),
    "is 9x12, its picture 64x48: not": depth_png(COUNTS[:, :9]),
    "can be trusted": depth_png(np.zeros((12, 16), np.uint16)),
}


@pytest.mark.parametrize("why", UNUSABLE)
def test_depth_that_cannot_be_used_costs_no_picture(tmp_path: Path, why: str) -> None:
    files = with_depth()
    files["depth/2.png"] = UNUSABLE[why]
    summary, ctx = ingest(tmp_path, files)
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, True, False, True]
    assert why in warning_with(summary, "1 of 4 depth maps cannot be used", "depth/2.png")
    assert len(summary["warnings"]) == 1
    assert {path.name for path in (ctx.out / "depth").iterdir()} == {
        "00001.npz", "00002.npz", "00004.npz",
    }  # fmt: skip


def test_depth_of_a_frame_that_is_left_out_is_left_with_it(tmp_path: Path) -> None:
    frames = frames_of(12)
    for n, frame in enumerate(frames):
        frame["depth_file_path"] = f"depth/{n}.png"
    frames[3]["transform_matrix"] = SHEARED
    summary, ctx = ingest(tmp_path, with_depth(12, frames=frames))
    assert summary["num_depths"] == 11
    assert len(list((ctx.out / "depth").iterdir())) == 11
    assert warning_with(summary, "(depth/3.png)", "their pictures are left out")


def test_depth_whose_picture_is_not_there_is_listed_all_the_same(tmp_path: Path) -> None:
    files = with_depth(6)
    del files["images/1.jpg"]
    summary, _ = ingest(tmp_path, files)
    assert (summary["num_depths"], summary["num_missing"], summary["num_unlisted"]) == (5, 1, 0)
    assert warning_with(summary, "(depth/1.png)", "their pictures are left out")


def test_depth_in_openexr_and_of_the_cameras_size(tmp_path: Path) -> None:
    frames = frames_of(4, depth_file_path="z.exr", depth_unit_scale_factor=1.0)
    values = np.linspace(0.5, 4.0, 48 * 64).reshape(48, 64)
    files = nerfstudio_files(frames=frames) | {"z.exr": depth_exr(values)}
    _, ctx = ingest(tmp_path, files)
    np.testing.assert_allclose(depth_of(ctx, 3), values, rtol=1e-3)


def lying(count: int = 8, **top: Any) -> dict[str, bytes | str]:
    """A walk around the sample's table in a world whose +Y is up."""
    files = nerfstudio_files(count, **top)
    transforms = json.loads(files["transforms.json"])
    walked = walk(count, phone_camera(64)).images
    for frame, image in zip(transforms["frames"], walked, strict=True):
        laid = Y_UP @ pose_matrix(image)[:3]
        frame["transform_matrix"] = [*laid.tolist(), [0.0, 0.0, 0.0, 1.0]]
    return {**files, "transforms.json": json.dumps(transforms)}


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def test_a_world_that_lies_is_turned_upright_and_told(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, lying())
    warning_with(summary, "+Y", "turned")
    file = cameras(ctx)
    for found, image in zip(file.images, walk(8, phone_camera(64)).images, strict=True):
        np.testing.assert_allclose(found.world_from_camera, pose_matrix(image)[:3], atol=1e-9)
    assert file.notes["up"] == "+Y"
    np.testing.assert_allclose(np.array(file.notes["applied_transform"])[:, :3], Y_UP.T)


def test_a_turn_comes_on_top_of_what_was_applied_before(tmp_path: Path) -> None:
    before = [[0.0, 1.0, 0.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 3.0]]
    _, ctx = ingest(tmp_path, lying(applied_transform=before))
    found = np.array(cameras(ctx).notes["applied_transform"])
    np.testing.assert_allclose(found, Y_UP.T @ np.array(before))


def test_a_file_that_says_it_is_upright_is_believed(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, lying(orientation_override="none"))
    assert not any("turned" in warning for warning in summary["warnings"])
    assert "up" not in cameras(ctx).notes


# --- the same keys from others ----------------------------------------------------------------


def instant_ngp(count: int = 4, **top: Any) -> dict[str, bytes | str]:
    """Depth as Instant NGP's keys name it."""
    frames = json.loads(str(nerfstudio_files(count)["transforms.json"]))["frames"]
    for n, frame in enumerate(frames):
        frame["depth_path"] = f"images/{n}.depth.png"
    files = nerfstudio_files(count, frames=frames, **top)
    return files | {f"images/{n}.depth.png": depth_png(COUNTS) for n in range(count)}


def test_depth_of_instant_ngp_is_in_the_files_unit(tmp_path: Path) -> None:
    """4 m to the full range, as scripts for NeRFCapture write it; applied_scale is not its key."""
    summary, ctx = ingest(tmp_path, instant_ngp(integer_depth_scale=4 / 65535, applied_scale=3.0))
    assert (summary["num_depths"], summary["metric"]) == (4, False)
    np.testing.assert_allclose(depth_of(ctx, 1), COUNTS * (4 / 65535), rtol=1e-6)


@pytest.mark.parametrize("top", [{}, {"integer_depth_scale": -1}, {"integer_depth_scale": "4"}])
def test_depth_of_instant_ngp_means_nothing_without_its_unit(
    tmp_path: Path, top: dict[str, Any]
) -> None:
    summary, _ = ingest(tmp_path, instant_ngp(**top))
    assert (summary["num_posed"], summary["num_depths"]) == (4, 0)
    assert warning_with(summary, "4 depth maps are not used", "integer_depth_scale")


def test_nerfcapture_is_known_by_its_key(tmp_path: Path) -> None:
    """ARKit's world: +Y up, metres, whatever the pictures show."""
    summary, ctx = ingest(tmp_path, instant_ngp(depth_integer_scale=1))
    assert (summary["metric"], summary["num_depths"]) == (True, 0)
    file = cameras(ctx)
    assert [image.world_from_camera[1][3] for image in file.images] == [0, 1, 2, 3]
    assert (file.cameras[0].cx, file.cameras[0].cy) == (31.5, 23.5)
    for key, value in (("cx", "x"), ("cy", "x"), ("cx", 10**400)):
        broken: dict[str, Any] = {"depth_integer_scale": 1, key: value}
        code = code_of(tmp_path / key / str(value)[:3], instant_ngp(**broken))
        assert code == "poses_malformed"


def test_times_of_a_moving_scene_are_told_and_clocks_are_not(tmp_path: Path) -> None:
    frames = frames_of(4)
    for n, frame in enumerate(frames):
        frame["time"] = n / 3
    summary, ctx = ingest(tmp_path / "a", nerfstudio_files(4, frames=frames))
    assert warning_with(summary, "4 different times (0 to 1)", "Motion is not modelled")
    assert cameras(ctx).notes["motion"] == "not modelled"
    frames = [
        {"timestamp" if key == "time" else key: frame[key] for key in frame} for frame in frames
    ]
    assert ingest(tmp_path / "b", nerfstudio_files(4, frames=frames))[0]["warnings"] == []
