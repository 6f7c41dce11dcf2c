"""Adjustment of poses that are known roughly, on made sightings."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipelines.tools.colmap_adjustment import Rounds
from pipelines.tools.colmap_posing import Floats, adjusted
from tests.unit.pipelines.sfm.made_corridor import LENS, NUM, at_once, corridor

ENDS = Rounds(iterations=50, rounds=2, tolerance=1e-7)
SLACK = 0.05


def worst_center(centers: Mapping[int, Floats]) -> float:
    """How far the worst centre ends from the truth, world units."""
    poses, points, seen = corridor()
    moved, _, _ = adjusted(
        poses,
        [LENS] * NUM,
        points,
        seen,
        ENDS,
        centers=centers,
        slack=SLACK,
        loss_px=1.0,
        run=at_once,
        num_threads=1,
    )
    return float(np.linalg.norm(moved[:, :, 3] - poses[:, :, 3], axis=1).max())


def test_given_centres_hold_a_path_that_matches_leave_loose() -> None:
    given = corridor()[0][:, :, 3] + np.random.default_rng(6).normal(0.0, 0.02, (NUM, 3))
    assert worst_center(dict(enumerate(given))) < 2 * SLACK
    # What the priors are for: the same sightings alone bend the path.
    assert worst_center({}) > 6 * SLACK
