"""Depth against truth: shares as made, holes on either side."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.judging.depth_scores import (
    depth_agreement,
    depth_scores,
    fitted_scale,
)


def _maps() -> tuple[np.ndarray, np.ndarray]:
    """100 pixels of truth 2: 40 right, 20 off by 8 %, 30 missing, 10 without truth."""
    truth = np.full((10, 10), 2.0)
    found = np.full((10, 10), 2.02)
    found[4:6] = 2.16
    found[6:9] = 0.0
    truth[9] = 0.0
    return found, truth


def test_shares_are_over_covered_and_over_all_confident_pixels() -> None:
    found, truth = _maps()
    scores = depth_scores([found], [truth])
    assert scores["num_pixels"] == 90
    assert scores["within_5_percent"] == pytest.approx(40 / 60, abs=1e-4)
    assert scores["covered_and_within_5_percent"] == pytest.approx(40 / 90, abs=1e-4)
    assert scores["coverage"] == pytest.approx(60 / 90, abs=1e-4)
    assert scores["median_relative_error"] == pytest.approx(0.01)


def test_only_confident_pixels_count_and_views_are_pooled() -> None:
    found, truth = _maps()
    confident = np.zeros((10, 10), bool)
    confident[4:6] = True
    scores = depth_scores([found, found], [truth, truth], [confident, ~confident])
    assert scores["num_pixels"] == 20 + 70
    assert scores["within_5_percent"] == pytest.approx(40 / (20 + 40), abs=1e-4)


def test_nothing_to_compare_is_null_and_other_shapes_are_refused() -> None:
    found, truth = _maps()
    scores = depth_scores([found], [0 * truth])
    assert scores["num_pixels"] == 0
    assert scores["covered_and_within_5_percent"] is None
    assert depth_scores([0 * found], [truth])["covered_and_within_5_percent"] == 0.0
    with pytest.raises(ValueError, match="cannot be compared"):
        depth_scores([found[:5]], [truth])


def test_agreement_tells_before_behind_and_missing_apart() -> None:
    found, truth = _maps()
    found[0] = 1.5
    shares = depth_agreement([found], [truth])
    assert shares == {
        "agrees": round(30 / 90, 4),
        "before": round(10 / 90, 4),
        "behind": round(20 / 90, 4),
        "missing": round(30 / 90, 4),
        "num_pixels": 90,
    }
    assert depth_agreement([], [])["agrees"] is None


def test_a_scale_is_found_through_holes_and_outliers() -> None:
    found, truth = _maps()
    assert fitted_scale([found], [3 * truth]) == pytest.approx(3 / 1.01)
    assert fitted_scale([0 * found], [truth]) is None
