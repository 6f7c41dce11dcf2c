"""Which clips join, and what is told of one that does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.sfm.clips import clip_warnings, clips_of
from pipelines.sfm.source import Source
from tests.unit.pipelines.sfm.test_report import model, outcome


def film(*lengths: int) -> Source:
    """Clips of so many frames, half a second apart; the first gave none."""
    clips = tuple(n for n, length in enumerate(lengths, start=1) for _ in range(length))
    files = tuple(f"images/{i:03d}.jpg" for i in range(len(clips)))
    names = ("empty.mp4", *(f"{n}.mp4" for n in range(len(lengths))))
    times = tuple(0.5 * i for i in range(len(clips)))
    return Source(Path("."), files, times, is_video=True, clips=clips, clip_names=names)


@pytest.mark.parametrize(("num_placed", "is_apart"), [(0, True), (1, True), (2, False)])
def test_a_clip_with_hardly_a_frame_in_the_model_is_apart(num_placed: int, is_apart: bool) -> None:
    found = outcome([model((20,)), model((*range(10), *range(10, 10 + num_placed)))])
    (first, second) = clips_of(found, film(10, 10))
    assert (first["name"], first["is_apart"], first["num_registered"]) == ("0.mp4", False, 10)
    assert (second["name"], second["is_apart"]) == ("1.mp4", is_apart)
    assert (second["num_registered"], second["num_images"]) == (num_placed, 10)
    assert len(clip_warnings([first, second])) == int(is_apart)


def test_what_ties_clips_is_the_best_pair_across_them() -> None:
    found = outcome([model(tuple(range(10)))])
    pairs = np.array([[0, 1, 900], [11, 12, 700], [3, 14, 18], [4, 14, 12], [2, 25, 250]])
    found = replace(found, statistics=replace(found.statistics, verified=pairs))
    clips = clips_of(found, film(10, 10, 10))
    assert [clip["most_shared"] for clip in clips] == [250, 18, 250]
    foreign, odd = clip_warnings(clips)
    assert foreign["code"] == odd["code"] == "clip_apart"
    assert foreign["message"].startswith("Clip 2 (1.mp4) does not join the others and is left out")
    assert "no frame shares more than 18 details" in foreign["message"]
    assert "though a frame shares 250 details" in odd["message"]
    assert foreign["details"] == clips[1]
    assert foreign["hint"]


def test_nothing_is_apart_where_there_is_one_clip_or_no_model() -> None:
    assert clips_of(outcome([model(tuple(range(9)))]), film(20)) == []
    clips = clips_of(outcome([]), film(10, 10))
    assert [clip["is_apart"] for clip in clips] == [False, False]
    assert clip_warnings(clips) == []
