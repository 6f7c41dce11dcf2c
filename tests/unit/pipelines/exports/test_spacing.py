"""One point of each cube, and the least crowded points."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.exports.spacing import least_crowded, one_of_each_cube


def test_each_cube_keeps_the_point_nearest_to_its_middle() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 1.0, (3000, 3)) + 1000.0
    kept = one_of_each_cube(points, 0.2)
    best: dict[tuple[int, ...], tuple[float, int]] = {}
    low = points.min(axis=0)
    for index, point in enumerate(points):
        cube = tuple(int(step) for step in (point - low) / 0.2)
        middle = low + (np.asarray(cube) + 0.5) * 0.2
        best[cube] = min(best.get(cube, (np.inf, 0)), (float(((point - middle) ** 2).sum()), index))
    assert kept.tolist() == sorted(index for _, index in best.values())
    assert 125 <= len(kept) <= 216


def test_no_points_and_points_far_apart_stay() -> None:
    assert len(one_of_each_cube(np.zeros((0, 3)), 1.0)) == 0
    apart = np.arange(30.0).reshape(10, 3)
    assert one_of_each_cube(apart, 0.5).tolist() == list(range(10))


def _sheet(count: int) -> NDArray[np.float64]:
    """Points of a bent sheet, four times as dense in one half of it as in the other, far away."""
    rng = np.random.default_rng(2)
    x = np.where(rng.random(count) < 0.8, rng.random(count), 1.0 + rng.random(count))
    y = rng.random(count)
    sheet: NDArray[np.float64] = np.column_stack([x, y, 0.1 * np.sin(3.0 * x)])
    return sheet + np.array([4.0e6, -2.0e6, 100.0])


def _gaps(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """From each point to its nearest other one."""
    distances: NDArray[np.float64] = cKDTree(points).query(points, k=2)[0][:, 1]
    return distances


@pytest.mark.parametrize(
    ("ratio", "denser"), [(1.02, 0.02), (1.5, 0.02), (3.0, 0.02), (40.0, 0.05)]
)
def test_the_least_crowded_are_as_many_as_wanted_and_evenly_spread(
    ratio: float, denser: float
) -> None:
    points = _sheet(30_000)
    wanted = round(30_000 / ratio)
    kept = least_crowded(points, wanted, seed=3)
    assert len(kept) == wanted
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(kept, least_crowded(points, wanted, seed=3))
    # As dense here and there as before, for neighbourhoods of 64 lose the same share.
    dense = (points[:, 0] < 4.0e6 + 1.0).mean()
    assert (points[kept, 0] < 4.0e6 + 1.0).mean() == pytest.approx(dense, abs=denser)
    drawn = np.random.default_rng(0).choice(30_000, wanted, replace=False)
    closest, of_drawn = (np.percentile(_gaps(points[some]), 10) for some in (kept, drawn))
    assert closest > (1.02 if ratio < 1.1 else 1.4) * of_drawn


def test_where_there_are_no_more_than_wanted_all_stay() -> None:
    points = np.random.default_rng(0).random((50, 3))
    for wanted in (50, 51):
        assert least_crowded(points, wanted, seed=1).tolist() == list(range(50))
    assert len(least_crowded(np.zeros((0, 3)), 5, seed=1)) == 0


def test_points_at_one_place_and_few_points_are_no_trouble() -> None:
    assert len(least_crowded(np.ones((200, 3)), 7, seed=1)) == 7
    assert len(least_crowded(np.random.default_rng(0).random((10, 3)), 3, seed=1)) == 3
