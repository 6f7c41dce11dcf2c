"""Normals of analytic densities, near and far, and the network that predicts them."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.networks.normals import (
    PredictedNormals,
    density_normals,
    normals_from_density_gradient,
    normals_of_logits,
)
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.contraction import scene_from_unit, unit_from_scene

SLOPE = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
FAR_POINTS = torch.tensor(
    [[0.2, 0.1, -0.4], [5.0, -2.0, 1.0], [-0.3, 40.0, 25.0], [90.0, 89.0, -300.0]],
    dtype=torch.float64,
)


def _as_field(
    logit_of_scene: Callable[[torch.Tensor], torch.Tensor], contraction: str
) -> Callable[[torch.Tensor], torch.Tensor]:
    """The same logit, asked as a field asks its grid: in unit space."""

    def density(points: torch.Tensor) -> torch.Tensor:
        unit, _ = unit_from_scene(points, contraction)
        return logit_of_scene(scene_from_unit(unit, contraction))

    return density


def _sphere(points: torch.Tensor) -> torch.Tensor:
    return -7.0 * (points.square().sum(-1).sqrt() - 2.0)


def _plane(points: torch.Tensor) -> torch.Tensor:
    return -4.0 * (points @ SLOPE)


def test_a_normal_points_against_the_gradient() -> None:
    found = normals_from_density_gradient(torch.tensor([[0.0, -2.0, 0.0], [0.0, 0.0, 0.0]]))
    assert torch.equal(found, torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("contraction", ["linf", "l2"])
def test_normals_of_a_sphere_are_radial_near_and_far(contraction: str) -> None:
    found = density_normals(_as_field(_sphere, contraction), FAR_POINTS, False)
    expected = FAR_POINTS / FAR_POINTS.norm(dim=-1, keepdim=True)
    assert torch.allclose(found, expected, atol=1e-9)
    assert not found.requires_grad


@pytest.mark.parametrize("contraction", ["linf", "l2"])
def test_normals_of_a_plane_are_the_same_everywhere(contraction: str) -> None:
    found = density_normals(_as_field(_plane, contraction), FAR_POINTS, False)
    assert torch.allclose(found, (SLOPE / SLOPE.norm()).expand(4, 3), atol=1e-9)


def test_normals_in_contracted_space_would_be_tilted_outside_the_cube() -> None:
    # At x = (m, 0, 0) the contraction's Jacobian is diag(1, 2 m - 1, 2 m - 1) / m^2.
    m = 10.0
    point = torch.tensor([[m, 0.0, 0.0]], dtype=torch.float64)
    unit = unit_from_scene(point, "linf")[0].requires_grad_()
    (gradient,) = torch.autograd.grad(_plane(scene_from_unit(unit, "linf")).sum(), unit)
    contracted = normals_from_density_gradient(gradient)
    tilted = SLOPE / torch.tensor([1.0, 2.0 * m - 1.0, 2.0 * m - 1.0], dtype=torch.float64)
    assert torch.allclose(contracted[0], tilted / tilted.norm(), atol=1e-9)
    true = density_normals(_as_field(_plane, "linf"), point, False)
    angle = math.degrees(math.acos(float((true * contracted).sum())))
    assert angle > 60.0


def test_the_density_has_the_normals_of_its_logit() -> None:
    near = FAR_POINTS[:1]
    of_density = density_normals(lambda points: torch.exp(_sphere(points)), near, False)
    assert torch.allclose(of_density, density_normals(_sphere, near, False), atol=1e-12)


def test_normals_can_be_had_where_gradients_are_off() -> None:
    expected = FAR_POINTS / FAR_POINTS.norm(dim=-1, keepdim=True)
    with torch.no_grad():
        assert torch.allclose(density_normals(_sphere, FAR_POINTS, False), expected)
    with torch.inference_mode():
        points = FAR_POINTS.clone()
        assert torch.allclose(density_normals(_sphere, points, False), expected)


def test_normals_of_logits_at_hand_leave_their_graph_usable() -> None:
    points = FAR_POINTS.clone().requires_grad_()
    scale = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    logits = scale * _sphere(points)
    normals = normals_of_logits(logits, points, create_graph=False)
    assert torch.equal(normals, density_normals(_sphere, FAR_POINTS, False))
    logits.sum().backward()
    assert scale.grad is not None
    assert torch.allclose(scale.grad, _sphere(FAR_POINTS).sum())


def _random_grid() -> HashGrid:
    torch.manual_seed(0)
    grid = HashGrid(HashGridConfig(num_levels=2, min_res=2, max_res=4, log2_table_size=8))
    grid.table.data.normal_()
    return grid.double()


def test_a_grid_learns_from_a_loss_on_its_normals() -> None:
    # From the normals to the table is a second derivative; points stay away from cell faces.
    grid = _random_grid()
    points = torch.tensor([[0.3, -0.2, 0.6], [4.0, -9.0, 2.5]], dtype=torch.float64)
    mixing = torch.tensor([0.7, -1.1, 0.4, 0.9], dtype=torch.float64)

    def normals_of(table: torch.Tensor) -> torch.Tensor:
        def density(seen: torch.Tensor) -> torch.Tensor:
            unit, _ = unit_from_scene(seen, "linf")
            return torch.func.functional_call(grid, {"table": table}, unit) @ mixing

        return density_normals(density, points, True)

    assert normals_of(grid.table).requires_grad
    assert torch.autograd.gradcheck(normals_of, (grid.table,), fast_mode=True)
    # Central differences of the logit in scene space, an independent way to the same normals.
    step = 1e-6
    for point, normal in zip(points, normals_of(grid.table).detach(), strict=True):
        slopes = []
        for axis in range(3):
            offset = torch.zeros(3, dtype=torch.float64)
            offset[axis] = step
            ends = torch.stack([point + offset, point - offset])
            high, low = (grid(unit_from_scene(ends, "linf")[0]) @ mixing).tolist()
            slopes.append(-(high - low) / (2.0 * step))
        length = math.sqrt(sum(slope**2 for slope in slopes))
        assert normal.tolist() == pytest.approx([slope / length for slope in slopes], abs=1e-6)


def test_a_loss_on_normals_moves_no_points() -> None:
    points = FAR_POINTS.clone().requires_grad_()
    scale = torch.ones(3, dtype=torch.float64, requires_grad=True)
    normals = density_normals(lambda seen: _sphere(seen * scale), points, True)
    normals[:, 0].sum().backward()
    assert points.grad is None
    assert scale.grad is not None
    assert float(scale.grad.abs().sum()) > 0.0


def test_predicted_normals_equal_the_network_by_hand() -> None:
    torch.manual_seed(0)
    head = PredictedNormals(5, hidden_dim=8).double()
    unit = torch.rand(3, 4, 3, dtype=torch.float64)
    geometry = torch.randn(3, 4, 5, dtype=torch.float64)
    found = head(unit, geometry)
    values = unit[1, 2].tolist()
    angles = [2.0 * math.pi * 2.0**k * value for value in values for k in range(2)]
    features = [math.sin(a) for a in angles] + [math.cos(a) for a in angles] + values
    hidden = torch.tensor(features + geometry[1, 2].tolist(), dtype=torch.float64)
    first, second, last = (layer for layer in head.layers if isinstance(layer, torch.nn.Linear))
    hidden = (first.weight @ hidden + first.bias).clamp_min(0.0)
    hidden = (second.weight @ hidden + second.bias).clamp_min(0.0)
    bent = torch.tanh(last.weight @ hidden + last.bias)
    assert torch.allclose(found[1, 2], bent / bent.square().sum().sqrt(), atol=1e-12)
    assert torch.allclose(found.norm(dim=-1), torch.ones(3, 4, dtype=torch.float64))


def test_predicted_normals_have_the_right_gradients() -> None:
    torch.manual_seed(0)
    head = PredictedNormals(2, hidden_dim=6).double()
    unit = torch.rand(3, 3, dtype=torch.float64, requires_grad=True)
    geometry = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(head, (unit, geometry))


def test_predicted_normals_learn_a_sphere_s() -> None:
    torch.manual_seed(0)
    head = PredictedNormals(1, hidden_dim=32)
    optimizer = torch.optim.Adam(head.parameters(), lr=5e-3)
    generator = torch.Generator().manual_seed(1)

    def batch(num: int) -> tuple[torch.Tensor, torch.Tensor]:
        outward = torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1)
        return outward * 0.3 + 0.5, outward

    for _ in range(150):
        unit, outward = batch(256)
        loss = (1.0 - (head(unit, torch.ones(256, 1)) * outward).sum(-1)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    unit, outward = batch(500)
    agreement = (head(unit, torch.ones(500, 1)) * outward).sum(-1).detach()
    assert float(agreement.min()) > math.cos(math.radians(15.0))
