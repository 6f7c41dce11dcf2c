"""Depth against truth: shares as made, holes on either side, files as cameras write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.judging.depth_scores import (
    depth_agreement,
    depth_scores,
    fitted_scale,
    read_depth_png,
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


def test_millimetres_are_read_at_another_size_without_mixing_depths(tmp_path: Path) -> None:
    stored = np.full((20, 30), 1500, np.uint16)
    stored[:, 15:] = 4000
    stored[:5] = 0
    Image.fromarray(stored).save(tmp_path / "depth.png")
    depth = read_depth_png(tmp_path / "depth.png", 0.001, (10, 15))
    assert sorted(np.unique(depth).tolist()) == pytest.approx([0.0, 1.5, 4.0])
    assert depth[9, 0] == pytest.approx(1.5)
    assert (depth[:2] == 0).all()
    larger = read_depth_png(tmp_path / "depth.png", 0.001, (40, 60))
    assert larger.shape == (40, 60)
    assert larger[39, 59] == pytest.approx(4.0)


def test_what_is_no_depth_picture_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "grey.png")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "rgb.png")
    (tmp_path / "text.png").write_text("no picture")
    for name in ("grey.png", "rgb.png", "text.png", "absent.png"):
        with pytest.raises(ValueError, match=name):
            read_depth_png(tmp_path / name, 0.001, (4, 4))
