"""Real small captures of every kind go through ingest, and unusable ones say why."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.cameras_file import CamerasFile
from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import Cancelled, CaptureError
from pipelines.options import IngestOptions
from pipelines.stage import StageContext
from pipelines.stages.ingest import run
from tests.unit.pipelines.captures.archives import (
    context,
    nerfstudio_files,
    picture,
    polycam_files,
    pose,
    record3d_files,
    write_zip,
)

Files = dict[str, bytes | str]


def ingest(
    tmp_path: Path, files: Files, options: IngestOptions | None = None
) -> tuple[dict[str, Any], StageContext]:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, files)
    return run(options or IngestOptions(), ctx), ctx


def code_of(tmp_path: Path, files: Files, options: IngestOptions | None = None) -> str:
    with pytest.raises(CaptureError) as caught:
        ingest(tmp_path, files, options)
    assert caught.value.message
    assert str(tmp_path) not in caught.value.message + caught.value.hint
    return caught.value.code


def exif(orientation: int) -> PIL.Image.Exif:
    made = PIL.Image.Exif()
    made[0x0112] = orientation
    made[0x010F] = "Phone"
    made.get_ifd(0x8825)[1] = "N"
    return made


def red_corner(path: Path) -> tuple[bool, bool]:
    """Whether the red quarter is at the top, and whether it is at the left."""
    with PIL.Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    red = (pixels[..., 0] - pixels[..., 1]) > 150
    rows, columns = np.nonzero(red)
    return bool(rows.mean() < red.shape[0] / 2), bool(columns.mean() < red.shape[1] / 2)


# --- photos ---------------------------------------------------------------------------------


def test_photos_are_turned_upright_and_lose_their_metadata(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n, exif=exif(6)) for n in range(3)}
    summary, ctx = ingest(tmp_path, files)
    assert (summary["kind"], summary["num_images"]) == ("images", 3)
    for path in sorted((ctx.out / "images").iterdir()):
        with PIL.Image.open(path) as image:
            assert image.size == (48, 64)
            assert not image.getexif()
            assert b"Phone" not in path.read_bytes()
        assert red_corner(path) == (True, False)  # top left turned clockwise is top right


def test_photos_without_metadata_keep_their_bytes(tmp_path: Path) -> None:
    data = picture(seed=5)
    _, ctx = ingest(tmp_path, {"a.jpg": data, "b.jpg": picture(), "c.jpg": picture(seed=1)})
    assert (ctx.out / "images" / "00001.jpg").read_bytes() == data


def test_pictures_appended_behind_a_photo_are_dropped(tmp_path: Path) -> None:
    hidden = picture(seed=9, exif=exif(1))
    _, ctx = ingest(tmp_path, {f"{n}.jpg": picture(seed=n) + hidden for n in range(3)})
    assert b"Phone" not in (ctx.out / "images" / "00001.jpg").read_bytes()


def test_photos_are_ordered_as_people_count(tmp_path: Path) -> None:
    _, ctx = ingest(tmp_path, {f"IMG_{n}.jpg": picture(seed=n) for n in (10, 2, 1)})
    record = json.loads((ctx.out / "capture.json").read_text())
    assert [image["source"] for image in record["images"]] == [
        "IMG_1.jpg",
        "IMG_2.jpg",
        "IMG_10.jpg",
    ]


def test_transparent_and_deep_pictures_become_plain_rgb(tmp_path: Path) -> None:
    clear, deep = io.BytesIO(), io.BytesIO()
    PIL.Image.new("RGBA", (64, 48), (255, 0, 0, 0)).save(clear, "PNG")
    PIL.Image.fromarray(np.full((48, 64), 65535, np.uint16)).save(deep, "PNG")
    files: Files = {"a.png": clear.getvalue(), "b.png": deep.getvalue(), "c.jpg": picture()}
    _, ctx = ingest(tmp_path, files)
    for name in ("00001.png", "00002.png"):
        with PIL.Image.open(ctx.out / "images" / name) as image:
            assert image.mode == "RGB"
            assert image.getpixel((5, 5)) == (255, 255, 255)


def test_one_broken_photo_among_many_is_left_out_with_a_warning(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n) for n in range(12)}
    files["5.jpg"] = picture(seed=5)[:900]
    summary, _ = ingest(tmp_path, files)
    assert summary["num_images"] == 11
    assert any("5.jpg" in warning for warning in summary["warnings"])


def test_photos_that_do_not_decode_fail_the_stage(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n)[:700] for n in range(5)}
    assert code_of(tmp_path, files) == "image_undecodable"


def test_picture_with_too_many_pixels_is_refused_unread(tmp_path: Path) -> None:
    options = IngestOptions(max_pixels=10_000)
    files: Files = {f"{n}.jpg": picture(200, 100, seed=n) for n in range(4)}
    assert code_of(tmp_path, files, options) == "image_undecodable"


def test_too_few_photos_are_refused(tmp_path: Path) -> None:
    assert code_of(tmp_path, {"a.jpg": picture(), "b.jpg": picture()}) == "too_few_images"


def test_entry_that_holds_more_than_it_declares_is_stopped(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {f"{n}.jpg": picture(640, 480, seed=n) for n in range(2)})
    target = tmp_path / "target"
    with CaptureArchive(path, ArchiveLimits()) as archive:
        entry = archive._entries["0.jpg"]
        declared = entry.file_size
        entry.file_size = 10
        with pytest.raises(CaptureError) as caught:
            archive.extract("0.jpg", target)
    assert caught.value.code in ("archive_bomb", "archive_damaged")
    assert not target.exists() or target.stat().st_size < declared


def test_damaged_entry_is_noticed_by_its_checksum(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {"0.jpg": picture(640, 480), "1.jpg": picture()}, 0)
    data = bytearray(path.read_bytes())
    data[20_000] ^= 0xFF
    path.write_bytes(data)
    with CaptureArchive(path, ArchiveLimits()) as archive, pytest.raises(CaptureError) as caught:
        archive.extract("0.jpg", tmp_path / "target")
    assert caught.value.code == "archive_damaged"


def test_cancel_stops_between_photos(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, {f"{n}.jpg": picture(seed=n) for n in range(9)})
    ctx.is_cancelled = lambda: (ctx.out / "images" / "00003.jpg").exists()
    with pytest.raises(Cancelled):
        run(IngestOptions(), ctx)
    assert not (ctx.out / "images" / "00004.jpg").exists()


# --- nerfstudio -----------------------------------------------------------------------------


def cameras(ctx: StageContext) -> CamerasFile:
    return CamerasFile.load(ctx.out / "cameras.json")


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
    frames = frames_of(3)
    frames[1] |= {"fl_x": 70.0, "mask_path": "masks/1.png"}
    top = {"camera_model": "OPENCV_FISHEYE", "distortion_params": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]}
    files = nerfstudio_files(3, frames=frames, **top) | {"masks/1.png": mask.getvalue()}
    summary, ctx = ingest(tmp_path, files)
    file = cameras(ctx)
    assert [file.cameras[image.camera].fl_x for image in file.images] == [60.0, 70.0, 60.0]
    lens = file.cameras[0]
    assert (lens.model, lens.k4, lens.p1) == ("OPENCV_FISHEYE", 0.4, 0.0)
    assert [image.mask for image in file.images] == [None, "masks/00002.png", None]
    assert (ctx.out / "masks" / "00002.png").is_file()
    assert summary["num_unlisted"] == 0


def test_posed_pictures_are_not_turned_by_their_exif(tmp_path: Path) -> None:
    files = nerfstudio_files(3)
    files |= {f"images/{n}.jpg": picture(seed=n, exif=exif(6)) for n in range(3)}
    _, ctx = ingest(tmp_path, files)
    path = ctx.out / "images" / "00001.jpg"
    assert red_corner(path) == (True, True)
    with PIL.Image.open(path) as image:
        assert image.size == (64, 48)
        assert not image.getexif()


@pytest.mark.parametrize("path", ["../../etc/passwd.jpg", "/etc/passwd", "C:/x.jpg", "..\\x.jpg"])
def test_path_out_of_the_archive_is_refused(tmp_path: Path, path: str) -> None:
    frames = frames_of(4)
    frames[2]["file_path"] = path
    assert code_of(tmp_path, nerfstudio_files(frames=frames)) == "archive_unsafe"


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


# --- Polycam --------------------------------------------------------------------------------


@pytest.mark.parametrize("corrected", [True, False])
def test_polycam_poses_become_metric_and_z_up(tmp_path: Path, corrected: bool) -> None:
    summary, ctx = ingest(tmp_path, polycam_files(corrected=corrected))
    file = cameras(ctx)
    assert (summary["kind"], summary["corrected"], file.metric) == ("polycam", corrected, True)
    pose_of_third = np.array(file.images[2].world_from_camera)
    # ARKit (2, 0.5, -2): 0.5 m high. The camera's up (+Y) is the world's up (+Z).
    np.testing.assert_allclose(pose_of_third[:, 3], [-2.0, 2.0, 0.5])
    np.testing.assert_allclose(pose_of_third[:, 1], [0.0, 0.0, 1.0])
    assert np.linalg.det(pose_of_third[:, :3]) == pytest.approx(1.0)
    assert file.images[2].timestamp_s == pytest.approx(2.0)
    assert bool(summary["warnings"]) is not corrected


def test_polycam_prefers_corrected_poses(tmp_path: Path) -> None:
    raw = polycam_files(6, corrected=False)
    summary, ctx = ingest(tmp_path, raw | polycam_files(4, corrected=True))
    assert (summary["corrected"], len(cameras(ctx).images)) == (True, 4)


def test_polycam_drops_blurred_frames_if_enough_remain(tmp_path: Path) -> None:
    scores = [10.0 if n % 5 == 0 else 90.0 for n in range(30)]
    summary, _ = ingest(tmp_path, polycam_files(30, blur_scores=scores))
    assert summary["num_posed"] == 24


def test_polycam_keeps_blurred_frames_if_few_would_remain(tmp_path: Path) -> None:
    summary, _ = ingest(tmp_path, polycam_files(8, blur_scores=[10.0] * 8))
    assert summary["num_posed"] == 8
    assert any("blurred" in warning for warning in summary["warnings"])


def test_polycam_without_cameras_misses_its_poses(tmp_path: Path) -> None:
    files = {name: data for name, data in polycam_files().items() if "cameras" not in name}
    assert code_of(tmp_path, files) == "poses_missing"


@pytest.mark.parametrize("value", ['{"fx": 1}', "[]", "{"])
def test_polycam_with_a_malformed_camera_is_refused(tmp_path: Path, value: str) -> None:
    files = polycam_files()
    files["keyframes/corrected_cameras/1500000.json"] = value
    assert code_of(tmp_path, files) == "poses_malformed"


def test_long_export_is_thinned_evenly(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, polycam_files(11), IngestOptions(max_posed_images=3))
    assert summary["num_frames"] == 11
    assert [image.world_from_camera[1][3] for image in cameras(ctx).images] == [0, 5, 10]


# --- Record3D -------------------------------------------------------------------------------


def test_record3d_frames_pair_with_poses_by_number(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, record3d_files(12, absent=(3,)))
    file = cameras(ctx)
    assert [image.world_from_camera[1][3] for image in file.images] == [
        n for n in range(12) if n != 3
    ]
    assert file.images[3].timestamp_s == pytest.approx(4 / 60)
    (lens,) = file.cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (60.0, 61.0, 31.0, 23.0)
    assert (file.metric, summary["num_poses"]) == (True, 12)
    assert any(": 3." in warning for warning in summary["warnings"])


def test_record3d_quaternion_is_x_y_z_w_and_world_is_turned_up(tmp_path: Path) -> None:
    half = float(np.sqrt(0.5))
    poses = [[0, half, 0, half, n, 0.5, -2.0] for n in range(4)]  # 90 degrees about ARKit's +Y
    _, ctx = ingest(tmp_path, record3d_files(4, poses=poses))
    matrix = np.array(cameras(ctx).images[1].world_from_camera)
    # ARKit: camera +X is world -Z, camera +Y is up, camera +Z is world +X.
    np.testing.assert_allclose(matrix[:, 0], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:, 1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(matrix[:, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:, 3], [-2, 1, 0.5])


def test_record3d_uses_each_frames_own_lens(tmp_path: Path) -> None:
    own = [[60.0 + n, 60.0, 32.0, 24.0] for n in range(5)]
    _, ctx = ingest(tmp_path, record3d_files(5, perFrameIntrinsicCoeffs=own))
    file = cameras(ctx)
    assert [file.cameras[image.camera].fl_x for image in file.images] == [60, 61, 62, 63, 64]


def test_record3d_copies_with_other_names_are_no_frames(tmp_path: Path) -> None:
    files = record3d_files(4) | {"EXR_RGBD/rgb/2(1).jpg": picture()}
    summary, _ = ingest(tmp_path, files)
    assert summary["num_posed"] == 4


@pytest.mark.parametrize(
    ("metadata", "code"),
    [
        ({"poses": []}, "poses_missing"),
        ({"poses": [[0, 0, 0, 0, 1, 2, 3]] * 12}, "poses_malformed"),
        ({"poses": [[0, 0, 0, 1, 1, 2]] * 12}, "poses_malformed"),
        ({"poses": [[0, 0, 0, 1, 1, 2, None]] * 12}, "poses_malformed"),
        ({"K": [1, 2, 3]}, "poses_malformed"),
        ({"w": None}, "poses_malformed"),
    ],
)
def test_unusable_record3d_metadata_is_refused(
    tmp_path: Path, metadata: dict[str, Any], code: str
) -> None:
    assert code_of(tmp_path, record3d_files(**metadata)) == code


def test_zip_is_sniffed_again_and_never_trusted(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    with zipfile.ZipFile(ctx.workspace.capture_file, "w") as archive:
        archive.writestr("../a.jpg", picture())
    with pytest.raises(CaptureError) as caught:
        run(IngestOptions(), ctx)
    assert caught.value.code == "archive_unsafe"
