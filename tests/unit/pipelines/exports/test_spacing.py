"""One point of each cube."""

from __future__ import annotations

import numpy as np

from pipelines.exports.spacing import one_of_each_cube


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
