"""How brightly pictures were taken, told by the surfaces they share."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.data.light import exposed
from pipelines.nerf.stereo.light import (
    DRIFT,
    CaptureLight,
    find_light,
    offsets_between,
    within_reason,
)
from pipelines.nerf.stereo.views import StereoView
from tests.unit.pipelines.nerf.stereo.painted_wall import look, row_of_cameras

COUNT = 7
NEIGHBOURS = [[other for other in range(COUNT) if 0 < abs(other - k) <= 2] for k in range(COUNT)]
GAINS = np.exp(np.random.default_rng(5).normal(0.0, 0.2, (COUNT, 3)))
GAINS /= np.exp(np.log(GAINS).mean(axis=0))


def scene() -> tuple[list[StereoView], list[np.ndarray], list[np.ndarray]]:
    """Views, depths, and their pictures in colour, [H, W, 3] in [0, 1]."""
    views, depths = row_of_cameras(COUNT)
    tints = np.array([1.0, 0.8, 0.6])
    return (
        views,
        [depth.astype(np.float32) for depth in depths],
        [view.picture[..., None] * tints for view in views],
    )


def stored(picture: np.ndarray) -> np.ndarray:
    return np.rint(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)


def light_of(pictures: list[np.ndarray]) -> CaptureLight:
    views, depths, _ = scene()
    return find_light(views, depths, [stored(picture) for picture in pictures], NEIGHBOURS)


@pytest.mark.parametrize("bend", [0.0, 0.5, 1.0])
def test_gains_are_found_whatever_the_camera_s_curve(bend: float) -> None:
    _, _, pictures = scene()
    lit = [exposed(picture, gain, bend) for picture, gain in zip(pictures, GAINS, strict=True)]
    found = light_of(lit)
    assert found.is_drifting
    assert found.bend == bend
    assert found.gains == pytest.approx(GAINS, rel=0.02)
    assert found.of(2) == (*(pytest.approx(g, abs=1e-5) for g in found.gains[2]), bend)


def test_the_same_light_is_no_drift() -> None:
    found = light_of(scene()[2])
    assert found.num_pairs > 0
    assert found.drift < DRIFT / 5
    assert not found.is_drifting


def test_what_moved_between_two_pictures_does_not_count() -> None:
    """A third of each picture is of something else, which no gain explains."""
    _, _, pictures = scene()
    lit = [exposed(picture, gain, 0.5) for picture, gain in zip(pictures, GAINS, strict=True)]
    for k, picture in enumerate(lit):
        picture[:, :32] = look(9.0 * k)[0].picture[:, :32, None]
    found = light_of(lit)
    assert np.abs(np.log(found.gains / GAINS)).max() < 0.08


def test_light_that_no_gain_explains_is_left_as_it_is() -> None:
    """A lamp that follows the camera: each picture is bright where it looks, dark beside that."""
    views, _, pictures = scene()
    lamps = []
    for view, picture in zip(views, pictures, strict=True):
        x, y = view.rays()
        lamps.append(picture * np.exp(-6.0 * (x[None, :] ** 2 + y[:, None] ** 2))[..., None])
    found = light_of(lamps)
    assert not found.is_drifting
    contradictory = dataclasses.replace(found, drift=0.2, contradiction=0.15)
    assert not contradictory.is_drifting


def test_a_picture_that_shares_nothing_keeps_its_light() -> None:
    views, depths, pictures = scene()
    depths[6] = np.zeros_like(depths[6])
    lit = [stored(exposed(p, g, 0.0)) for p, g in zip(pictures, GAINS, strict=True)]
    found = find_light(views, depths, lit, NEIGHBOURS)
    assert (found.gains[6] == 1.0).all()
    told = np.log(found.gains[:6]) - np.log(found.gains[0])
    assert told == pytest.approx(np.log(GAINS[:6]) - np.log(GAINS[0]), abs=0.03)
    alone = find_light(views[:1], depths[:1], lit[:1], [[]])
    assert (alone.gains == 1.0).all()
    assert not alone.is_drifting


def test_one_wrong_pair_does_not_move_the_others() -> None:
    pairs = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])
    values = np.arange(5.0)[:, None] * np.array([0.1, 0.2, -0.1])
    differences = values[pairs[:, 1]] - values[pairs[:, 0]]
    differences[3] += 2.0
    found = offsets_between(pairs, differences, 5)
    assert found - found[0] == pytest.approx(values, abs=0.02)


def test_no_picture_is_taken_in_a_light_that_no_camera_has() -> None:
    """A look through a fence: the sky behind it is bluer than from elsewhere, all pairs say so."""
    views, depths, pictures = scene()
    gains = np.ones((COUNT, 3))
    gains[-1] = [0.5, 1.0, 2.0]
    lit = [exposed(picture, gain, 0.0) for picture, gain in zip(pictures, gains, strict=True)]
    found = find_light(views, depths, [stored(picture) for picture in lit], NEIGHBOURS)
    assert found.num_held == 1
    told = np.log(found.gains)
    assert np.abs(told - told.mean(axis=1, keepdims=True)).max() < 0.5
    usual = told[:-1]
    assert np.ptp(usual, axis=0).max() < 0.03
    assert np.ptp(usual.mean(axis=0)) < 0.2, "the others keep their colour"
    assert told.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-9)


def test_what_a_camera_does_is_believed_and_what_it_does_not_is_held() -> None:
    believed = np.array([[1.7, 1.7, 1.7], [-1.1, -1.3, -1.2], [0.38, -0.35, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(within_reason(believed), believed)
    wild = within_reason(np.array([[2.0, 2.7, 3.2], [-4.0, -4.0, -4.0], [0.6, -0.6, 0.0]]))
    assert wild[0].mean() == pytest.approx(1.8)
    assert np.ptp(wild[0]) < 0.8
    assert np.argsort(wild[0]).tolist() == [0, 1, 2]
    assert wild[1] == pytest.approx([-1.8, -1.8, -1.8])
    assert wild[2] == pytest.approx([0.4, -0.4, 0.0])


def test_progress_moves_and_may_end_it() -> None:
    views, depths, pictures = scene()
    lit = [stored(picture) for picture in pictures]
    told: list[float] = []
    find_light(views, depths, lit, NEIGHBOURS, told.append)
    assert told == sorted(told)
    assert len(told) >= COUNT + 5
    assert (told[0], told[-1] < 1.0) == (0.0, True)

    def stop(done: float) -> None:
        if done > 0.7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_light(views, depths, lit, NEIGHBOURS, stop)
