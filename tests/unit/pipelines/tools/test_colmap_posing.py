"""Adjustment of poses that are known roughly, on made sightings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pipelines.scene.cameras_file import Intrinsics
from pipelines.tools.colmap_adjustment import Rounds
from pipelines.tools.colmap_posing import Floats, Sightings, adjusted

NUM, LENGTH = 40, 12.0
LENS = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
ENDS = Rounds(iterations=50, rounds=2, tolerance=1e-7)
SLACK = 0.05


def at_once(_what: str, call: Callable[[Any], Any]) -> Any:
    return call(None)


def corridor() -> tuple[Floats, Floats, Sightings]:
    """True poses [N, 3, 4] along a straight way past a wall 3 away, points, and what is seen of
    them, half a pixel off; a point is seen from two or three places only."""
    random = np.random.default_rng(5)
    poses = np.tile(np.eye(3, 4), (NUM, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, LENGTH, NUM)
    places = random.uniform((-1.0, -1.0, 2.6), (LENGTH + 1.0, 1.0, 3.4), (700, 3))
    point, image, xy = [], [], []
    for number, place in enumerate(places):
        near = np.argsort(np.abs(poses[:, 0, 3] - place[0]))[: 2 + number % 2]
        for index in near.tolist():
            local = place - poses[index, :, 3]
            pixel = LENS.fl_x * local[:2] / local[2] + (LENS.cx, LENS.cy)
            point.append(number)
            image.append(index)
            xy.append(pixel + random.normal(0.0, 0.5, 2))
    return poses, places, Sightings(np.array(point), np.array(image), np.array(xy))


def worst_center(centers: Mapping[int, Floats]) -> float:
    """How far the worst centre ends from the truth, world units."""
    poses, points, seen = corridor()
    moved, _ = adjusted(
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
