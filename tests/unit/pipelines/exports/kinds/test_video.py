"""The video of a tiny trained model."""

from __future__ import annotations

import zipfile
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pipelines.errors import Cancelled, ToolError
from pipelines.exports.formats import mp4
from pipelines.exports.paths import smooth
from pipelines.exports.paths.smooth import Floats
from pipelines.exports.paths.walls import Walls
from pipelines.manifest import RunHooks
from pipelines.options import OptionsError, resolve_options
from pipelines.scene.cameras_file import CamerasFile
from pipelines.tools.ffmpeg import probe
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job

QUICK: dict[str, Any] = {
    "method": "tsdf",
    "refine": "none",
    "extent": "scene",
    "formats": ("glb",),
}
"""Of a mesh that is there, and need not be good."""


def test_the_video_plays_in_a_browser(job: Workspace) -> None:
    summary = tiny_job.run(job, "video")["summary"]
    path = job.stage("video") / "video.mp4"
    info = probe(path)
    assert (info.codec, info.pix_fmt) == ("h264", "yuv420p")
    assert (info.width, info.height) == (36, 64) == (summary["width"], summary["height"])
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == summary["num_frames"] == 12
    with Image.open(job.stage("video") / "preview.jpg") as picture:
        assert picture.size == (36, 64)
        assert np.asarray(picture).std() > 5.0


def test_films_heed_the_jobs_mesh_where_it_has_one(
    job: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    heeded: list[Walls | None] = []

    def record(*args: Any, **kwargs: Any) -> Floats:
        heeded.append(args[-1])
        return made(*args, **kwargs)

    made = smooth.smooth_path
    monkeypatch.setattr(smooth, "smooth_path", record)
    wanted: dict[str, dict[str, Any]] = {
        "video": {"num_frames": 8},
        "views": {"cameras": "path", "num_frames": 2, "formats": ("png",)},
    }
    tiny_job.run(job, "video", **wanted["video"])
    assert heeded == [None]
    tiny_job.run(job, "mesh", texture="none", **QUICK)
    for kind, options in {**wanted, "meshvideo": {"num_frames": 8}}.items():
        tiny_job.run(job, kind, **options)
    assert len(heeded) == 4
    eye = np.asarray(
        CamerasFile.load(job.stage("train") / "cameras.json").images[0].world_from_camera
    )
    for walls in heeded[1:]:
        assert walls is not None
        # What was filmed is in the way of whoever looks through it.
        assert walls.hide(eye[None, :, 3], eye[None, :, 3] - 20.0 * eye[None, :, 2]).all()


def test_a_cancel_in_the_middle_leaves_nothing(job: Workspace) -> None:
    messages: list[str] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: messages.append(message),
        is_cancelled=lambda: "frame 3/12" in messages,
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(job, "video", hooks)
    assert not job.stage("video").exists()
    assert not list(job.root.rglob("*.mp4"))


@pytest.mark.parametrize("codec", ["hevc", "av1"])
def test_other_codecs_are_what_they_say(job: Workspace, codec: str) -> None:
    wanted = {"codec": codec, "width_px": 96, "height_px": 80, "num_frames": 10, "fps": 20.0}
    summary = tiny_job.run(job, "video", **wanted)["summary"]
    path = job.stage("video") / "video.mp4"
    info = probe(path)
    assert (info.codec, info.width, info.height, info.fps) == (codec, 96, 80, 20.0)
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == summary["num_frames"] == 10
    data = path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")
    assert (b"hvc1" in data) == (codec == "hevc")


OUTPUTS = ("rgb", "depth", "normals", "accumulation")


def test_outputs_are_videos_of_their_own_or_one_side_by_side(job: Workspace) -> None:
    tiny_job.run(job, "video", outputs=OUTPUTS, num_frames=8, crf=1)
    names = {path.name for path in job.stage("video").glob("video*")}
    assert names == {"video.mp4", *(f"video-{name}.mp4" for name in OUTPUTS[1:])}
    for name in names:
        info = probe(job.stage("video") / name)
        assert (info.width, info.height) == (36, 64)
    apart = [
        _middle(job, f"video-{name}.mp4" if name != "rgb" else "video.mp4") for name in OUTPUTS
    ]
    summary = tiny_job.run(
        job, "video", outputs=OUTPUTS, layout="side_by_side", num_frames=8, crf=1
    )["summary"]
    assert {path.name for path in job.stage("video").glob("video*")} == {"video.mp4"}
    assert (summary["width"], summary["height"]) == (4 * 36, 64)
    together = _middle(job, "video.mp4")
    for index, picture in enumerate(apart):
        part = together[:, 36 * index : 36 * index + 36]
        assert np.abs(part[:, 2:-2] - picture[:, 2:-2]).mean() < 6.0, OUTPUTS[index]
        assert picture.std() > 5.0, OUTPUTS[index]
    assert np.ptp(apart[3], axis=-1).mean() < 6.0, "accumulation is grey"


def _middle(job: Workspace, name: str) -> np.ndarray:
    """One of the video's frames."""
    reader = imageio_ffmpeg.read_frames(str(job.stage("video") / name))
    width, height = next(reader)["size"]
    frames = [np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in reader]
    return frames[len(frames) // 2].astype(float)


def test_a_sequence_is_a_zip_of_pictures(job: Workspace) -> None:
    tiny_job.run(job, "video", outputs=("normals", "rgb"), codec="png", num_frames=8)
    files = {path.name for path in job.stage("video").glob("video*")}
    assert files == {"video-frames.zip"}
    with zipfile.ZipFile(job.stage("video") / "video-frames.zip") as archive:
        names = archive.namelist()
        assert sorted(names) == [
            f"{output}/{number:05d}.png" for output in ("normals", "rgb") for number in range(1, 9)
        ]
        with archive.open("rgb/00005.png") as held, Image.open(held) as picture:
            assert picture.size == (36, 64)
            assert np.asarray(picture).std() > 5.0


def test_keyframes_zoom_and_a_file_of_nerfstudios_sets_the_size(job: Workspace) -> None:
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    pose = np.vstack([cameras.images[4].world_from_camera, [0.0, 0.0, 0.0, 1.0]])
    frames = [{"camera_to_world": pose.ravel().tolist(), "fov": fov} for fov in (60.0, 60.0, 30.0)]
    file = {"render_width": 81, "render_height": 64, "fps": 10, "seconds": 9, "camera_path": frames}
    summary = tiny_job.run(
        job, "video", path="camera_path", camera_path=file, codec="png", layout="side_by_side"
    )["summary"]
    assert (summary["width"], summary["height"]) == (80, 64)
    assert (summary["num_frames"], summary["fps"], summary["duration_s"]) == (3, 10.0, 0.3)
    with zipfile.ZipFile(job.stage("video") / "video-frames.zip") as archive:
        wide, again, near = (
            np.asarray(Image.open(archive.open(f"side_by_side/{number:05d}.png")))
            for number in (1, 2, 3)
        )
    np.testing.assert_array_equal(wide, again)
    # Half of the angle shows the middle, by the ratio of the tangents.
    share = np.tan(np.radians(15.0)) / np.tan(np.radians(30.0))
    box = [(1 - share) * 40, (1 - share) * 32, (1 + share) * 40, (1 + share) * 32]
    cut = np.asarray(Image.fromarray(wide).resize((80, 64), box=tuple(box)))
    off = np.abs(cut.astype(float) - near).mean()
    assert off < 0.5 * np.abs(wide.astype(float) - near).mean()


def _pose_of_the_middle(job: Workspace) -> list[float]:
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    return np.vstack([cameras.images[4].world_from_camera, [0.0, 0.0, 0.0, 1.0]]).ravel().tolist()


def _pictures(job: Workspace, **changes: Any) -> dict[str, np.ndarray]:
    """The frame of a flight that stands still, by output."""
    pose = _pose_of_the_middle(job)
    options = {
        "path": "camera_path",
        "codec": "png",
        "camera_path": {
            "fps": 10,
            "camera_path": [{"camera_to_world": pose, "fov": 60.0}] * 2,
            **changes,
        },
    }
    tiny_job.run(job, "video", outputs=OUTPUTS, **options)
    with zipfile.ZipFile(job.stage("video") / "video-frames.zip") as archive:
        return {
            name: np.asarray(Image.open(archive.open(f"{name}/00001.png"))).astype(float)
            for name in OUTPUTS
        }


def _still(
    job: Workspace, long_side_px: int, which: int = 0, **options: Any
) -> tuple[np.ndarray, dict[str, Any]]:
    """A frame from where a photo was taken that training held out, and the summary."""
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    image = [image for image in cameras.images if image.split == "test"][which]
    lens = cameras.cameras[image.camera]
    fov = float(np.degrees(2.0 * np.arctan(lens.height / (2.0 * lens.fl_y))))
    pose = np.vstack([image.world_from_camera, [0.0, 0.0, 0.0, 1.0]]).ravel().tolist()
    shrink = long_side_px / max(lens.width, lens.height)
    file = {
        "fps": 10,
        "render_width": round(lens.width * shrink),
        "render_height": round(lens.height * shrink),
        "camera_path": [{"camera_to_world": pose, "fov": fov}] * 2,
    }
    summary = tiny_job.run(
        job, "video", path="camera_path", camera_path=file, codec="png", **options
    )["summary"]
    with zipfile.ZipFile(job.stage("video") / "video-frames.zip") as archive:
        return np.asarray(Image.open(archive.open("rgb/00001.png"))).astype(float), summary


def _held_out_photo(job: Workspace, which: int) -> np.ndarray:
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    image = [image for image in cameras.images if image.split == "test"][which]
    return np.asarray(Image.open(job.images_root / image.file).convert("RGB")).astype(float)


def test_the_mesh_makes_the_film_more_like_photos_that_training_never_saw(job: Workspace) -> None:
    tiny_job.run(job, "mesh", formats=("glb",), extent="scene")
    errors = []
    for which in range(3):
        photo = _held_out_photo(job, which)
        alone, told = _still(job, 64, which, mesh_detail=False)
        assert told["mesh_detail"] is False
        both, told = _still(job, 64, which)
        assert told["mesh_detail"] is True
        small, _ = _still(job, 64, which, field_px=32)
        assert both.shape == photo.shape == alone.shape
        errors.append([np.square(shown - photo).mean() for shown in (both, small, alone)])
    error, error_small, error_alone = np.transpose(errors)
    assert (error < error_alone).all()
    assert error.mean() < 0.995 * error_small.mean()
    assert (error < 1.005 * error_small).all(), "a photo alone may be as near by both"
    assert error.mean() < 0.97 * error_alone.mean()


def test_a_job_without_a_picture_on_its_mesh_films_what_was_trained(job: Workspace) -> None:
    trained, _ = _still(job, 64, mesh_detail=False)
    for texture in (None, "none"):
        if texture is not None:
            tiny_job.run(job, "mesh", texture=texture, **QUICK)
        enlarged, told = _still(job, 128, field_px=32)
        assert told["mesh_detail"] is False
        shrunk = enlarged.reshape(64, 2, -1, 2, 3).mean(axis=(1, 3))
        assert np.abs(shrunk - trained).mean() < 3.0
        again, _ = _still(job, 64)
        np.testing.assert_allclose(again, trained, atol=1.0)


def test_what_the_mesh_is_not_asked_for_stays_as_it_was(job: Workspace) -> None:
    before, _ = _still(job, 64, outputs=("rgb", "depth"), mesh_detail=False)
    depth = _frame(job, "depth")
    tiny_job.run(job, "mesh", **QUICK)
    after, _ = _still(job, 64, outputs=("depth", "rgb"))
    np.testing.assert_array_equal(_frame(job, "depth"), depth)
    assert np.abs(after - before).mean() > 0.5
    circle = _pictures(job, render_width=64, render_height=64, camera_type="fisheye")["rgb"]
    assert circle.std() > 5.0


def _frame(job: Workspace, name: str) -> np.ndarray:
    with zipfile.ZipFile(job.stage("video") / "video-frames.zip") as archive:
        return np.asarray(Image.open(archive.open(f"{name}/00001.png")))


def test_wide_lenses_show_what_a_plain_one_shows_and_more(job: Workspace) -> None:
    """Each pixel of the plain picture is where the lens formula of the wide one has its ray."""
    plain = _pictures(job, render_width=48, render_height=48)
    focal = 24.0 / np.tan(np.radians(30.0))
    x, y = np.meshgrid(np.arange(48) + 0.5 - 24.0, np.arange(48) + 0.5 - 24.0)
    ray = np.stack([x, y, np.full_like(x, focal)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)

    fish = _pictures(job, render_width=96, render_height=96, camera_type="fisheye")
    fish_focal = 48.0 / np.tan(np.radians(30.0))
    angle = np.arccos(ray[..., 2])
    out = fish_focal * angle / np.maximum(np.hypot(x, y), 1e-9)
    _is_seen_at(plain, fish, 48.0 + out * x, 48.0 + out * y)

    sphere = _pictures(job, render_width=192, render_height=96, camera_type="equirectangular")
    column = 96.0 + 96.0 * np.arctan2(ray[..., 0], ray[..., 2]) / np.pi
    row = 48.0 + 96.0 * np.arcsin(ray[..., 1]) / np.pi
    _is_seen_at(plain, sphere, column, row)
    # All round: the first column looks the same way as the last.
    step = np.abs(sphere["rgb"][:, 0] - sphere["rgb"][:, -1]).mean()
    assert step < np.abs(sphere["rgb"][:, 0] - sphere["rgb"][:, 96]).mean()


def _is_seen_at(
    plain: dict[str, np.ndarray], wide: dict[str, np.ndarray], column: np.ndarray, row: np.ndarray
) -> None:
    for name in OUTPUTS:
        found = wide[name][np.floor(row).astype(int), np.floor(column).astype(int)]
        right = np.median(np.abs(found - plain[name]))
        wrong = np.median(np.abs(found[:, ::-1] - plain[name]))
        assert right < max(0.6 * wrong, 6.0), (name, right, wrong)


def test_a_fisheye_is_a_circle_and_a_sphere_says_what_it_is(job: Workspace) -> None:
    tiny_job.run(job, "video", camera="fisheye", num_frames=8, codec="png", outputs=("normals",))
    with zipfile.ZipFile(job.stage("video") / "video-frames.zip") as archive:
        picture = np.asarray(Image.open(archive.open("normals/00004.png")))
    assert picture.shape == (64, 64, 3)
    assert not picture[0, 0].any()
    assert picture[32, 1].any()
    tiny_job.run(job, "video", camera="equirectangular", num_frames=8)
    info = probe(job.stage("video") / "video.mp4")
    assert (info.width, info.height, info.projection) == (64, 32, "equirectangular")
    with Image.open(job.stage("video") / "preview.jpg") as preview:
        assert preview.height > preview.width, "the preview is a plain picture"


def test_a_failing_encoder_leaves_no_half_written_file(
    job: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(mp4._CODECS, "av1", {"vcodec": "no-such-encoder"})
    with pytest.raises(ToolError) as caught:
        tiny_job.run(job, "video", outputs=("rgb", "depth"), codec="av1")
    assert "no-such-encoder" in caught.value.hint
    assert not job.stage("video").exists()


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"width_px": 100_000, "height_px": 100_000}, "less than or equal to 8192"),
        ({"width_px": 0, "height_px": 0}, "greater than or equal to 16"),
        ({"width_px": 640}, "belong together"),
        ({"width_px": 641, "height_px": 480}, "multiple of 2"),
        ({"long_side_px": 0}, "greater than or equal to 64"),
        ({"num_frames": 1}, "greater than or equal to 8"),
        ({"fps": 0}, "greater than or equal to 1"),
        ({"seconds": 0}, "greater than 0"),
        ({"seconds": 3000, "fps": 60}, "180000 frames; 2 to 20000"),
        ({"max_seconds": 3000, "fps": 60}, "180000 frames; 2 to 20000"),
        ({"min_seconds": 31}, "min_seconds must not be more than max_seconds"),
        ({"outputs": []}, "at least 1"),
        ({"outputs": ["rgb", "semantics"]}, "'rgb', 'depth', 'normals' or 'accumulation'"),
        ({"outputs": OUTPUTS, "layout": "side_by_side", "long_side_px": 8192}, "wider than 16384"),
        ({"path": "keyframes"}, "at least 2 keyframes, not 0"),
        (
            {"path": "keyframes", "keyframes": [{"position": [0, 0, 0], "look_at": [1, 0, 0]}]},
            "not 1",
        ),
        (
            {"keyframes": [{"position": [0, 0, 0], "look_at": [1, 0, 0], "fov_deg": 0}]},
            "equal to 1",
        ),
        ({"keyframes": [{"position": [0, 0, 0]}]}, "one of look_at and rotation"),
        ({"keyframes": [{"position": [0, 0, 0], "rotation": [0, 0, 0, 0]}]}, "must not be 0"),
        ({"keyframes": [{"position": [0, 0, 0], "look_at": [0, 0, 0]}]}, "position itself"),
        ({"path": "camera_path"}, "needs the option camera_path"),
        ({"camera": "cubemap"}, "'perspective', 'fisheye' or 'equirectangular'"),
        ({"fisheye_fov_deg": 0}, "greater than or equal to 20"),
        ({"fisheye_fov_deg": 360}, "less than or equal to 220"),
        (
            {"camera": "equirectangular", "width_px": 640, "height_px": 480},
            "twice as wide as it is high, not 640x480",
        ),
        (
            {
                "camera": "equirectangular",
                "outputs": ["rgb", "depth"],
                "layout": "side_by_side",
            },
            "cannot have several outputs side by side",
        ),
        (
            {
                "camera": "fisheye",
                "path": "keyframes",
                "keyframes": [
                    {"position": [0, 0, 0], "look_at": [1, 0, 0], "fov_deg": 50},
                    {"position": [0, 1, 0], "look_at": [1, 0, 0], "fov_deg": 50},
                ],
            },
            "for perspective cameras; the camera is fisheye",
        ),
        ({"path": "teleport"}, "'smooth', 'orbit'"),
        ({"orbit": {"height": 1.0}}, "less than or equal to 0.98"),
        ({"spiral": {"radius": 0.0}}, "greater than 0"),
        ({"tension": 2}, "less than or equal to 1"),
    ],
)
def test_wrong_requests_are_refused_with_the_range(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(OptionsError) as caught:
        resolve_options("preview", {"video": wrong})
    assert told in str(caught.value)


def test_keyframes_without_all_times_or_angles_are_refused() -> None:
    place = {"position": [0, 0, 0], "look_at": [1, 0, 0]}
    there = {"position": [0, 1, 0], "look_at": [1, 0, 0]}
    for frames, told in (
        ([place, {**there, "seconds": 2}, there], "or for none"),
        ([place, {**there, "fov_deg": 50}], "for every keyframe, or for none"),
        ([place, {**there, "seconds": 2, "speed": 1}], "both seconds and speed"),
        ([place, {**there, "seconds": 3000}], "72000 frames"),
        ([place, {**there, "seconds": 1e-300}], "or equal to 0.001"),
        ([place, {**there, "speed": 1e-320}], "or equal to 0.000001"),
        ([place, {**there, "look_at": [1e-320, 1, 0]}], "not be the position itself"),
        ([place, {"position": [0, 1, 0], "rotation": [float("inf"), 0, 0, 1]}], "or equal to 1000"),
        ([place, {"position": [0, 1, 0], "rotation": [1, 0, -1e200, 0]}], "or equal to -1000"),
    ):
        with pytest.raises(OptionsError) as caught:
            resolve_options("preview", {"video": {"path": "keyframes", "keyframes": frames}})
        assert told in str(caught.value)
