"""Contractions against their inverses, their bounds and their definition."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.contraction import (
    contract_l2,
    contract_linf,
    scene_from_unit,
    uncontract_l2,
    uncontract_linf,
    unit_from_scene,
)

PAIRS = ((contract_linf, uncontract_linf), (contract_l2, uncontract_l2))


def _points() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    return directions * torch.logspace(-2, 3, 500, dtype=torch.float64)[:, None]


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
    assert torch.equal(origin.grad, torch.ones(1, 3))
