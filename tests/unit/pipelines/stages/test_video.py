"""The video stage on a tiny trained model, and its choice of a lens."""

from __future__ import annotations

import dataclasses

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pipelines.cameras_file import Intrinsics, PosedImage
from pipelines.errors import Cancelled
from pipelines.manifest import RunHooks
from pipelines.stages.video import camera_path, preview_index, typical_lens
from pipelines.tools.ffmpeg import probe
from pipelines.trained_scene import TrainedScene
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job
from tests.unit.pipelines.synthetic_views import look_at, ring


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


def test_the_path_follows_the_walk(trained_job: Workspace) -> None:
    images = TrainedScene.load(trained_job.stage("train") / "model.zip").cameras.images
    path = camera_path(tuple(reversed(images)), 24)
    first = np.asarray(images[0].world_from_camera)[:, 3]
    last = np.asarray(images[-1].world_from_camera)[:, 3]
    extent = np.linalg.norm(last - first)
    assert np.linalg.norm(path[0][:, 3] - first) < 0.1 * extent
    assert np.linalg.norm(path[-1][:, 3] - last) < 0.1 * extent


def test_the_preview_looks_at_the_subject_from_where_someone_stood() -> None:
    poses = ring(30, np.zeros(3))[::3]
    images = [
        PosedImage(f"{index}.jpg", 0, tuple(tuple(map(float, row)) for row in pose))
        for index, pose in enumerate(poses)
    ]
    path = np.repeat(poses, 2, axis=0)
    aside = look_at(path[9, :, 3], np.array([1.5, 0.0, 0.0]))
    path[:] = aside
    path[9] = poses[4]
    assert preview_index(path, images) == 9


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


def test_the_typical_lens_is_centred_and_of_the_most_common_size() -> None:
    wide = Intrinsics(640, 480, 500.0, 500.0, 310.0, 250.0)
    longer = dataclasses.replace(wide, fl_x=520.0)
    other = Intrinsics(480, 640, 900.0, 900.0, 240.0, 320.0)
    lens = typical_lens([other, wide, longer])
    assert (lens.width, lens.height, lens.cx, lens.cy) == (640, 480, 320.0, 240.0)
    assert lens.fl_x == 510.0
