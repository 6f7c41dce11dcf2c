"""Speed and exposure of a film, from frames whose shift and gain are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image

from pipelines.captures.motion import MotionMeter, Step
from pipelines.captures.video_frames import Frame

WIDTH, HEIGHT, RATE = 480, 270, 30.0


def wall() -> Image.Image:
    """[900, 3000] of things of many sizes."""
    rng = np.random.default_rng(0)
    total = np.zeros((900, 3000))
    for cell in (8, 30, 90, 250):
        noise = Image.fromarray(rng.integers(0, 256, (900 // cell + 1, 3000 // cell + 1), np.uint8))
        total += np.asarray(noise.resize((3000, 900), Image.Resampling.BICUBIC), float)
    return Image.fromarray(np.clip(total / 4 * 1.6 - 70, 20, 250).astype(np.uint8))


WALL = wall()


def frame(index: int, left: float, *, smear: int = 0, gain: float = 1.0) -> Frame:
    """The wall from `left` px on; smear: px that the camera moves while the shutter is open."""
    views = [
        np.asarray(WALL.crop((round(left + s), 300, round(left + s) + WIDTH, 300 + HEIGHT)), float)
        for s in range(smear + 1)
    ]
    luma = np.clip(np.mean(views, axis=0) * gain, 0, 255).astype(np.uint8)
    half = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
    return Frame(index, index / RATE, luma, (half, half))


def steps(frames: list[Frame]) -> list[Step]:
    meter = MotionMeter()
    return [step for one in frames if (step := meter.take(one)) is not None]


@pytest.mark.parametrize("px", [0, 3, 12, 60, 120])
def test_speed_is_that_of_the_picture(px: int) -> None:
    found = steps([frame(i, 200 + px * i, smear=px // 2) for i in range(8)])
    assert len(found) == 7
    expected = px * RATE / WIDTH
    for step in found:
        assert step.speed == pytest.approx(expected, rel=0.08, abs=0.08)
        assert step.gain_ev == pytest.approx(0.0, abs=0.06)


def test_what_has_nothing_in_common_has_no_speed() -> None:
    found = steps([frame(i, 900 * i) for i in range(3)])
    assert found == [Step(None, None)] * 2


def test_nothing_to_see_has_no_speed() -> None:
    flat = [
        Frame(i, i / RATE, np.full((HEIGHT, WIDTH), 120, np.uint8), frame(0, 0).chroma)
        for i in range(3)
    ]
    assert steps(flat) == [Step(None, None)] * 2


def test_a_change_of_exposure_is_told_from_a_change_of_what_is_in_view() -> None:
    brighter = steps([frame(0, 400, gain=0.5), frame(1, 412, gain=0.8)])
    assert brighter[0].gain_ev == pytest.approx(math.log2(0.8 / 0.5), abs=0.05)
    dark_to_light = [frame(i, 200 + 60 * i) for i in range(20)]
    means = [float(one.luma.mean()) for one in dark_to_light]
    assert max(means) - min(means) > 10
    assert max(abs(step.gain_ev or 0.0) for step in steps(dark_to_light)) < 0.1


def test_frames_without_times_are_left_out() -> None:
    first, second = frame(0, 0), frame(1, 9)
    unknown = Frame(1, math.nan, second.luma, second.chroma)
    assert steps([first, unknown, second]) == []
