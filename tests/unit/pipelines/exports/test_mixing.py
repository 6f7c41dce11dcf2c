"""One picture from the trained scene's and the mesh's."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.mixing import enlarged, mixed
from pipelines.judging.asset_views import AssetView


def seen(color: np.ndarray, hit: np.ndarray | None = None) -> AssetView:
    """A mesh that shows these colours, everywhere or where it is hit."""
    hit = np.ones(color.shape[:2], bool) if hit is None else hit
    return AssetView(
        np.where(hit[..., None], color, 0.0).astype(np.float32), hit, hit.astype(np.float32)
    )


def plain(value: float, height: int = 24, width: int = 40) -> np.ndarray:
    return np.full((height, width, 3), value, np.float32)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (0.4, 0.4),
        (0.44, 0.4 + 0.04 * 0.5 * np.exp(-(0.2**2))),
        (0.6, 0.4 + 0.2 * 0.5 * np.exp(-1.0)),
        (1.0, 0.4),
    ],
)
def test_what_both_show_is_their_mean_and_what_differs_the_scenes(
    mesh: float, expected: float
) -> None:
    picture = mixed(plain(0.4), seen(plain(mesh)))
    np.testing.assert_allclose(picture, expected, atol=2e-4)


def test_detail_finer_than_the_scenes_pixels_is_the_meshs() -> None:
    stripes = plain(0.5, 48, 80)
    stripes[:, ::2] += 0.1
    stripes[:, 1::2] -= 0.1
    picture = mixed(plain(0.5), seen(stripes))
    np.testing.assert_allclose(picture[:, ::2], 0.55, atol=1e-4)
    np.testing.assert_allclose(picture[:, 1::2], 0.45, atol=1e-4)


def test_where_there_is_no_mesh_the_scene_goes_on_without_a_seam() -> None:
    ramp = np.broadcast_to(np.linspace(0.2, 0.8, 80)[None, :, None], (48, 80, 3))
    field = ramp.reshape(24, 2, 40, 2, 3).mean(axis=(1, 3))
    half = np.zeros((48, 80), bool)
    half[:, 41:] = True
    picture = mixed(field, seen(np.array(ramp), half))
    np.testing.assert_allclose(picture[:, 2:-2], ramp[:, 2:-2], atol=2e-3)
    none = mixed(field, seen(np.array(ramp), np.zeros_like(half)))
    np.testing.assert_allclose(none[:, 2:-2], ramp[:, 2:-2], atol=2e-3)


def test_errors_that_know_nothing_of_each_other_shrink() -> None:
    chance = np.random.default_rng(3)
    truth = np.clip(chance.random((6, 10, 3)).repeat(8, 0).repeat(8, 1), 0.2, 0.8)
    field = np.clip(truth + chance.normal(0.0, 0.03, truth.shape), 0.0, 1.0)
    mesh = np.clip(truth + chance.normal(0.0, 0.03, truth.shape), 0.0, 1.0)
    picture = mixed(field, seen(mesh))

    def error(shown: np.ndarray) -> float:
        return float(np.square(shown - truth).mean())

    assert error(picture) < 0.6 * min(error(field), error(mesh))


def test_a_mesh_in_the_wrong_place_takes_little_away() -> None:
    """A bar that the mesh has ten pixels too far to the right, and fog before the scene's."""
    truth = plain(0.2, 48, 80)
    truth[:, 20:40] = 0.9
    wrong = np.roll(truth, 10, axis=1)
    picture = mixed(truth, seen(wrong))
    assert np.abs(picture - truth).max() < 0.2 < np.abs(wrong - truth).max()


def test_sizes_need_not_divide_and_colours_stay_colours() -> None:
    chance = np.random.default_rng(5)
    field, mesh = chance.random((17, 31, 3)), chance.random((45, 82, 3))
    picture = mixed(np.round(field), seen(np.round(mesh)))
    assert picture.shape == (45, 82, 3)
    assert picture.dtype == np.float32
    assert 0.0 <= picture.min() <= picture.max() <= 1.0


def test_a_picture_all_round_has_no_seam() -> None:
    """What a player shows where the left border meets the right one."""
    angle = (np.arange(480) + 0.5) / 480 * 2.0 * np.pi
    whole = np.broadcast_to(0.5 + 0.3 * np.sin(angle + 0.7)[None, :, None], (240, 480, 3))
    field = whole.reshape(24, 10, 48, 10, 3).mean(axis=(1, 3))
    none = seen(np.zeros((240, 480, 3)), np.zeros((240, 480), bool))
    for picture in (enlarged(field, 240, 480, around=True), mixed(field, none, around=True)):
        assert picture.shape == (240, 480, 3)
        np.testing.assert_allclose(picture, whole, atol=4e-3)
    cut = np.abs(enlarged(field, 240, 480)[:, 0] - whole[:, 0]).max()
    assert cut > 8e-3, "without it there is one"
    half = np.zeros((240, 480), bool)
    half[:, :100] = half[:, -100:] = True
    both = mixed(field, seen(np.array(whole), half), around=True)
    np.testing.assert_allclose(both, whole, atol=6e-3)
