"""Instant-NGP: what is sampled and learned, that it goes on from a checkpoint, and its quality."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.along_ray.occupancy import march
from pipelines.nerf.along_ray.packed import PackedSamples
from pipelines.nerf.along_ray.rendering import composite
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.instant_ngp import InstantNgp, first_rays
from pipelines.nerf.options.methods.instant_ngp import InstantNgpConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import TrainConfig, default_train_config, validate
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.rays import Rays
from pipelines.nerf.training.checkpoint import load_model, save_model
from pipelines.nerf.training.loop import train
from tests.unit.pipelines.nerf.models.toy_runs import (
    SCENE,
    held_out_psnr,
    same_state,
    toy_capture,
    toy_run,
)
from tests.unit.pipelines.nerf.toy_scene import RADIUS, toy_cameras, toy_color

SMALL = InstantNgpConfig(
    near=0.3,
    background="last_sample",
    grid=HashGridConfig(num_levels=6, min_res=8, max_res=64, log2_table_size=13),
    hidden_dim=32,
    hidden_dim_color=32,
    occupancy_resolution=32,
    occupancy_update_every=8,
    occupancy_decay=0.8,
    num_cascades=3,
    num_steps=64,
    cone_angle=1 / 16,
    # Less fog at the start than by default: what few of these views see keeps it.
    average_init_density=0.2,
    max_samples=2**15,
)
Capture = tuple[ImageData, Cameras, list[int], list[int]]


def _config(steps: int, **changes: object) -> TrainConfig:
    model = replace(SMALL, **changes)  # type: ignore[arg-type]
    return toy_run("instant-ngp", model, steps, lr=1e-2)


def _model(**changes: object) -> InstantNgp:
    torch.manual_seed(0)
    return InstantNgp(replace(SMALL, **changes), 3)  # type: ignore[arg-type]


def _rays(num: int = 30) -> Rays:
    generator = torch.Generator().manual_seed(0)
    return Rays(
        torch.rand(num, 3, generator=generator) - 0.5,
        torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1),
        torch.arange(num) % 3,
    )


@pytest.fixture(scope="module")
def capture() -> Capture:
    return toy_capture(40)


@pytest.fixture(scope="module")
def trained(capture: Capture) -> InstantNgp:
    images, cameras, learned, _ = capture
    model = train(images, cameras, learned, _config(600), seed=0)
    assert isinstance(model, InstantNgp)
    return model


def test_the_defaults_are_valid_and_those_of_the_paper() -> None:
    config = default_train_config("instant-ngp")
    validate(config)
    model = config.model
    assert isinstance(model, InstantNgpConfig)
    assert (model.occupancy_resolution, model.occupancy_decay) == (128, 0.95)
    assert (model.occupancy_update_every, model.occupancy_warmup_steps) == (16, 256)
    step = 2.0 * math.sqrt(3.0) / 1024
    grid = InstantNgp(replace(model, occupancy_resolution=8), 1).occupancy
    assert grid.threshold == pytest.approx(0.01 / step, rel=0.01)


def test_colours_are_those_of_the_dense_formulas_on_the_same_steps() -> None:
    model = _model(alpha_threshold=0.0, early_stop=0.0, num_cascades=1, cone_angle=0.0).eval()
    rays = Rays(torch.zeros(4, 3), _rays(4).directions, torch.zeros(4, dtype=torch.int64))
    outputs = model(rays)
    samples = march(rays, model.occupancy, 0.3, 1000.0, model.stride)
    for ray in range(4):
        mine = samples.ray == ray
        edges = torch.cat([samples.t_start[mine], samples.t_end[mine][-1:]])[None]
        points = rays.origins[ray] + samples.t_mid[mine][:, None] * rays.directions[ray]
        density, geometry = model.field.density(points[None])
        colors = model.field.color(rays.directions[ray : ray + 1], geometry, None)
        weights = weights_from_density(density, edges)
        expected = composite(colors, weights, "last_sample")[0]
        assert torch.allclose(outputs["rgb"][ray], expected, atol=1e-5)
        assert torch.allclose(outputs["accumulation"][ray], weights.sum(), atol=1e-5)


def test_light_that_is_left_out_is_little() -> None:
    rays = toy_cameras(2).image_rays(0)
    whole = _model(alpha_threshold=0.0, early_stop=0.0, average_init_density=5.0).eval()
    brief = _model(alpha_threshold=0.0, early_stop=1e-3, average_init_density=5.0).eval()
    with torch.no_grad():
        difference = whole(rays)["accumulation"] - brief(rays)["accumulation"]
    assert bool((difference >= -1e-6).all())
    assert 0.0 < float(difference.max()) <= 1e-3 + 1e-6


def test_samples_that_stop_little_light_are_left_out() -> None:
    model = _model(average_init_density=1.0)
    samples = march(_rays(), model.occupancy, 0.3, 1000.0, model.stride)
    assert len(model._seen(_rays(), samples)) == len(samples)  # nothing is known of the mean yet
    model.occupancy.mean_density.fill_(100.0)
    seen = model._seen(_rays(), samples)
    alpha = 1.0 - torch.exp(-model.density(samples.positions(_rays())) * samples.lengths)
    light = samples.select(alpha >= SMALL.alpha_threshold)
    assert 0 < len(seen) <= len(light) <= len(samples)


def test_whole_rays_are_kept_up_to_the_bound() -> None:
    ray = torch.tensor([0, 0, 1, 1, 1, 3, 3])
    start = torch.arange(7.0)
    samples = PackedSamples(ray, start, start + 1.0, 4)
    for most, kept in ((7, 4), (6, 3), (5, 3), (4, 1), (1, 1)):
        part, mask = first_rays(samples, most)
        assert mask.tolist() == [index < kept for index in range(4)]
        assert part.ray.tolist() == [index for index in ray.tolist() if index < kept]


def test_rays_beyond_the_bound_do_not_count_in_the_loss() -> None:
    model = _model(max_samples=256).train()
    outputs = model(_rays(), generator=torch.Generator().manual_seed(0))
    kept = outputs["extra"]["kept"]
    assert 0 < int(kept.sum()) < 30
    truth = torch.rand(30, 3)
    loss = model.loss_dict(outputs, truth)["rgb"]
    expected = (outputs["rgb"] - truth)[kept].square().mean()
    assert torch.allclose(loss, expected)
    changed = torch.where(kept[:, None], truth, 1.0 - truth)
    assert torch.equal(model.loss_dict(outputs, changed)["rgb"], loss)


def test_an_empty_grid_shows_the_background_and_training_goes_on() -> None:
    model = _model(background="white").train()
    model.occupancy.occupied.fill_(False)
    outputs = model(_rays(), generator=torch.Generator().manual_seed(0))
    assert torch.equal(outputs["rgb"], torch.ones(30, 3))
    model.loss_dict(outputs, torch.zeros(30, 3))["rgb"].backward()
    gradient = model.field.grid.table.grad
    assert gradient is not None
    assert float(gradient.abs().sum()) == 0.0
    with torch.no_grad():
        seen = model.eval()(_rays())
    assert float(seen["accumulation"].sum()) == 0.0
    assert set(seen["depth"].tolist()) == {SMALL.far}


def test_density_is_nothing_where_rays_do_not_look() -> None:
    model = _model(contraction="none", num_cascades=2)
    points = torch.tensor([[0.5, 0.5, 0.5], [1.9, 0.0, 0.0], [2.1, 0.0, 0.0]])
    assert (model.density(points) > 0.0).tolist() == [True, True, False]
    model.occupancy.occupied.fill_(False)
    assert not bool(model.density(points).any())


def test_the_grid_is_updated_when_due() -> None:
    model = _model(occupancy_update_every=4, occupancy_warmup_steps=8)
    calls: list[tuple[int, bool]] = []

    def record(density: object, *, everywhere: bool, generator: object) -> None:
        calls.append((step, everywhere))

    model.occupancy.update = record  # type: ignore[method-assign,assignment]
    generator = torch.Generator().manual_seed(0)
    for step in range(14):
        model.plan_step(step, generator)
    assert calls == [(0, True), (4, True), (8, False), (12, False)]


def test_camera_corrections_learn() -> None:
    model = _model(camera_mode="so3xr3").train()
    with torch.no_grad():  # a grid of one value has no slope
        model.field.grid.table.uniform_(-1.0, 1.0)
    outputs = model(_rays(), generator=torch.Generator().manual_seed(0))
    losses = model.loss_dict(outputs, torch.rand(30, 3))
    assert sorted(losses) == ["camera", "rgb"]
    torch.stack(list(losses.values())).sum().backward()
    gradient: Tensor | None = model.cameras_delta.tangent.grad
    assert gradient is not None
    assert float(gradient.abs().sum()) > 0.0


def test_a_resumed_run_ends_as_an_uninterrupted_one(capture: Capture, tmp_path: Path) -> None:
    images, cameras, learned, _ = capture
    config = _config(
        24, background="random", occupancy_update_every=2, occupancy_warmup_steps=6, num_cascades=2
    )
    path = tmp_path / "checkpoint.pt"
    whole = train(images, cameras, learned, config, seed=1)
    train(images, cameras, learned, replace(config, max_steps=11), seed=1, checkpoint_path=path)
    resumed = train(images, cameras, learned, config, seed=1, checkpoint_path=path)
    assert same_state(whole, resumed)
    assert isinstance(whole, InstantNgp)
    assert not bool(whole.occupancy.occupied.all())


def test_a_saved_model_renders_the_same(trained: InstantNgp, tmp_path: Path) -> None:
    save_model(tmp_path / "model.zip", trained, SCENE, {})
    loaded = load_model(tmp_path / "model.zip").model
    assert isinstance(loaded, InstantNgp)
    assert torch.equal(loaded.occupancy.occupied, trained.occupancy.occupied)
    rays = toy_cameras(2).image_rays(0)
    with torch.no_grad():
        assert torch.allclose(trained(rays)["rgb"], loaded(rays)["rgb"], atol=1e-5)


def test_held_out_views_of_the_ball_reach_22_db(capture: Capture, trained: InstantNgp) -> None:
    images, cameras, learned, held_out = capture
    torch.manual_seed(0)
    untrained = InstantNgp(SMALL, len(learned)).eval()
    assert held_out_psnr(untrained, images, cameras, held_out) < 14.0
    assert held_out_psnr(trained, images, cameras, held_out) >= 22.0


def test_the_depth_of_the_ball_is_found(capture: Capture, trained: InstantNgp) -> None:
    rays = capture[1].image_rays(capture[3][1])
    _, truth = toy_color(rays)
    with torch.no_grad():
        depth = trained(rays)["depth"]
    hit = truth.isfinite()
    assert float((depth - truth)[hit].abs().median()) < 0.2 * RADIUS


def test_empty_space_is_left_out_after_training(trained: InstantNgp) -> None:
    assert float(trained.occupancy.occupied[0].float().mean()) < 0.9


def test_impossible_options_are_refused() -> None:
    grid = HashGridConfig(min_res=64, max_res=16)
    for wrong, text in (
        ({"grid": grid}, "at least min_res"),
        ({"num_cascades": 0}, "1 to 10"),
        ({"background": "pink"}, "last_sample, black, white, random"),
    ):
        with pytest.raises(NerfError, match=text):
            validate(_config(5, **wrong))


def test_rays_of_a_step_follow_the_samples_that_they_have() -> None:
    model = _model(samples_per_step=4000).train()
    assert model.rays_of_step(256) == 256  # nothing is known yet
    generator = torch.Generator().manual_seed(0)
    found = []
    for step in range(12):
        num_rays = model.rays_of_step(256)
        assert num_rays % 16 == 0
        plan = model.plan_step(step, generator)
        rays = _rays(num_rays)
        outputs = model(rays, plan=plan, generator=generator)
        assert int(outputs["extra"]["kept"].sum()) == num_rays
        model.finish_step(plan)
        found.append(num_rays)
    # The field stands still, so that a ray's samples do too, but for those the jitter moves.
    assert model.samples_per_ray * found[-1] == pytest.approx(4000, rel=0.1)
    assert model.rays_of_step(256) == pytest.approx(4000 / model.samples_per_ray, abs=8.5)
    assert _model().rays_of_step(256) == 256


def test_rays_of_a_step_are_bounded() -> None:
    model = _model(samples_per_step=4000)
    model.load_schedule_state({"samples_per_ray": 1e-3})
    assert model.rays_of_step(256) == 16 * 256
    model.load_schedule_state({"samples_per_ray": 1e9})
    assert model.rays_of_step(256) == 16


def test_a_resumed_run_has_the_rays_of_an_uninterrupted_one(
    capture: Capture, tmp_path: Path
) -> None:
    images, cameras, learned, _ = capture
    config = _config(14, samples_per_step=3000, occupancy_update_every=2)
    path = tmp_path / "checkpoint.pt"
    whole = train(images, cameras, learned, config, seed=1)
    train(images, cameras, learned, replace(config, max_steps=6), seed=1, checkpoint_path=path)
    resumed = train(images, cameras, learned, config, seed=1, checkpoint_path=path)
    assert same_state(whole, resumed)
    assert isinstance(whole, InstantNgp)
    assert isinstance(resumed, InstantNgp)
    assert whole.samples_per_ray == resumed.samples_per_ray > 0.0
