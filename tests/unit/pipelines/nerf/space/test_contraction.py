"""Contractions against their inverses, their bounds and their definition."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.space.contraction import (
    CONTRACTIONS,
    contract_gaussian,
    contract_l2,
    contract_linf,
    contract_none,
    scene_from_unit,
    uncontract_l2,
    uncontract_linf,
    unit_from_scene,
    unit_gaussians,
)
from pipelines.nerf.space.frustums import Gaussians

CONTRACT = {"linf": contract_linf, "l2": contract_l2, "none": contract_none}
PAIRS = ((contract_linf, uncontract_linf), (contract_l2, uncontract_l2))


def _points() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    return directions * torch.logspace(-2, 3, 500, dtype=torch.float64)[:, None]


def _gaussians() -> Gaussians:
    """Inside, outside, far out, and on both sides of the border of either norm."""
    points = _points()[::10]
    rim = points[:20]
    borders = [
        rim / norm * (1.0 + side)
        for norm in (rim.abs().amax(-1, keepdim=True), rim.norm(dim=-1, keepdim=True))
        for side in (-1e-7, 0.0, 1e-7)
    ]
    mean = torch.cat([points, *borders])
    generator = torch.Generator().manual_seed(1)
    root = torch.randn(len(mean), 3, 3, generator=generator, dtype=torch.float64)
    return Gaussians(mean, root @ root.transpose(1, 2))


@pytest.mark.parametrize(("contract", "uncontract"), PAIRS)
def test_inverse_gives_the_points_back(contract, uncontract) -> None:  # type: ignore[no-untyped-def]
    points = _points()
    assert torch.allclose(uncontract(contract(points)), points, rtol=1e-9)


def test_linf_follows_its_formula_outside_the_cube() -> None:
    point = torch.tensor([4.0, -2.0, 0.5], dtype=torch.float64)
    expected = (2.0 - 1.0 / 4.0) * point / 4.0
    assert torch.allclose(contract_linf(point), expected)


def test_l2_follows_its_formula_outside_the_ball() -> None:
    point = torch.tensor([3.0, 4.0, 0.0], dtype=torch.float64)
    assert torch.allclose(contract_l2(point), (2.0 - 1.0 / 5.0) * point / 5.0)


def test_points_near_the_origin_stay() -> None:
    points = _points()
    inner = points[points.norm(dim=-1) < 0.99]
    assert torch.equal(contract_linf(inner), inner)
    assert torch.allclose(contract_l2(inner), inner)


def test_far_float32_points_stay_inside_the_open_unit_cube() -> None:
    far = torch.tensor([[1e6, -1e6, 5e5], [1e6, 0.0, 0.0]])
    for contraction in ("linf", "l2"):
        unit, inside = unit_from_scene(far, contraction)
        assert inside is None
        assert bool(((unit > 0) & (unit < 1)).all())


def test_without_contraction_points_outside_the_cube_are_marked() -> None:
    unit, inside = unit_from_scene(torch.tensor([[0.5, 0.0, -0.5], [1.5, 0.0, 0.0]]), "none")
    assert inside is not None
    assert inside.tolist() == [True, False]
    assert torch.allclose(unit[0], torch.tensor([0.75, 0.5, 0.25]))


@pytest.mark.parametrize("contraction", ["linf", "l2", "none"])
def test_scene_from_unit_inverts_unit_from_scene(contraction: str) -> None:
    points = _points()
    unit, _ = unit_from_scene(points, contraction)
    assert torch.allclose(scene_from_unit(unit, contraction), points, rtol=1e-8)


@pytest.mark.parametrize(("contract", "uncontract"), PAIRS)
def test_gradients_are_right_and_finite_at_the_origin(contract, uncontract) -> None:  # type: ignore[no-untyped-def]
    points = _points()[::25].clone().requires_grad_()
    assert torch.autograd.gradcheck(contract, (points,))
    origin = torch.zeros(1, 3, requires_grad=True)
    contract(origin).sum().backward()
    assert origin.grad is not None
    assert torch.equal(origin.grad, torch.ones(1, 3))


@pytest.mark.parametrize("contraction", CONTRACTIONS)
def test_a_gaussian_goes_through_by_the_jacobian_of_the_contraction(contraction: str) -> None:
    gaussians = _gaussians()
    found = contract_gaussian(gaussians, contraction)
    for row, mean in enumerate(gaussians.mean):
        assert torch.allclose(found.mean[row], CONTRACT[contraction](mean), rtol=1e-12)
        jacobian = torch.autograd.functional.jacobian(CONTRACT[contraction], mean)
        expected = jacobian @ gaussians.covariance[row] @ jacobian.T
        # A millionth: within 1e-7 of the border the two pieces' Jacobians differ by that much.
        near_border = torch.isclose(mean.norm(), mean.new_ones(()), atol=1e-6) | torch.isclose(
            mean.abs().amax(), mean.new_ones(()), atol=1e-6
        )
        tolerance = 1e-6 if near_border else 1e-13
        scale = float(expected.abs().max())
        assert float((found.covariance[row] - expected).abs().max()) < tolerance * scale


@pytest.mark.parametrize("contraction", CONTRACTIONS)
def test_a_contracted_covariance_is_symmetric_and_never_negative(contraction: str) -> None:
    covariance = contract_gaussian(_gaussians(), contraction).covariance
    assert torch.allclose(covariance, covariance.transpose(1, 2), rtol=1e-12, atol=0.0)
    values = torch.linalg.eigvalsh(covariance)
    assert bool((values[:, 0] > -1e-12 * values[:, -1]).all())


def test_a_covariance_far_out_along_the_ray_shrinks_with_the_fourth_power() -> None:
    # Along the radius d|z|/d|x| = 1/|x|^2; across it the scale is (2 - 1/|x|) / |x|.
    gaussian = Gaussians(
        torch.tensor([10.0, 0, 0], dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    )
    for contraction in ("linf", "l2"):
        found = contract_gaussian(gaussian, contraction).covariance
        across = (1.9 / 10.0) ** 2
        expected = torch.diag(torch.tensor([1e-4, across, across], dtype=torch.float64))
        assert torch.allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("contraction", CONTRACTIONS)
def test_unit_gaussians_are_scaled_as_unit_points_are(contraction: str) -> None:
    gaussians = Gaussians(_gaussians().mean[:50], _gaussians().covariance[:50])
    found, inside = unit_gaussians(gaussians, contraction)
    unit, unit_inside = unit_from_scene(gaussians.mean, contraction)
    assert torch.allclose(found.mean, unit, rtol=1e-12)
    assert (inside is None) == (unit_inside is None)
    if inside is not None and unit_inside is not None:
        assert torch.equal(inside, unit_inside)
    for row, mean in enumerate(gaussians.mean):
        jacobian = torch.autograd.functional.jacobian(
            lambda point: unit_from_scene(point, contraction)[0], mean
        )
        expected = jacobian @ gaussians.covariance[row] @ jacobian.T
        assert torch.allclose(found.covariance[row], expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("contraction", ["linf", "l2"])
def test_contracted_gaussians_have_the_right_gradient(contraction: str) -> None:
    gaussians = _gaussians()
    mean = gaussians.mean[:50:6].clone().requires_grad_()
    sigma = gaussians.covariance[:50:6].clone().requires_grad_()

    def contracted(mean: torch.Tensor, sigma: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        symmetric = 0.5 * (sigma + sigma.transpose(1, 2))
        found = contract_gaussian(Gaussians(mean, symmetric), contraction)
        return found.mean, found.covariance

    assert torch.autograd.gradcheck(contracted, (mean, sigma))


@pytest.mark.parametrize("contraction", ["linf", "l2"])
def test_a_gaussian_at_the_origin_stays_and_has_finite_gradients(contraction: str) -> None:
    mean = torch.zeros(1, 3, requires_grad=True)
    found = contract_gaussian(Gaussians(mean, torch.eye(3)[None]), contraction)
    assert torch.equal(found.covariance, torch.eye(3)[None])
    (found.mean.sum() + found.covariance.sum()).backward()
    assert mean.grad is not None
    assert bool(mean.grad.isfinite().all())
