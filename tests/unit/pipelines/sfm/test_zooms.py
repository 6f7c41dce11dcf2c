"""Films whose lens changes on the way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.sfm.rungs import RUNGS
from pipelines.sfm.zooms import lens_changes
from tests.unit.pipelines.sfm.synthetic_room import (
    FOCAL,
    arc_poses,
    render,
    save_video_frames,
)
from tests.unit.pipelines.sfm.test_tears import OPENCV, Matches, climbed, turns_off_deg

NUM = 40


def film(scales: list[float], num_matches: int = 60) -> Matches:
    """Pairs of frames that follow each other, of which each shows things so many times as large as
    the one before, moved aside and a little off."""
    rng = np.random.default_rng(2)
    found: Matches = {}
    for number, scale in enumerate(scales):
        first = rng.uniform((0.0, 0.0), (400.0, 300.0), (num_matches, 2))
        middle = np.array([200.0, 150.0])
        second = middle + scale * (first - middle) + rng.normal(scale=1.0, size=first.shape)
        found[number, number + 1] = first, second + rng.uniform(-30.0, 30.0, 2)
    return found


def steady(num: int = NUM - 1) -> list[float]:
    """Scales of a hand that goes to and fro a little."""
    return np.exp(np.random.default_rng(3).normal(scale=0.02, size=num)).tolist()


def test_a_jump_of_the_scale_is_another_lens() -> None:
    scales = steady()
    scales[24] = 1.8
    ((images, scale),) = lens_changes(film(scales), [range(NUM)])
    assert images == list(range(25, NUM))
    assert scale == pytest.approx(1.8, rel=0.03)


def test_a_lens_that_is_gone_back_to_is_the_same() -> None:
    scales = steady()
    scales[9], scales[19] = 0.5, 2.0
    ((images, scale),) = lens_changes(film(scales), [range(NUM)])
    assert images == list(range(10, 20))
    assert scale == pytest.approx(0.5, rel=0.05)
    scales[29] = 3.0
    wide, tele = lens_changes(film(scales), [range(NUM)])
    assert (wide[0], tele[0]) == (list(range(10, 20)), list(range(30, NUM)))
    assert tele[1] == pytest.approx(3.0, rel=0.1)


def test_clips_have_lenses_of_their_own() -> None:
    scales = steady()
    scales[19], scales[29] = 1.5, 1.8
    clips = [range(20), range(20, NUM)]
    ((images, _),) = lens_changes(film(scales), clips)
    assert images == list(range(30, NUM)), "between clips a lens may change"


def test_who_walks_up_to_a_thing_has_one_lens() -> None:
    assert lens_changes(film([1.25] * (NUM - 1)), [range(NUM)]) == []
    assert lens_changes(film(np.linspace(1.0, 1.3, NUM - 1).tolist()), [range(NUM)]) == []
    assert lens_changes(film(steady()), [range(NUM)]) == []


def test_few_matches_say_nothing() -> None:
    scales = steady()
    scales[24] = 1.8
    assert lens_changes(film(scales, num_matches=12), [range(NUM)]) == []
    matches = film(scales)
    del matches[24, 25]
    assert lens_changes(matches, [range(NUM), range(0)]) == []


def zoomed(picture: Image.Image, factor: float) -> Image.Image:
    """Its middle, as large as the whole."""
    width, height = picture.size
    x, y = width * (1.0 - 1.0 / factor) / 2.0, height * (1.0 - 1.0 / factor) / 2.0
    box = (x, y, width - x, height - y)
    return picture.resize(picture.size, Image.Resampling.BICUBIC, box=box)


def test_a_film_that_is_zoomed_halfway_has_two_lenses_and_true_poses(tmp_path: Path) -> None:
    poses, factor = arc_poses(24), 1.6
    pictures = [render(pose) for pose in poses]
    pictures[12:] = [zoomed(picture, factor) for picture in pictures[12:]]
    save_video_frames(tmp_path, pictures)
    outcome, _ = climbed(tmp_path, tuple(rung for rung in RUNGS if rung.name == "quick"))
    model = outcome.chosen.best
    assert model is not None
    assert outcome.chosen.num_registered == 24
    focal = [model.cameras[camera].fl_x for camera in model.camera_of]
    assert np.median(focal[12:]) / np.median(focal[:12]) == pytest.approx(factor, rel=0.03)
    assert np.median(focal[:12]) == pytest.approx(FOCAL, rel=0.05)
    true = np.concatenate([poses[:, :, :3] @ OPENCV, poses[:, :, 3:]], axis=2)
    assert np.median(turns_off_deg(model, true)) < 0.3
