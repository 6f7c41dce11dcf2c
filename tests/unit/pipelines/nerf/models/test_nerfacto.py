"""The fields and the model: formulas, schedules and what training may and may not touch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pipelines.nerf.models.base import StepPlan
from pipelines.nerf.models.nerfacto import (
    Nerfacto,
    proposal_update_interval,
    proposals_due,
)
from pipelines.nerf.networks.fields import MLP, DensityField, NerfactoField, truncated_exp
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.space.harmonics import spherical_harmonics
from pipelines.nerf.space.rays import Rays
from tests.unit.pipelines.nerf.toy_scene import tiny_model

CONFIG = tiny_model()


def _rays(num: int = 20) -> Rays:
    generator = torch.Generator().manual_seed(0)
    return Rays(
        torch.rand(num, 3, generator=generator) - 0.5,
        torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1),
        torch.arange(num) % 4,
    )


def _model(**changes: object) -> Nerfacto:
    torch.manual_seed(0)
    return Nerfacto(replace(CONFIG, **changes), 4)  # type: ignore[arg-type]


def test_truncated_exp_is_exp_with_a_bounded_gradient() -> None:
    logits = torch.tensor([-40.0, -1.0, 2.0, 30.0], requires_grad=True)
    values = truncated_exp(logits)
    assert torch.equal(values, torch.exp(logits))
    values.sum().backward()
    assert logits.grad is not None
    assert torch.equal(logits.grad, torch.exp(logits.detach().clamp(-15, 15)))


def test_mlp_has_relu_between_layers_and_none_behind_the_last() -> None:
    torch.manual_seed(0)
    mlp = MLP(3, 5, 5, 2)
    values = torch.randn(50, 3)
    first, second, last = mlp.layers
    expected = last(torch.relu(second(torch.relu(first(values)))))
    assert torch.allclose(mlp(values), expected, atol=1e-6)
    assert bool((mlp(values) < 0).any())


def test_colour_equals_the_whole_first_layer_on_joined_inputs() -> None:
    field = NerfactoField(CONFIG, 4)
    rays = _rays(6)
    geometry = torch.randn(6, 5, CONFIG.geo_feature_dim)
    codes = field.codes(rays.camera_indices)
    assert codes is not None
    joined = torch.cat(
        [
            spherical_harmonics(rays.directions)[:, None].expand(6, 5, 16),
            geometry,
            codes[:, None].expand(6, 5, -1),
        ],
        dim=-1,
    )
    expected = torch.sigmoid(field.color_mlp(joined))
    assert torch.allclose(field.color(rays.directions, geometry, codes), expected, atol=1e-6)


def test_density_starts_near_its_average_and_ends_at_the_cube_without_contraction() -> None:
    torch.manual_seed(0)
    field = DensityField(CONFIG.proposals[0], contraction="none", average_init_density=0.01)
    density = field(torch.tensor([[0.3, -0.2, 0.9], [1.2, 0.0, 0.0]])).detach()
    assert 0.002 < float(density[0]) < 0.05
    assert float(density[1]) == 0.0


def test_updates_become_rarer_over_the_warm_up() -> None:
    config = NerfactoConfig()  # 5 steps after 5,000
    intervals = [proposal_update_interval(step, config) for step in (0, 1000, 2500, 5000, 9000)]
    assert intervals == [1.0, 1.0, 2.5, 5.0, 5.0]
    assert proposals_due(9, 1, replace(config, proposal_warmup_steps=1))
    assert [proposals_due(6000, since, config) for since in (1, 4, 5)] == [False, False, True]


def test_the_plan_sharpens_the_proposals_and_counts_their_updates() -> None:
    model = _model(anneal_steps=40, anneal_slope=4.0)
    plans = [model.plan_step(step) for step in (0, 20, 40, 400)]
    # b t / ((b - 1) t + 1) with b = 4: 2 / 2.5 half way.
    assert [plan.exponent for plan in plans] == [0.0, pytest.approx(0.8), 1.0, 1.0]
    assert [plan.step for plan in plans] == [0, 20, 40, 400]
    rare = _model(proposal_warmup_steps=1, proposal_update_every=3)
    updates = []
    for step in range(10, 20):
        plan = rare.plan_step(step)
        updates.append(plan.update_proposals)
        rare.finish_step(plan)
    assert updates == [False, False, True] * 3 + [False]


def test_a_share_of_training_rays_sees_the_mean_code_and_the_others_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = _model(appearance_dropout=0.25).train()
    table = model.field.appearance
    assert table is not None
    rays, seen = _rays(4000), []
    color = model.field.color

    def note(directions: torch.Tensor, geometry: torch.Tensor, codes: torch.Tensor) -> torch.Tensor:
        seen.append(codes.detach())
        return color(directions, geometry, codes)

    monkeypatch.setattr(model.field, "color", note)
    with torch.no_grad():
        model(rays, generator=torch.Generator().manual_seed(0))
        model(rays)  # nothing is dropped without random numbers
    own = table.weight.detach()[rays.camera_indices]
    is_own, is_mean = (
        (seen[0] == expected).all(dim=-1) for expected in (own, table.weight.detach().mean(dim=0))
    )
    assert bool((is_own ^ is_mean).all())
    assert float(is_mean.float().mean()) == pytest.approx(0.25, abs=0.03)
    assert torch.equal(seen[1], own)


def test_outputs_are_consistent() -> None:
    model = _model().eval()
    outputs = model(_rays())
    assert [found.shape[1] for found in outputs["weights"]] == [24, 16, 12]
    assert torch.allclose(outputs["accumulation"], outputs["weights"][-1].sum(-1))
    assert bool(((outputs["rgb"] >= 0) & (outputs["rgb"] <= 1)).all())
    for name in ("depth", "expected_depth"):
        assert bool((outputs[name] >= CONFIG.near).all() and (outputs[name] <= CONFIG.far).all())


def test_rendering_is_the_same_each_time_and_training_is_jittered() -> None:
    model = _model().eval()
    assert torch.equal(model(_rays())["rgb"], model(_rays())["rgb"])
    model.train()
    generator = torch.Generator().manual_seed(0)
    first, second = (model(_rays(), generator=generator)["samples"][0].s_edges for _ in range(2))
    assert not torch.equal(first, second)


def test_rendering_uses_the_mean_code_or_the_code_of_one_image() -> None:
    model = _model().eval()
    table = model.field.appearance
    assert table is not None
    mean = model(_rays())["rgb"]
    third = model(_rays(), appearance=2)["rgb"]
    assert not torch.allclose(mean, third)
    with torch.no_grad():
        table.weight.copy_(table.weight.mean(0, keepdim=True).expand_as(table.weight).clone())
    assert torch.allclose(model(_rays())["rgb"], mean, atol=1e-6)
    assert torch.allclose(model(_rays(), appearance=2)["rgb"], mean, atol=1e-6)


def test_camera_corrections_apply_in_training_alone() -> None:
    model = _model()
    before = model.eval()(_rays())["rgb"]
    with torch.no_grad():
        model.cameras_delta.tangent.add_(0.3)
    assert torch.equal(model.eval()(_rays())["rgb"], before)
    assert not torch.allclose(model.train()(_rays())["samples"][-1].s_edges, before.new_zeros(1))
    colors = model.train()(_rays())["rgb"]
    assert not torch.allclose(colors, before, atol=1e-4)


def test_without_an_update_the_proposals_get_no_gradient() -> None:
    model = _model().train()
    truth = torch.rand(20, 3)
    for update in (False, True):
        model.zero_grad(set_to_none=True)
        plan = StepPlan(0, update_proposals=update)
        outputs = model(_rays(), plan=plan)
        losses = model.loss_dict(outputs, truth, plan=plan)
        assert ("interlevel" in losses) is update
        torch.stack(list(losses.values())).sum().backward()
        grads = [parameter.grad for parameter in model.proposals.parameters()]
        assert all((grad is not None) is update for grad in grads)
        assert model.field.grid.table.grad is not None
        assert model.cameras_delta.tangent.grad is not None


def test_a_shared_network_serves_every_round() -> None:
    model = _model(share_proposal_network=True, proposals=CONFIG.proposals[:1])
    assert len(model.proposals) == 1
    assert model.round_networks() == [model.proposals[0]] * 2
    assert model(_rays())["weights"][1].shape == (20, 16)


@pytest.mark.parametrize("background", ["last_sample", "black", "white", "random"])
@pytest.mark.parametrize("contraction", ["linf", "l2", "none"])
def test_every_background_and_contraction_gives_finite_losses(
    background: str, contraction: str
) -> None:
    model = _model(background=background, contraction=contraction, appearance_dim=0).train()
    generator = torch.Generator().manual_seed(0)
    outputs = model(_rays(), plan=model.plan_step(3), generator=generator)
    losses = model.loss_dict(outputs, torch.rand(20, 3))
    assert all(bool(loss.isfinite()) for loss in losses.values())
