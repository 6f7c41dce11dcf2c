"""Turning told from travelling."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.sfm.turning import focal_of_turning, is_turning, turning_residual
from pipelines.tools.colmap_results import PairStatistics


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def homographies(travel: float, num: int = 20, focal: float = 1.1) -> np.ndarray:
    """Pairs of a camera before a plane at distance 1."""
    calibration = np.diag([focal, focal, 1.0])
    rng = np.random.default_rng(0)
    made = []
    for _ in range(num):
        turn = rotation(rng.normal(size=3), rng.uniform(0.05, 0.4))
        shift = travel * rng.normal(size=(3, 1))
        normal = np.array([[0.3, -0.2, 1.0]])
        made.append(calibration @ (turn + shift @ normal) @ np.linalg.inv(calibration))
    return np.array(made) * rng.uniform(-3, 3, size=(num, 1, 1))


def statistics(found: np.ndarray, num_verified: int, num_images: int = 10) -> PairStatistics:
    zeros = np.zeros(num_images, np.int64)
    return PairStatistics(zeros, zeros, 45, num_verified, found)


def test_a_turning_camera_leaves_no_residual() -> None:
    assert turning_residual(homographies(0.0)) < 2e-3


def test_standing_still_counts_as_turning() -> None:
    assert turning_residual(np.eye(3)[None].repeat(5, 0)) == pytest.approx(0.0, abs=1e-9)


def test_a_camera_that_travels_past_a_wall_is_not_turning() -> None:
    assert turning_residual(homographies(0.2)) > 0.03


def test_the_verdict_needs_most_pairs_to_be_explained() -> None:
    assert is_turning(statistics(homographies(0.0), num_verified=22))
    assert not is_turning(statistics(homographies(0.0), num_verified=40))
    assert not is_turning(statistics(homographies(0.2), num_verified=20))


def test_without_matches_there_is_no_verdict() -> None:
    assert not is_turning(statistics(np.zeros((0, 3, 3)), num_verified=0))
    assert not is_turning(statistics(homographies(0.0, num=3), num_verified=3))


@pytest.mark.parametrize("travel", [0.0, 0.03])
@pytest.mark.parametrize("focal", [0.6, 0.75, 2.5])
def test_a_camera_that_turns_more_than_it_travels_tells_its_focal_length(
    focal: float, travel: float
) -> None:
    found = homographies(travel, 60, focal)
    assert focal_of_turning(statistics(found, num_verified=80)) == pytest.approx(focal, rel=0.12)


@pytest.mark.parametrize(
    ("found", "num_verified"),
    [
        (homographies(0.0, 60, 0.7), 200),  # most pairs show depth
        (homographies(0.0, 8, 0.7), 8),  # too few
        (homographies(0.3, 60, 0.7), 60),  # past a wall
        (homographies(0.0, 60, 1.2), 60),  # what COLMAP starts from anyway
        (np.eye(3)[None].repeat(60, 0), 60),  # standing still
        (np.zeros((0, 3, 3)), 0),
    ],
)
def test_other_captures_tell_no_focal_length(found: np.ndarray, num_verified: int) -> None:
    assert focal_of_turning(statistics(found, num_verified)) is None
