"""Lenses chosen by held-out observations, on models whose true lens is known."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pipelines.sfm.intrinsics import (
    AUTO,
    BENT_GAIN,
    LENSES,
    LensVerdict,
    focal_spread,
    gain,
    lens_warnings,
    settle_lenses,
)
from pipelines.tools.colmap_adjustment import Rounds, share_done
from pipelines.tools.colmap_lenses import LensTrials, change_lens
from pipelines.tools.colmap_results import SparseModel, sparse_model
from tests.unit.pipelines.sfm.synthetic_model import HEIGHT, WIDTH, Lens, trials_of

CENTER = (WIDTH / 2, HEIGHT / 2)
SIMPLE: Lens = ("SIMPLE_RADIAL", (520.0, *CENTER, 0.03))
RADIAL: Lens = ("RADIAL", (520.0, *CENTER, -0.25, 0.3))
SKEWED: Lens = ("OPENCV", (520.0, 500.0, *CENTER, -0.05, 0.02, 0.004, -0.003))


def settle(
    trials: LensTrials,
    folder: Path,
    wanted: str = AUTO,
    priors_px: Mapping[int, float] | None = None,
) -> tuple[SparseModel, tuple[LensVerdict, ...]]:
    model = sparse_model(pycolmap.Reconstruction(folder), folder)
    return settle_lenses(model, trials, wanted, priors_px)


@pytest.mark.parametrize("truth", [SIMPLE, RADIAL, SKEWED], ids=lambda lens: lens[0])
def test_the_lens_that_took_the_pictures_is_found(truth: Lens, tmp_path: Path) -> None:
    model, (found,) = settle(trials_of(tmp_path, [truth], arc_deg=70), tmp_path)
    assert found.lens == truth[0]
    assert found.focal_px == pytest.approx(truth[1][0], rel=0.02 if truth is SKEWED else 0.005)
    assert [candidate.lens for candidate in found.candidates] == list(LENSES)
    (lens,) = model.cameras
    assert found.focal_px == pytest.approx((lens.fl_x + lens.fl_y) / 2)
    assert lens.fl_x == pytest.approx(520.0, rel=0.005)
    assert lens.fl_y == pytest.approx(500.0 if truth is SKEWED else lens.fl_x, rel=0.005)
    assert not found.is_weak
    assert model.error_px < 0.6


def test_a_lens_that_was_asked_for_stays_and_is_looked_at(tmp_path: Path) -> None:
    _, (found,) = settle(trials_of(tmp_path, [RADIAL], arc_deg=70), tmp_path, "SIMPLE_RADIAL")
    assert (found.lens, found.why) == ("SIMPLE_RADIAL", "asked for")
    assert [candidate.lens for candidate in found.candidates] == ["SIMPLE_RADIAL"]
    assert found.focal_spread is not None


def test_a_short_arc_leaves_the_focal_length_open_and_says_so(tmp_path: Path) -> None:
    narrow = trials_of(tmp_path / "narrow", [SIMPLE], arc_deg=3, depth=0.1, swing=0.0)
    _, (weak,) = settle(narrow, tmp_path / "narrow")
    assert weak.is_weak
    (warning,) = lens_warnings([weak])
    assert warning["code"] == "focal_length_weak"
    assert "14 images" in warning["message"]
    assert "Walk further around" in warning["hint"]
    assert warning["details"]["focal_spread_percent"] > 10
    wide = trials_of(tmp_path / "wide", [SIMPLE], arc_deg=70)
    _, (strong,) = settle(wide, tmp_path / "wide")
    assert strong.focal_spread is not None
    assert strong.focal_spread < 0.05
    assert lens_warnings([strong]) == []


def test_a_focal_length_left_open_is_exifs_unless_pictures_contradict_that(tmp_path: Path) -> None:
    narrow = trials_of(tmp_path, [SIMPLE], arc_deg=3, depth=0.1, swing=0.0)
    own, (weak,) = settle(narrow, tmp_path)
    assert not weak.is_exif
    model, (found,) = settle(narrow, tmp_path, priors_px={0: 530.0})
    assert found.is_exif
    assert found.as_dict()["focal_from"] == "exif"
    assert lens_warnings([found]) == []
    assert found.focal_px == model.cameras[0].fl_x == pytest.approx(530.0)
    assert own.cameras[0].fl_x != pytest.approx(530.0, rel=0.005)
    assert model.error_px < 0.6
    model, (found,) = settle(narrow, tmp_path, priors_px={0: 5200.0})
    assert not found.is_exif
    assert model.cameras[0].fl_x == own.cameras[0].fl_x


def test_a_focal_length_that_pictures_know_stays_theirs(tmp_path: Path) -> None:
    wide = trials_of(tmp_path, [SIMPLE], arc_deg=70)
    model, (found,) = settle(wide, tmp_path, priors_px={0: 540.0})
    assert not found.is_exif
    assert model.cameras[0].fl_x == pytest.approx(520.0, rel=0.005)


def test_of_two_cameras_only_the_one_with_exif_is_held(tmp_path: Path) -> None:
    narrow = trials_of(tmp_path, [SIMPLE, SIMPLE], arc_deg=3, depth=0.1, swing=0.0, num_images=20)
    model, found = settle(narrow, tmp_path, priors_px={1: 530.0})
    assert sorted(each.is_exif for each in found) == [False, True]
    assert model.cameras[1].fl_x == pytest.approx(530.0)


def test_cameras_are_judged_one_by_one(tmp_path: Path) -> None:
    trials = trials_of(tmp_path, [SIMPLE, RADIAL], arc_deg=70, num_images=20)
    model, found = settle(trials, tmp_path)
    assert sorted(each.lens for each in found) == ["RADIAL", "SIMPLE_RADIAL"]
    assert [lens.k2 == 0.0 for lens in model.cameras] == [True, False]


def test_some_images_of_a_long_film_tell_its_lens_and_all_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.tools.colmap_lenses.MOST_IMAGES", 12)
    monkeypatch.setattr("pipelines.tools.colmap_lenses.FEWEST_OF_CAMERA", 4)
    film = [RADIAL] * 8 + [SIMPLE]
    trials = trials_of(tmp_path, film, arc_deg=70, num_images=36)
    assert len(np.unique(trials.image_of)) == 36, "four of each camera, which is all that each took"
    trials = trials_of(tmp_path, [RADIAL, SIMPLE], arc_deg=70, num_images=36)
    assert len(np.unique(trials.image_of)) == 12
    model, found = settle(trials, tmp_path)
    assert [(each.lens, each.num_images) for each in found] == [
        ("RADIAL", 18),
        ("SIMPLE_RADIAL", 18),
    ]
    assert found[0].focal_px == pytest.approx(520.0, rel=0.005)
    assert model.indices == tuple(range(36))
    assert model.error_px < 0.6


def test_adjusting_many_images_ends_as_late_but_can_be_cancelled_as_soon() -> None:
    ends = Rounds(iterations=10, rounds=5, tolerance=1e-6)
    assert ends.of(100) == ends
    assert ends.of(300) == Rounds(iterations=3, rounds=17, tolerance=1e-6)
    assert ends.of(1000) == Rounds(iterations=1, rounds=50, tolerance=1e-6)
    shares = [share_done(rounds) for rounds in range(100)]
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] < 1.0


def test_a_camera_of_few_images_keeps_the_simplest_lens(tmp_path: Path) -> None:
    _, (found,) = settle(trials_of(tmp_path, [SKEWED], arc_deg=40, num_images=4), tmp_path)
    assert found.lens == "SIMPLE_RADIAL"
    assert "fewer than 5 images" in found.why


def test_where_nothing_can_be_held_out_nothing_is_claimed(tmp_path: Path) -> None:
    _, (found,) = settle(trials_of(tmp_path, [SKEWED], arc_deg=70, num_points=30), tmp_path)
    assert found.lens == "SIMPLE_RADIAL"
    assert found.focal_spread is None
    assert "too few points" in found.why


def test_the_standard_error_of_a_gain_counts_images_not_observations() -> None:
    random = np.random.default_rng(1)
    image_of = np.repeat(np.arange(8), 25)
    before = 1.0 + random.random(200)
    after = before - 0.05 + 0.1 * np.repeat(random.normal(size=8), 25)
    found = gain(before, after, image_of)
    differences = before**2 - after**2
    mean = sum(differences) / 200
    squares = 0.0
    for image in range(8):
        squares += (
            sum(d - mean for d, i in zip(differences, image_of, strict=True) if i == image) ** 2
        )
    assert found.share == pytest.approx(mean / np.mean(before**2))
    assert found.sigmas == pytest.approx(mean / (np.sqrt(squares) / 200))
    scattered = gain(before, after, np.arange(200))
    assert abs(scattered.sigmas) > 2 * abs(found.sigmas)


def test_wrong_matches_and_points_behind_the_camera_do_not_decide() -> None:
    before, after = np.full(100, 1.0), np.full(100, 0.9)
    after[:2] = np.inf
    assert gain(before, after, np.arange(100)).share == pytest.approx((98 * 0.19 - 2 * 24) / 100)


def test_the_spread_is_where_a_parabola_reaches_the_margin() -> None:
    still = np.ones(50)
    # Errors rise with the square of the change: by 4 % of the mean square at the step of 5 %.
    moved = [np.full(50, np.sqrt(1.04))] * 2
    assert focal_spread(still, moved, np.arange(50)) == pytest.approx(
        0.05 * np.sqrt(BENT_GAIN / 0.04)
    )
    assert focal_spread(still, [still, still], np.arange(50)) == 1.0


def test_changing_a_lens_keeps_what_both_models_have() -> None:
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV", width=WIDTH, height=HEIGHT, params=list(SKEWED[1])
    )
    change_lens(camera, "RADIAL")
    assert camera.model.name == "RADIAL"
    np.testing.assert_allclose(camera.params, [510.0, *CENTER, -0.05, 0.02])
    change_lens(camera, "OPENCV")
    np.testing.assert_allclose(camera.params, [510.0, 510.0, *CENTER, -0.05, 0.02, 0.0, 0.0])
