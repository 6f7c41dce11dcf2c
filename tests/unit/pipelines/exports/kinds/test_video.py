"""The video of a tiny trained model."""

from __future__ import annotations

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pipelines.errors import Cancelled
from pipelines.manifest import RunHooks
from pipelines.tools.ffmpeg import probe
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


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
