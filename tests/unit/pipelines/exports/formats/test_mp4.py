"""The H.264 writer: what it makes plays in a browser, and a cancel leaves nothing behind."""

from __future__ import annotations

import os
import signal
import struct
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from pipelines.errors import Cancelled, ToolError
from pipelines.exports.formats.mp4 import VideoWriter
from pipelines.tools.ffmpeg import probe

WIDTH, HEIGHT, FRAMES = 64, 48, 30


def frame(index: int) -> np.ndarray:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[..., 0] = 200
    picture[..., 1] = np.uint8(20 + 5 * index)
    picture[..., 2] = 90
    return picture


def record(path: Path, cancel: bool = False, codec: str = "h264") -> None:
    with VideoWriter(path, WIDTH, HEIGHT, 24.0, 18, codec) as writer:
        for index in range(FRAMES):
            writer.write(frame(index))
        if cancel:
            raise Cancelled("The job was cancelled.")


def record_motion(path: Path, codec: str, frames: int, fps: float = 24.0) -> None:
    """Large enough that x264 would use more than one thread."""
    picture = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    with VideoWriter(path, 320, 240, fps, 18, codec) as writer:
        for index in range(frames):
            writer.write(np.roll(picture, 3 * index, axis=1) // 2 + np.uint8(index % 100))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    record(path)
    return path


def test_it_is_h264_yuv420p_with_every_frame(video: Path) -> None:
    info = probe(video)
    assert (info.codec, info.pix_fmt) == ("h264", "yuv420p")
    assert (info.width, info.height, info.fps) == (WIDTH, HEIGHT, 24.0)
    assert imageio_ffmpeg.count_frames_and_secs(str(video))[0] == FRAMES


def test_the_index_comes_before_the_pictures(video: Path) -> None:
    data = video.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_colors_survive(video: Path) -> None:
    reader = imageio_ffmpeg.read_frames(str(video))
    next(reader)
    first = np.frombuffer(next(reader), np.uint8).reshape(HEIGHT, WIDTH, 3).astype(int)
    reader.close()
    assert np.abs(first.reshape(-1, 3).mean(0) - [200, 20, 90]).max() < 4


@pytest.mark.parametrize("codec", ["h264", "hevc", "av1"])
def test_matrix_primaries_and_transfer_are_tagged_in_stream_and_container(
    tmp_path: Path, codec: str
) -> None:
    record(tmp_path / "video.mp4", codec=codec)
    # ffmpeg says "bt709/unknown/unknown" where the matrix alone is known.
    assert probe(tmp_path / "video.mp4").color.split(", ")[:2] == ["tv", "bt709"]
    data = (tmp_path / "video.mp4").read_bytes()
    kind, *tags, full_range = struct.unpack_from(">4s3HB", data, data.index(b"colr") + 4)
    assert (kind, tags, full_range >> 7) == (b"nclx", [1, 1, 1], 0)


@pytest.mark.parametrize("codec", ["h264", "hevc", "av1"])
def test_the_bytes_do_not_depend_on_the_number_of_cores(tmp_path: Path, codec: str) -> None:
    cores = os.sched_getaffinity(0)
    written = []
    try:
        for some in ({min(cores)}, cores):
            os.sched_setaffinity(0, some)  # ffmpeg inherits it
            record_motion(tmp_path / "video.mp4", codec, frames=12)
            written.append((tmp_path / "video.mp4").read_bytes())
    finally:
        os.sched_setaffinity(0, cores)
    assert written[0] == written[1]
    # x265 asks the machine and not the process, so what both say of themselves counts, too.
    told = {"h264": [b"threads=6 "], "hevc": [b"frame-threads=2 ", b"numa-pools=6 "], "av1": []}
    assert all(words in written[0] for words in told[codec])


@pytest.mark.parametrize("codec", ["h264", "hevc", "av1"])
@pytest.mark.parametrize(("fps", "most"), [(24.0, 24), (29.97, 30), (2.0, 12)])
def test_a_player_decodes_a_second_at_most_to_show_any_moment(
    tmp_path: Path, codec: str, fps: float, most: int
) -> None:
    record_motion(tmp_path / "video.mp4", codec, frames=70, fps=fps)
    data = (tmp_path / "video.mp4").read_bytes()
    at = data.index(b"stss")
    (count,) = struct.unpack_from(">I", data, at + 8)
    starts = [*struct.unpack_from(f">{count}I", data, at + 12), 71]
    assert starts[0] == 1
    assert most // 2 <= max(np.diff(starts)) <= most


def test_a_cancel_in_the_middle_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    with pytest.raises(Cancelled):
        record(path, cancel=True)
    assert list(tmp_path.iterdir()) == []


def test_a_failing_ffmpeg_is_an_error_with_its_last_lines(tmp_path: Path) -> None:
    path = tmp_path / "no" / "such" / "folder" / "video.mp4"
    with pytest.raises(ToolError, match="ffmpeg") as caught:
        record(path)
    assert any("No such file" in line for line in caught.value.details["log"])
    assert str(tmp_path) not in caught.value.message


def record_while_ffmpeg_is_killed(path: Path) -> None:
    with VideoWriter(path, 640, 480, 24.0, 18) as writer:
        for index in range(500):
            if index == 3:
                os.kill(writer._program._process.pid, signal.SIGKILL)
            writer.write(np.zeros((480, 640, 3), np.uint8))


def test_an_ffmpeg_that_dies_in_the_middle_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    """As when the system takes it for lack of memory, which the error must then say."""
    with pytest.raises(ToolError, match=r"video\.mp4") as caught:
        record_while_ffmpeg_is_killed(tmp_path / "video.mp4")
    assert "memory" in caught.value.hint
    assert list(tmp_path.iterdir()) == []


def test_odd_sides_and_wrong_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="even sides"):
        VideoWriter(tmp_path / "video.mp4", 63, 48, 24.0, 18)
    with (
        pytest.raises(ValueError, match="expected uint8"),
        VideoWriter(tmp_path / "video.mp4", WIDTH, HEIGHT, 24.0, 18) as writer,
    ):
        writer.write(np.zeros((10, 10, 3), np.uint8))
