"""The times of frames, as ffmpeg's log tells them, whole or mangled."""

from __future__ import annotations

import math

import pytest

from pipelines.captures.video_frames import FrameTimes

ALL, KEPT = "[showinfo@all @ 0x1] ", "[showinfo@kept @ 0x2] "
CONFIG = "config in time_base: 1/15360, frame_rate: 30/1"


def frame(number: int, pts: int | str, seconds: str) -> str:
    return f"n:{number:4d} pts:{pts:>7} pts_time:{seconds:8} duration:    512 fmt:yuv420p"


def kept_of(*lines: str) -> list[tuple[int, float]]:
    times = FrameTimes()
    for line in lines:
        times.on_line(line)
    return [times.kept.get_nowait() for _ in range(times.kept.qsize())]


def test_times_are_exact_beyond_the_digits_of_the_log() -> None:
    """Frame 37,037 of a film of 30 a second is at 1234.566667 s; the log says 1234.57."""
    lines = [ALL + CONFIG, KEPT + CONFIG]
    lines += [ALL + frame(37037, 18962944, "1234.57"), KEPT + frame(0, 18962944, "1234.57")]
    assert kept_of(*lines) == [(37037, pytest.approx(37037 / 30, abs=1e-9))]


@pytest.mark.parametrize("swallowed", [(0,), (1,), (0, 1)])
def test_a_message_without_its_end_does_not_swallow_the_unit(swallowed: tuple[int, ...]) -> None:
    configs = [
        "Contact us." + CONFIG if i in swallowed else (ALL, KEPT)[i] + CONFIG for i in (0, 1)
    ]
    lines = [ALL + frame(3, 1536, "0.1"), KEPT + frame(0, 1536, "0.1")]
    assert kept_of(*configs, *lines) == [(3, pytest.approx(0.1))]


def test_seconds_are_used_where_no_unit_was_read() -> None:
    assert kept_of(ALL + frame(3, 1536, "0.1"), KEPT + frame(0, 1536, "0.1")) == [(3, 0.1)]


def test_frames_without_their_sender_are_told_apart() -> None:
    """Of frames 0 to 3 the second and the last are kept."""
    lines = [KEPT + CONFIG]
    lines += ["odd: " + frame(n, n * 512, "9") for n in (0, 1)] + [frame(0, 512, "9")]
    lines += [frame(2, 1024, "9"), ALL + frame(3, 1536, "9"), "odd: " + frame(1, 1536, "9")]
    assert kept_of(*lines) == [(1, pytest.approx(1 / 30)), (3, pytest.approx(3 / 30))]


def test_a_title_cannot_pose_as_a_frame() -> None:
    title = "    title           : " + frame(0, 0, "0")
    assert kept_of(title, title, "    comment : " + CONFIG) == []


def test_a_frame_without_a_time_keeps_its_place() -> None:
    lines = [ALL + frame(0, "NOPTS", "NOPTS"), KEPT + frame(0, "NOPTS", "NOPTS")]
    ((index, time_s),) = kept_of(*lines)
    assert index == 0
    assert math.isnan(time_s)
