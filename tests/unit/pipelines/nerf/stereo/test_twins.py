"""Every kernel of stereo against its plain twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.nerf.engines.cpu.stereo.aggregation import aggregate_fast
from pipelines.nerf.engines.cpu.stereo.agreement import count_votes_fast
from pipelines.nerf.engines.cpu.stereo.matching import matching_cost_fast
from pipelines.nerf.engines.cpu.stereo.neighbours import pair_scores_fast
from pipelines.nerf.stereo.aggregation import aggregate, jump_weights
from pipelines.nerf.stereo.agreement import AGREE, HIDDEN, IN_PICTURE, SEE_THROUGH, count_votes
from pipelines.nerf.stereo.matching import matching_cost, plane_homographies
from pipelines.nerf.stereo.neighbours import pair_scores
from tests.unit.pipelines.nerf.stereo.painted_wall import look, row_of_cameras


@pytest.mark.parametrize("radius", [1, 3])
def test_matching_costs_equal_their_plain_twin(radius: int) -> None:
    views, _ = row_of_cameras(4)
    hole = views[1].picture.copy()
    hole[20:30, 40:60] = -1.0
    others = np.stack([hole, views[2].picture, views[3].picture])
    homographies = plane_homographies(
        torch.from_numpy(views[0].matrix()),
        torch.from_numpy(np.stack([view.matrix() for view in views[1:]])),
        torch.from_numpy(np.stack([view.from_other(views[0]) for view in views[1:]])).double(),
        torch.linspace(0.1, 0.5, 9, dtype=torch.float64),
    )
    reference = torch.from_numpy(views[0].picture)
    plain = matching_cost(reference, torch.from_numpy(others), homographies, radius).numpy()
    fast = matching_cost_fast(
        views[0].picture, others, homographies.numpy().astype(np.float32), radius
    )
    assert fast.min() >= -1e-3
    assert fast.max() <= 2.001
    gap = np.abs(fast - plain)
    assert np.quantile(gap, 0.999) < 2e-3
    # A pixel on the border of the neighbour's picture may fall to either side by rounding.
    assert np.mean(gap > 0.02) < 2e-4


def test_aggregation_equals_its_plain_twin() -> None:
    rng = np.random.default_rng(3)
    cost = rng.random((20, 24, 31)).astype(np.float32)
    weights = jump_weights(torch.from_numpy(rng.random((24, 31)).astype(np.float32)), 0.05)
    planes, margins = aggregate(torch.from_numpy(cost), weights, 0.1, 0.7)
    fast_planes, fast_margins = aggregate_fast(cost, weights.numpy(), 0.1, 0.7)
    assert np.abs(fast_margins - margins.numpy()).max() < 1e-5
    assert np.abs(fast_planes - planes.numpy()).max() < 1e-3


def test_votes_equal_their_plain_twin() -> None:
    (view, depth), (other, behind) = look(0.0), look(0.4, 0.1)
    rng = np.random.default_rng(0)
    noisy = (depth * rng.choice([1.0, 1.01, 0.9, 1.2, 0.0], depth.shape)).astype(np.float32)
    seen = np.where(rng.random(behind.shape) < 0.1, 0.0, behind).astype(np.float32)
    pose, lens = other.from_other(view), np.array(other.lens, np.float32)
    votes, sums = np.zeros((4, *depth.shape), np.int32), np.zeros(depth.shape, np.float32)
    count_votes_fast(noisy, view.rays(), pose, seen, lens, 0.02, votes, sums)
    plain_votes = torch.zeros(4, *depth.shape, dtype=torch.int32)
    plain_sums = torch.zeros(*depth.shape)
    rays = tuple(torch.from_numpy(item) for item in view.rays())
    count_votes(
        torch.from_numpy(noisy),
        (rays[0], rays[1]),
        torch.from_numpy(pose),
        torch.from_numpy(seen),
        torch.from_numpy(lens),
        0.02,
        plain_votes,
        plain_sums,
    )
    assert (votes != plain_votes.numpy()).mean() < 1e-3  # a pixel on a border by rounding
    same = votes[AGREE] == plain_votes[AGREE].numpy()
    assert np.abs(sums - plain_sums.numpy())[same].max() < 1e-4
    for kind in (AGREE, SEE_THROUGH, HIDDEN, IN_PICTURE):
        assert votes[kind].sum() > 50
    told = votes[[AGREE, SEE_THROUGH, HIDDEN]].sum(axis=0)
    assert (told <= votes[IN_PICTURE]).all()
    assert (told < votes[IN_PICTURE]).any(), "in a picture that knows nothing there"


def test_scores_of_pairs_equal_their_plain_twin() -> None:
    rng = np.random.default_rng(4)
    points = rng.normal(size=(200, 3))
    centers = 4.0 * rng.normal(size=(9, 3))
    centers[1] = centers[0]  # seen from one place: an angle of 0
    toward = points[None] - centers[:, None]
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    shown, facing = rng.random((9, 200)) < 0.6, rng.random((9, 9)) < 0.7
    facing[0, 1] = True
    shown[3] = False
    given = toward, shown, facing, 8.0, (2.0, 10.0)
    plain, fast = pair_scores(*given), pair_scores_fast(*given)
    np.testing.assert_allclose(fast, plain, rtol=1e-6, atol=1e-9)
    assert (plain > 0.0).sum() > 20
    assert not plain[3].any()
    assert not plain.diagonal().any()
