"""Steps that look where exact depth maps of the toy scene say, among the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pipelines.nerf.data.depth_maps import DepthMaps, DepthSupervision
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.judging.metrics import psnr
from pipelines.nerf.models.base import Model, Outputs, StepPlan
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.train import DepthLossConfig, GuidedConfig, TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.rays import Rays
from pipelines.nerf.training.checkpoint import load_checkpoint
from pipelines.nerf.training.guided_steps import GuidedSteps
from pipelines.nerf.training.loop import TrainProgress, train
from pipelines.nerf.training.state import initial_state
from tests.unit.pipelines.nerf.data.test_depth_maps import LENS, exact_maps
from tests.unit.pipelines.nerf.toy_scene import (
    SIZE,
    tiny_config,
    toy_cameras,
    toy_color,
    toy_images,
    with_model,
)

CPU = torch.device("cpu")
HALF = GuidedConfig(
    share=0.5,
    until=1.0,
    least_known=0.1,
    rays_per_step=512,
    num_free_samples=3,
    num_near_samples=5,
)


def config_with(guided: GuidedConfig, **changes: object) -> TrainConfig:
    config = with_model(tiny_config(**changes), camera_mode="off")
    return replace(config, guided=guided, depth=DepthLossConfig(weight=0.02))


def steps_of(config: TrainConfig, maps: DepthMaps, num_images: int = 6) -> GuidedSteps | None:
    model = initial_state(config, num_images, 0, CPU).model
    return GuidedSteps.of(config, model, DepthSupervision(maps, config.depth, config.max_steps))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.75])
def test_they_are_spread_evenly_and_never_first(share: float) -> None:
    maps = exact_maps(toy_cameras(6))
    guided = steps_of(config_with(replace(HALF, share=share), max_steps=400), maps)
    assert guided is not None
    due = [guided.is_due(step) for step in range(400)]
    assert sum(due) == int(400 * share)
    assert not due[0]
    assert abs(sum(due[:100]) - 100 * share) <= 1


def test_after_a_part_of_the_run_there_are_none() -> None:
    config = config_with(replace(HALF, until=0.6), max_steps=100)
    guided = steps_of(config, exact_maps(toy_cameras(6)))
    assert guided is not None
    due = [step for step in range(100) if guided.is_due(step)]
    assert len(due) == 30
    assert due[-1] == 59
    assert guided.spread(60) == pytest.approx(0.02)


def test_samples_close_in_on_the_surface() -> None:
    guided = steps_of(config_with(HALF, max_steps=100), exact_maps(toy_cameras(6)))
    assert guided is not None
    assert guided.spread(0) == pytest.approx(0.1)
    assert guided.spread(50) == pytest.approx((0.1 * 0.02) ** 0.5)
    assert guided.spread(100) == guided.spread(200) == pytest.approx(0.02)


def test_only_rays_whose_depth_is_known_are_in_them() -> None:
    cameras, config = toy_cameras(6), config_with(HALF)
    guided = steps_of(config, exact_maps(cameras))
    assert guided is not None
    state = initial_state(config, 6, 0, CPU)
    sampler = PixelSampler(toy_images(cameras), range(6))
    found = guided.batch(state, StepPlan(3), sampler, cameras)
    assert found is not None
    plan, rays, colors = found
    truth, distance = toy_color(rays)
    assert distance.isfinite().all()
    assert 50 < len(rays) < 500
    assert torch.allclose(colors, truth, atol=0.01)
    assert plan.samples is not None
    assert plan.step == 3
    edges = plan.samples.t_edges
    assert ((edges[:, 3] < distance) & (distance < edges[:, -1])).all()


def test_there_are_none_without_maps_share_or_a_method_that_takes_them() -> None:
    maps = exact_maps(toy_cameras(6))
    config = config_with(HALF)
    model = initial_state(config, 6, 0, CPU).model
    assert GuidedSteps.of(config, model, None) is None
    assert steps_of(config_with(replace(HALF, share=0.0)), maps) is None
    model.takes_samples = False
    told = DepthSupervision(maps, config.depth, config.max_steps)
    assert GuidedSteps.of(config, model, told) is None


def test_there_are_none_where_the_maps_know_too_little() -> None:
    """Of the ball's pictures the sky is unknown; where it is known to be sky, nothing stands."""
    maps = exact_maps(toy_cameras(6))
    known = maps.known_share
    assert 0.3 < known < 0.9
    enough = config_with(replace(HALF, least_known=known - 0.01))
    assert steps_of(enough, maps) is not None
    too_little = config_with(replace(HALF, least_known=known + 0.01))
    assert steps_of(too_little, maps) is None
    void = replace(maps, z=torch.where(maps.z > 0, maps.z, torch.inf))
    assert void.known_share == pytest.approx(known)


def test_where_nothing_stands_the_step_is_like_the_others() -> None:
    """A depth that is infinite is known, and no place for samples."""
    cameras = toy_cameras(6)
    config = config_with(replace(HALF, least_known=0.0), max_steps=6)
    empty = [np.full((SIZE, SIZE), np.inf, np.float32)] * 6
    maps = DepthMaps.from_arrays(empty, [LENS] * 6, 1.0)
    terms: list[set[str]] = []

    def note(progress: TrainProgress) -> None:
        terms.append(set(progress.losses))

    train(toy_images(cameras), cameras, range(6), config, seed=0, depth=maps, on_progress=note)
    assert terms == [{"rgb", "interlevel", "distortion", "depth"}] * 6


def test_both_engines_shade_given_samples_alike() -> None:
    """Values and gradients; neither asks the proposals."""
    cameras, config = toy_cameras(6), config_with(HALF)
    found: dict[str, tuple[Outputs, list[Tensor | None]]] = {}
    for engine in ("plain", "fast"):
        state = initial_state(config, 6, 0, CPU)
        state.model.set_engine(engine)
        guided = steps_of(config, exact_maps(cameras))
        assert guided is not None
        sampler = PixelSampler(toy_images(cameras), range(6))
        batch = guided.batch(state, StepPlan(3), sampler, cameras)
        assert batch is not None
        plan, rays, colors = batch
        outputs = state.model.train()(rays, plan=plan, generator=state.model_random)
        losses = state.model.loss_dict(outputs, colors, plan=plan)
        assert set(losses) == {"rgb"}
        losses["rgb"].backward()
        assert isinstance(state.model, Nerfacto)
        assert all(item.grad is None for item in state.model.proposals.parameters())
        gradients = [item.grad for item in state.model.field.parameters()]
        found[engine] = (outputs, gradients)
    plain, fast = found["plain"], found["fast"]
    assert torch.allclose(plain[0]["rgb"], fast[0]["rgb"], atol=1e-5)
    assert torch.allclose(plain[0]["weights"][-1], fast[0]["weights"][-1], atol=1e-5)
    assert len(plain[0]["weights"]) == 1
    for one, other in zip(plain[1], fast[1], strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            scale = float(one.abs().max())
            assert torch.allclose(one, other, atol=1e-4 * scale)


def held_out(model: Model, cameras: Cameras, view: int) -> tuple[float, float]:
    """PSNR and median relative error of the depth, of the ball alone, whose depth the maps know."""
    rays: Rays = cameras.image_rays(view)
    truth, distance = toy_color(rays)
    with torch.no_grad():
        shown = model(rays)
    seen = distance.isfinite()
    off = (shown["depth"][seen] / distance[seen] - 1.0).abs().median()
    return psnr(shown["rgb"][seen][None], truth[seen][None]), float(off)


def test_a_short_run_finds_the_surface_sooner_when_half_of_its_steps_know_where_to_look() -> None:
    cameras = toy_cameras(12)
    images, maps, train_views = toy_images(cameras), exact_maps(cameras), range(1, 12)
    rows = torch.arange(1, 12)
    told = DepthMaps(maps.z, maps.starts[rows], maps.sizes[rows], maps.lenses[rows])
    found = []
    for guided in (GuidedConfig(), HALF):
        config = config_with(guided, max_steps=60, rays_per_step=128)
        model = train(images, cameras, train_views, config, seed=0, depth=told)
        found.append(held_out(model, cameras, 0))
    (looking, far), (knowing, near) = found
    assert knowing > looking + 0.5
    assert near < 0.6 * far


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_run_without_them_goes_on_from_a_checkpoint_of_before_there_were_any(
    share: float, tmp_path: Path
) -> None:
    """Such a checkpoint names every option of its run, and has no word of these."""
    cameras, path = toy_cameras(6), tmp_path / "checkpoint.pt"
    config = config_with(GuidedConfig(share=share), max_steps=1)
    images, maps = toy_images(cameras), exact_maps(cameras)
    train(images, cameras, range(6), config, seed=0, depth=maps, checkpoint_path=path)
    assert ("guided" in load_checkpoint(path)["fingerprint"]) == (share > 0.0)


def test_progress_counts_the_rays_that_they_draw() -> None:
    guided = steps_of(config_with(HALF, max_steps=10), exact_maps(toy_cameras(6)))
    assert guided is not None
    assert [guided.num_rays(step, 64) for step in range(4)] == [64, 512, 64, 512]


def test_a_run_that_was_cut_short_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    cameras = toy_cameras(6)
    images, maps = toy_images(cameras), exact_maps(cameras)
    config = config_with(HALF, max_steps=12, checkpoint_seconds=1e4)
    whole = train(images, cameras, range(6), config, seed=0, depth=maps)
    path = tmp_path / "checkpoint.pt"

    class Cut(Exception):
        pass

    def stop(progress: TrainProgress) -> None:
        if progress.step == 8:
            raise Cut

    with pytest.raises(Cut):
        train(
            images,
            cameras,
            range(6),
            config,
            seed=0,
            depth=maps,
            checkpoint_path=path,
            on_progress=stop,
            wants_checkpoint=lambda: True,
        )
    resumed = train(images, cameras, range(6), config, seed=0, depth=maps, checkpoint_path=path)
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)
