"""Scores of views: holes count as they should, masks are left out."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.judging.asset_scores import mean_scores, picture_of, score_view
from pipelines.judging.asset_views import AssetView, MeshCaster
from tests.unit.pipelines.judging.scenes import camera, wall


def _view(color: np.ndarray, hit: np.ndarray) -> AssetView:
    shown = np.where(hit[..., None], color, 0.0).astype(np.float32)
    return AssetView(shown, hit, hit.astype(np.float32))


def _photo(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((40, 50, 3)).astype(np.float32)


def test_a_perfect_mesh_with_a_hole_scores_its_hole_alone() -> None:
    vertices, faces, colors = wall()
    photo = MeshCaster(vertices, faces, colors).view(camera(), 0).color
    holed = MeshCaster(*wall(hole=0.5)[:2], colors).view(camera(), 0)
    scores = score_view(holed, photo)
    assert scores["coverage"] == pytest.approx(0.75, abs=0.01)
    assert scores["psnr"] is not None
    assert scores["psnr"] > 60.0
    assert scores["ssim"] == pytest.approx(1.0, abs=1e-4)
    error = np.where(holed.hit[..., None], 0.0, photo - 0.5)
    assert scores["psnr_with_holes"] == pytest.approx(-10 * np.log10((error**2).mean()), abs=0.01)


def test_the_covered_part_alone_makes_psnr() -> None:
    photo, hit = _photo(), np.zeros((40, 50), bool)
    hit[:, :20] = True
    shown = np.clip(photo + 0.1, 0, 2)
    scores = score_view(_view(shown, hit), photo)
    assert scores["coverage"] == 0.4
    assert scores["psnr"] == pytest.approx(20.0, abs=1e-3)
    assert score_view(_view(photo, hit), photo)["psnr"] == 100.0


def test_masked_pixels_are_nowhere_counted() -> None:
    photo, hit = _photo(), np.ones((40, 50), bool)
    valid = np.zeros((40, 50), bool)
    valid[:, :30] = True
    hit[:, :6] = False
    wrong = photo.copy()
    wrong[:, 30:] = 0.0
    scores = score_view(_view(wrong, hit), photo, valid)
    assert scores["coverage"] == 0.8
    assert scores["psnr"] == 100.0
    expected = np.zeros_like(photo)
    expected[:, :6] = photo[:, :6] - 0.5
    assert scores["psnr_with_holes"] == pytest.approx(
        -10 * np.log10((expected[:, :30] ** 2).mean()), abs=1e-3
    )


def test_a_view_of_nothing_has_holes_and_no_psnr() -> None:
    photo = np.full((40, 50, 3), 0.6, np.float32)
    scores = score_view(_view(photo, np.zeros((40, 50), bool)), photo)
    assert scores == {"coverage": 0.0, "psnr": None, "ssim": None, "psnr_with_holes": 20.0}


def test_means_are_over_views_that_have_the_value() -> None:
    empty = {"coverage": 0.0, "psnr": None, "ssim": None, "psnr_with_holes": 10.0}
    full = {"coverage": 1.0, "psnr": 24.0, "ssim": 0.9, "psnr_with_holes": 24.0}
    assert mean_scores([empty, full]) == {
        "coverage": 0.5,
        "psnr": 24.0,
        "ssim": 0.9,
        "psnr_with_holes": 17.0,
    }
    assert mean_scores([])["coverage"] is None


def test_what_cannot_be_compared_is_refused() -> None:
    view = _view(_photo(), np.ones((40, 50), bool))
    with pytest.raises(ValueError, match="cannot be compared"):
        score_view(view, _photo()[:, :20])
    with pytest.raises(ValueError, match="leaves nothing"):
        score_view(view, _photo(), np.zeros((40, 50), bool))


def test_the_picture_shows_photo_mesh_and_holes_side_by_side() -> None:
    photo, hit = _photo(), np.ones((40, 50), bool)
    hit[10:20] = False
    picture = picture_of(_view(photo, hit), photo)
    assert picture.shape == (40, 150, 3)
    assert np.array_equal(picture[:10, :50], picture[:10, 50:100])
    assert (picture[10:20, 50:100] == [255, 0, 255]).all()
    assert (picture[10:20, 100:] == 255).all()
    assert (picture[20:, 100:] == 0).all()
