"""NeRF: its formulas, that it goes on from a checkpoint, and how well it learns a small scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.nerf import Nerf, NerfField
from pipelines.nerf.options.methods.nerf import NerfConfig
from pipelines.nerf.options.train import TrainConfig, default_train_config, validate
from pipelines.nerf.training.checkpoint import load_model, save_model
from pipelines.nerf.training.loop import train
from tests.unit.pipelines.nerf.models.toy_runs import (
    SCENE,
    held_out_psnr,
    same_state,
    toy_capture,
    toy_run,
)
from tests.unit.pipelines.nerf.toy_scene import toy_cameras

SMALL = NerfConfig(
    near=0.3,
    num_coarse_samples=16,
    num_fine_samples=16,
    position_frequencies=6,
    direction_frequencies=2,
    num_layers=4,
    hidden_dim=64,
)


def _config(steps: int, **changes: object) -> TrainConfig:
    return toy_run("nerf", replace(SMALL, **changes), steps, lr=4e-3)  # type: ignore[arg-type]


def _model(**changes: object) -> Nerf:
    torch.manual_seed(0)
    return Nerf(replace(SMALL, **changes), 3)  # type: ignore[arg-type]


def test_the_defaults_are_the_papers_networks_and_adam() -> None:
    config = default_train_config("nerf")
    validate(config)
    field = NerfField(NerfConfig())
    # 10 and 4 waves of three axes, sine and cosine, and the input itself.
    assert field.position_encoding.num_outputs == 63
    assert field.direction_encoding.num_outputs == 27
    assert [layer.in_features for layer in field.layers] == [63, *[256] * 4, 256 + 63, 256, 256]
    assert field.color_layer.in_features == 256 + 27
    assert field.color_layer.out_features == 128
    # The published model's 595,844 parameters of each MLP.
    assert sum(parameter.numel() for parameter in field.parameters()) == 595_844
    assert (config.optimizer.lr, config.optimizer.lr_final) == (5e-4, 5e-5)


@pytest.mark.parametrize("num_layers", [1, 2, 3, 4])
def test_networks_of_any_depth_work(num_layers: int) -> None:
    field = NerfField(replace(SMALL, num_layers=num_layers))
    density, hidden = field.density(torch.rand(5, 7, 3))
    assert density.shape == (5, 7)
    assert field.color(torch.eye(3)[[0, 1, 2, 0, 1]], hidden).shape == (5, 7, 3)


def test_density_is_positive_and_ends_at_the_cube_without_contraction() -> None:
    points = torch.tensor([[0.2, -0.9, 0.5], [1.2, 0.0, 0.0]])
    bounded, unbounded = NerfField(replace(SMALL, contraction="none")), NerfField(SMALL)
    assert (bounded.density(points)[0] > 0.0).tolist() == [True, False]
    assert bool((unbounded.density(points)[0] > 0.0).all())


def test_colour_depends_on_the_direction_and_density_does_not() -> None:
    model = _model()
    points = torch.rand(2, 1, 3)
    density, hidden = model.fine.density(points)
    assert torch.equal(model.density(points), density)
    along = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert not torch.allclose(model.fine.color(along, hidden), model.fine.color(-along, hidden))


def test_the_fine_samples_hold_the_coarse_ones_and_more() -> None:
    outputs = _model().eval()(toy_cameras(2).image_rays(0))
    coarse, fine = outputs["samples"]
    assert (coarse.num_samples, fine.num_samples) == (16, 32)
    edges = fine.s_edges[0].tolist()
    assert all(min(abs(s - e) for e in edges) < 1e-6 for s in coarse.s_edges[0].tolist())
    assert torch.allclose(outputs["accumulation"], outputs["weights"][1].sum(-1))
    assert "extra" not in outputs


def test_both_networks_learn_in_training() -> None:
    model = _model(camera_mode="so3xr3").train()
    rays = toy_cameras(3).image_rays(1).select(slice(0, 40))
    outputs = model(rays, generator=torch.Generator().manual_seed(0))
    losses = model.loss_dict(outputs, torch.rand(40, 3))
    assert sorted(losses) == ["camera", "coarse", "rgb"]
    torch.stack(list(losses.values())).sum().backward()
    assert all(parameter.grad is not None for parameter in model.parameters())


def test_a_resumed_run_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    images, cameras, learned, _ = toy_capture(8)
    config = _config(9, hidden_dim=16)
    path = tmp_path / "checkpoint.pt"
    whole = train(images, cameras, learned, config, seed=1)
    train(images, cameras, learned, replace(config, max_steps=4), seed=1, checkpoint_path=path)
    resumed = train(images, cameras, learned, config, seed=1, checkpoint_path=path)
    assert same_state(whole, resumed)


def test_a_saved_model_renders_the_same(tmp_path: Path) -> None:
    model = _model().eval()
    save_model(tmp_path / "model.zip", model, SCENE, {})
    loaded = load_model(tmp_path / "model.zip").model
    rays = toy_cameras(2).image_rays(0)
    assert isinstance(loaded, Nerf)
    with torch.no_grad():
        assert torch.equal(model(rays)["rgb"], loaded(rays)["rgb"])


def test_impossible_options_are_refused() -> None:
    for wrong, text in (
        ({"spacing": "disparity", "near": 0.0}, "more than 0"),
        ({"spacing": "zigzag"}, "piecewise, uniform, disparity"),
        ({"contraction": "fold"}, "linf, l2, none"),
        ({"num_layers": 0}, "1 to 32"),
    ):
        with pytest.raises(NerfError, match=text):
            validate(_config(5, **wrong))


def test_held_out_views_of_the_ball_reach_22_db() -> None:
    images, cameras, learned, held_out = toy_capture(40)
    torch.manual_seed(0)
    untrained = Nerf(SMALL, len(learned)).eval()
    assert held_out_psnr(untrained, images, cameras, held_out) < 14.0
    model = train(images, cameras, learned, _config(350), seed=0)
    assert held_out_psnr(model, images, cameras, held_out) >= 22.0
