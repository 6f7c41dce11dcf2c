"""Losses against double loops, and their gradients."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.nerf.along_ray.losses import (
    bend_loss,
    color_loss,
    distortion_loss,
    interlevel_loss,
    orientation_loss,
    outer_measure,
    predicted_normal_loss,
    termination_loss,
)


def _histogram(rays: int, num: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    steps = torch.rand(rays, num + 1, generator=generator, dtype=torch.float64) + 0.01
    edges = torch.cumsum(steps, -1)
    edges = (edges - edges[:, :1]) / (edges[:, -1:] - edges[:, :1])
    weights = torch.rand(rays, num, generator=generator, dtype=torch.float64)
    return edges, weights / weights.sum(-1, keepdim=True)


def _overlap_loop(edges: torch.Tensor, other: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    covers = torch.zeros(edges.shape[0], edges.shape[1] - 1, dtype=torch.float64)
    for ray in range(edges.shape[0]):
        for i in range(edges.shape[1] - 1):
            for j in range(other.shape[1] - 1):
                starts_before_end = other[ray, j] < edges[ray, i + 1]
                ends_after_start = other[ray, j + 1] > edges[ray, i]
                if starts_before_end and ends_after_start:
                    covers[ray, i] += weights[ray, j]
    return covers


def test_outer_measure_adds_all_overlapping_bins() -> None:
    edges, _ = _histogram(5, 7, seed=0)
    # The outer edges are inside those of the proposal: no tie, where the definition is open.
    edges = 0.01 + 0.98 * edges
    other, weights = _histogram(5, 11, seed=1)
    assert torch.allclose(
        outer_measure(edges, other, weights), _overlap_loop(edges, other, weights)
    )


def test_outer_measure_counts_the_bin_that_begins_where_an_interval_ends() -> None:
    # As the paper's published code does; the bin that ends where an interval begins is left out.
    halves, weights = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[0.25, 0.75]])
    found = outer_measure(halves, halves, weights)
    assert torch.equal(found, torch.tensor([[1.0, 0.75]]))
    # Shifted by rounding or without width, the outermost intervals still lie in the outermost bins.
    rounded = torch.tensor([[-1e-6, 0.25, 1.0 + 1e-6, 1.0 + 1e-6]])
    found = outer_measure(rounded, halves, weights)
    assert torch.equal(found, torch.tensor([[0.25, 1.0, 0.75]]))


def test_interlevel_loss_equals_the_double_loop() -> None:
    edges, weights = _histogram(5, 7, seed=0)
    edges = 0.01 + 0.98 * edges
    proposals = [_histogram(5, 11, seed=1), _histogram(5, 6, seed=2)]
    expected = 0.0
    for other, found in proposals:
        cover = _overlap_loop(edges, other, 0.3 * found)
        expected += float(((weights - cover).clamp_min(0) ** 2 / (weights + 1e-7)).mean())
    scaled = [(other, 0.3 * found) for other, found in proposals]
    assert expected > 1e-3
    assert abs(float(interlevel_loss(edges, weights, scaled)) - expected) < 1e-12


def test_interlevel_loss_is_zero_where_the_proposal_covers() -> None:
    edges, weights = _histogram(5, 7, seed=0)
    assert float(interlevel_loss(edges, weights, [(edges, weights)])) < 1e-12


def test_interlevel_loss_moves_the_proposal_alone() -> None:
    edges, weights = _histogram(3, 5, seed=0)
    other, found = _histogram(3, 4, seed=1)
    weights.requires_grad_()
    found = (0.2 * found).requires_grad_()
    interlevel_loss(edges, weights, [(other, found)]).backward()
    assert weights.grad is None
    assert found.grad is not None
    assert float(found.grad.abs().sum()) > 0.0


def test_interlevel_gradient_is_right() -> None:
    edges, weights = _histogram(3, 5, seed=0)
    other, found = _histogram(3, 4, seed=1)
    start = (0.2 * found).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: interlevel_loss(edges, weights, [(other, w)]), start)


def test_distortion_loss_equals_the_double_sum() -> None:
    edges, weights = _histogram(4, 9, seed=3)
    expected = 0.0
    for ray in range(4):
        middles = 0.5 * (edges[ray, 1:] + edges[ray, :-1])
        for i in range(9):
            expected += float(weights[ray, i] ** 2 * (edges[ray, i + 1] - edges[ray, i])) / 3.0
            for j in range(9):
                gap = abs(float(middles[i] - middles[j]))
                expected += float(weights[ray, i] * weights[ray, j]) * gap
    assert abs(float(distortion_loss(edges, weights)) - expected / 4) < 1e-12


def test_distortion_loss_of_one_narrow_interval_is_small() -> None:
    edges = torch.tensor([[0.0, 0.499, 0.501, 1.0]])
    spread = distortion_loss(edges, torch.tensor([[0.5, 0.0, 0.5]]))
    narrow = distortion_loss(edges, torch.tensor([[0.0, 1.0, 0.0]]))
    assert float(narrow) < 1e-3 < float(spread)


def test_distortion_gradient_is_right() -> None:
    edges, weights = _histogram(3, 6, seed=4)
    start = weights.requires_grad_()
    assert torch.autograd.gradcheck(lambda w: distortion_loss(edges, w), start)


def test_distortion_gradient_in_the_edges_is_right() -> None:
    edges, weights = _histogram(3, 6, seed=4)
    assert torch.autograd.gradcheck(lambda e: distortion_loss(e, weights), edges.requires_grad_())


def test_distortion_of_two_points_is_their_distance_and_their_widths() -> None:
    # w = (1/2, 1/2) at 0.25 and 0.75, both 0.1 wide: 2 (1/4)(1/2) + (1/3) 2 (1/4)(0.1).
    edges = torch.tensor([[0.2, 0.3, 0.7, 0.8]], dtype=torch.float64)
    weights = torch.tensor([[0.5, 0.0, 0.5]], dtype=torch.float64)
    assert float(distortion_loss(edges, weights)) == pytest.approx(0.25 + 0.05 / 3.0)


def test_color_loss_is_the_mean_over_rays_and_channels() -> None:
    predicted = torch.tensor([[0.1, 0.5, 1.0], [0.0, 0.2, 0.4]])
    truth = torch.tensor([[0.1, 0.3, 0.5], [0.3, 0.2, 0.5]])
    expected = (0.0 + 0.04 + 0.25 + 0.09 + 0.0 + 0.01) / 6.0
    assert float(color_loss(predicted, truth)) == pytest.approx(expected)


def _normals(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    vectors = torch.randn(4, 6, 3, generator=generator, dtype=torch.float64)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def test_orientation_loss_equals_the_loop() -> None:
    _, weights = _histogram(4, 6, seed=5)
    normals, directions = _normals(0), _normals(1)[:, 0]
    expected, num_away = 0.0, 0
    for ray in range(4):
        for i in range(6):
            along = sum(float(normals[ray, i, k] * directions[ray, k]) for k in range(3))
            if along > 0.0:  # looks the way the ray goes: away from the camera
                expected += float(weights[ray, i]) * along**2
                num_away += 1
    assert 0 < num_away < 24
    found = orientation_loss(weights, normals, directions)
    assert float(found) == pytest.approx(expected / 4.0, rel=1e-12)


def test_orientation_loss_punishes_only_surfaces_seen_from_behind() -> None:
    down = torch.tensor([[0.0, 0.0, -1.0]])  # a camera above the ground, looking down
    up = torch.tensor([[[0.0, 0.0, 1.0]]])
    weights = torch.tensor([[0.5]])
    assert float(orientation_loss(weights, up, down)) == 0.0
    assert float(orientation_loss(weights, -up, down)) == 0.5


def test_orientation_loss_turns_normals_towards_the_camera_and_leaves_weights() -> None:
    _, weights = _histogram(4, 6, seed=5)
    weights.requires_grad_()
    normals, directions = _normals(0).requires_grad_(), _normals(1)[:, 0]
    orientation_loss(weights, normals, directions).backward()
    assert weights.grad is None
    assert normals.grad is not None
    # Going down the gradient takes away from what looks along the ray, and never adds to it.
    change = -(normals.grad * directions[:, None, :]).sum(-1)
    away = (normals.detach() * directions[:, None, :]).sum(-1) > 0.0
    assert bool((change[away] < 0.0).all())
    assert not change[~away].any()
    assert torch.autograd.gradcheck(
        lambda n: orientation_loss(weights.detach(), n, directions), normals
    )


def test_predicted_normal_loss_is_half_the_weighted_squared_distance() -> None:
    _, weights = _histogram(4, 6, seed=6)
    normals, predicted = _normals(2), _normals(3)
    expected = 0.0
    for ray in range(4):
        for i in range(6):
            gap = (normals[ray, i] - predicted[ray, i]).tolist()
            expected += float(weights[ray, i]) * sum(value**2 for value in gap) / 2.0
    found = predicted_normal_loss(weights, normals, predicted)
    assert float(found) == pytest.approx(expected / 4.0, rel=1e-12)
    assert float(predicted_normal_loss(weights, normals, normals)) == pytest.approx(0.0, abs=1e-12)


def test_predicted_normal_loss_trains_the_prediction_alone() -> None:
    _, weights = _histogram(4, 6, seed=6)
    weights.requires_grad_()
    normals, predicted = _normals(2).requires_grad_(), _normals(3).requires_grad_()
    predicted_normal_loss(weights, normals, predicted).backward()
    assert weights.grad is None
    assert normals.grad is None
    assert predicted.grad is not None
    expected = -weights.detach()[..., None] * normals.detach() / 4.0
    assert torch.allclose(predicted.grad, expected, atol=1e-15)


def test_termination_loss_equals_the_loop_and_leaves_unknown_rays_alone() -> None:
    edges, weights = _histogram(6, 9, seed=4)
    t_edges = 0.5 + 3.0 * edges
    distances = torch.tensor([1.0, 0.0, 2.5, 3.4, 0.0, 0.7], dtype=torch.float64)
    total = 0.0
    for ray in (0, 2, 3, 5):
        near = 0.0
        for i in range(9):
            middle = float(t_edges[ray, i] + t_edges[ray, i + 1]) / 2
            off = (middle - float(distances[ray])) / (0.1 * float(distances[ray]))
            near += float(weights[ray, i]) * math.exp(-0.5 * off**2)
        total -= math.log(near + 0.01)
    loss = termination_loss(weights.requires_grad_(), t_edges, distances, 0.1)
    assert float(loss.detach()) == pytest.approx(total / 4, rel=1e-12)
    (gradient,) = torch.autograd.grad(loss, weights)
    assert not gradient[[1, 4]].any()
    assert (gradient[[0, 2, 3, 5]] <= 0).all()
    assert torch.autograd.gradcheck(
        lambda w, t: termination_loss(w, t, distances, 0.3),
        (weights, t_edges.clone().requires_grad_()),
    )


def test_termination_loss_of_the_sky_asks_for_the_light_that_goes_through() -> None:
    edges, weights = _histogram(3, 9, seed=4)
    weights = (weights * torch.tensor([[0.3], [1.0], [0.6]], dtype=torch.float64)).requires_grad_()
    t_edges = 0.5 + 3.0 * edges
    distances = torch.tensor([torch.inf, torch.inf, 0.0], dtype=torch.float64)
    loss = termination_loss(weights, t_edges, distances, 0.1)
    wanted = -(math.log(0.7 + 0.01) + math.log(0.01)) / 2
    assert float(loss.detach()) == pytest.approx(wanted, rel=1e-9)
    (gradient,) = torch.autograd.grad(loss, weights)
    assert torch.isfinite(gradient).all()
    # Light is to go through all of the ray, wherever it ends now.
    assert (gradient[0] > 0).all()
    assert torch.allclose(gradient[0], gradient[0, :1])
    assert not gradient[2].any()


def test_termination_loss_of_rays_without_any_depth_is_nothing() -> None:
    edges, weights = _histogram(3, 4, seed=5)
    weights.requires_grad_()
    loss = termination_loss(weights, edges, torch.zeros(3, dtype=torch.float64), 0.1)
    assert float(loss.detach()) == 0.0
    (gradient,) = torch.autograd.grad(loss, weights)
    assert not gradient.any()


PER_LINE = 4


def _lines(count: int, spacing: tuple[float, ...], seed: int) -> torch.Tensor:
    """[4 count, 2], places in a picture at z = 1: on lines, `spacing` along each."""
    random = torch.Generator().manual_seed(seed)
    middle, step = torch.rand(2, count, 2, generator=random, dtype=torch.float64) - 0.5
    return torch.cat([middle + along * step for along in spacing])


def _on_surface(
    places: torch.Tensor, inverse: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weights, edges and local rays that end where 1 / z is `inverse`, all light in one sample."""
    local = torch.cat([places, -torch.ones_like(places[:, :1])], dim=-1)
    length = local.norm(dim=-1, keepdim=True)
    distance = length[:, 0] / inverse
    edges = torch.stack([0.5 * distance, 0.9 * distance, 1.1 * distance], dim=-1)
    weights = torch.tensor([[0.0, 1.0]], dtype=torch.float64).repeat(len(places), 1)
    return weights, edges, local / length


EVEN, DISTORTED = (-1.0, -1 / 3, 1 / 3, 1.0), (-1.0, -0.4, 0.3, 1.1)


@pytest.mark.parametrize("spacing", [EVEN, DISTORTED], ids=["pinhole", "distorted"])
def test_a_plane_seen_at_a_slant_does_not_bend(spacing: tuple[float, ...]) -> None:
    places = _lines(20, spacing, seed=1)
    inverse = 0.8 + 0.3 * places[:, 0] - 0.2 * places[:, 1]
    given = _on_surface(places, inverse)
    assert float(bend_loss(*given, torch.ones(20), 1.0, 0.02)) < 1e-20


def test_what_bends_evenly_counts_by_its_curve_alone() -> None:
    places = _lines(20, EVEN, seed=2)
    given = _on_surface(places, 0.8 + 0.1 * places.square().sum(dim=-1))
    plain = torch.ones(20)
    assert float(bend_loss(*given, plain, 0.0, 0.02)) < 1e-20
    assert float(bend_loss(*given, plain, 0.5, 0.02)) > 1e-4
    bumpy = _on_surface(places, 0.8 + 0.1 * torch.sin(9.0 * places[:, 0]))
    assert float(bend_loss(*bumpy, plain, 0.0, 0.02)) > 1e-4


def test_bend_loss_equals_the_loop() -> None:
    count = 5
    edges, weights = _histogram(PER_LINE * count, 7, seed=6)
    t_edges = 0.5 + 3.0 * edges
    places = _lines(count, EVEN, seed=3)
    local = torch.nn.functional.normalize(
        torch.cat([places, -torch.ones_like(places[:, :1])], dim=-1), dim=-1
    )
    plain = torch.tensor([1.0, 0.0, 0.3, 0.9, 1.0], dtype=torch.float64)
    limit, curve, total = 0.05, 0.4, 0.0

    def forgiving(off: float) -> float:
        return 0.5 * off**2 / limit / (1.0 + (off / (2.0 * limit)) ** 2)

    for line in range(count):
        q, least = [], math.inf
        for k in range(PER_LINE):
            ray = k * count + line
            middles = (t_edges[ray, 1:] + t_edges[ray, :-1]) / 2
            ended = float(weights[ray].sum())
            q.append(float((weights[ray] / (middles * -local[ray, 2])).sum()) / ended)
            least = min(least, ended)
        one = q[1] - (2 / 3 * q[0] + 1 / 3 * q[3])
        two = q[2] - (1 / 3 * q[0] + 2 / 3 * q[3])
        unit = (q[0] + q[3]) / 2
        bends = forgiving(3.0 * (one - two) / unit) + curve * forgiving((one + two) / unit)
        total += float(plain[line]) * least * bends
    loss = bend_loss(weights.requires_grad_(), t_edges, local, plain, curve, limit)
    assert float(loss.detach()) == pytest.approx(total / count, rel=1e-9)
    (gradient,) = torch.autograd.grad(loss, weights)
    by_line = gradient.reshape(PER_LINE, count, -1).abs().sum(dim=(0, 2))
    assert by_line[1] == 0.0
    assert (by_line[[0, 2, 3, 4]] > 0.0).all()


def test_no_light_is_let_through_for_evenness() -> None:
    """A run on white walls once became all transparent: 1 / z of no light is 0, and even."""
    edges, weights = _histogram(PER_LINE * 6, 7, seed=8)
    places = _lines(6, EVEN, seed=5)
    local = torch.nn.functional.normalize(
        torch.cat([places, -torch.ones_like(places[:, :1])], dim=-1), dim=-1
    )
    for scale in (1.0, 1e-3, 1e-9):
        thin = (scale * weights).requires_grad_()
        loss = bend_loss(thin, 0.5 + 3.0 * edges, local, torch.ones(6), 0.4, 0.05)
        (gradient,) = torch.autograd.grad(loss, thin)
        assert gradient.abs().max() < 10.0
        if scale > 1e-6:
            more_or_less = (gradient * thin.detach()).sum(dim=-1).abs()
            assert float(more_or_less.max()) < 1e-12


def test_lines_without_a_length_or_beside_a_fisheyes_plane_have_no_say() -> None:
    places = _lines(3, EVEN, seed=4)
    places[0::3] = places[0]  # the first line is one pixel, four times
    weights, edges, local = _on_surface(places, 0.8 + 0.3 * torch.sin(5.0 * places[:, 0]))
    local[1] = torch.tensor([0.999, 0.0, 0.04], dtype=torch.float64)  # looks backwards
    weights.requires_grad_()
    loss = bend_loss(weights, edges, local, torch.ones(3), 0.2, 0.02)
    (gradient,) = torch.autograd.grad(loss, weights)
    by_line = gradient.isfinite().all() and gradient.reshape(PER_LINE, 3, -1).abs().sum(dim=(0, 2))
    assert by_line[0] == 0.0
    assert by_line[1] == 0.0
    assert by_line[2] > 0.0


def test_a_bump_on_a_plain_wall_is_learnt_away_and_an_edge_is_not() -> None:
    places = _lines(12, EVEN, seed=7)
    local = torch.nn.functional.normalize(
        torch.cat([places, -torch.ones_like(places[:, :1])], dim=-1), dim=-1
    )
    inverse = 0.8 + 0.1 * places[:, 0]
    inner = torch.arange(PER_LINE * 12) // 12 == 1
    edges = torch.linspace(0.4, 3.0, 131, dtype=torch.float64).repeat(len(places), 1)
    middles = (edges[:, 1:] + edges[:, :-1]) / 2

    def learnt(step: float) -> torch.Tensor:
        """How far the inner rays, which were off by `step`, are from the wall in the end."""
        began = inverse * torch.where(inner, 1.0 + step, 1.0)
        distance = 1.0 / (began * -local[:, 2])
        logits = -0.5 * ((middles - distance[:, None]) / 0.04).square()
        moved = logits.clone().requires_grad_()
        adam = torch.optim.Adam([moved], lr=0.05)
        for _ in range(300):
            adam.zero_grad()
            weights = torch.where(inner[:, None], moved, logits).softmax(dim=-1)
            bend_loss(weights, edges, local, torch.ones(12), 0.1, 0.02).backward()
            adam.step()
        with torch.no_grad():
            weights = torch.where(inner[:, None], moved, logits).softmax(dim=-1)
            found = (weights / middles).sum(dim=-1) / -local[:, 2]
        return (found / inverse - 1.0)[inner].abs()

    assert float(learnt(0.01).max()) < 0.004
    assert float(learnt(0.6).min()) > 0.4
