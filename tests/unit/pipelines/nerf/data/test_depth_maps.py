"""Depth maps asked by ray, and what they do to a run, on the toy scene with exact depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.nerf.data.depth_maps import DepthMaps, DepthSupervision
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import DepthLossConfig, FlatLossConfig, TrainConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.training.gpu_steps import GpuSteps, StepShape
from pipelines.nerf.training.loop import optimise_once, train
from pipelines.nerf.training.state import initial_state
from tests.unit.pipelines.nerf.toy_scene import (
    SIZE,
    tiny_config,
    toy_cameras,
    toy_color,
    toy_images,
)

CPU = torch.device("cpu")
LENS = (28.0, 28.0, SIZE / 2, SIZE / 2)


def exact_maps(cameras: Cameras, scale: float = 1.0) -> DepthMaps:
    """What a perfect stage `depth` would find of the ball; the sky is unknown."""
    maps = []
    for index in range(len(cameras)):
        rays = cameras.image_rays(index)
        _, distance = toy_color(rays)
        forward = -cameras.scene_from_camera[index, :, 2]
        z = torch.where(distance.isfinite(), distance * (rays.directions @ forward), 0.0)
        maps.append((z / scale).reshape(SIZE, SIZE).numpy())
    return DepthMaps.from_arrays(maps, [LENS] * len(cameras), scale)


@pytest.mark.parametrize("scale", [1.0, 0.25], ids=["scene units", "world units"])
def test_rays_get_the_distance_of_their_own_image(scale: float) -> None:
    cameras = toy_cameras(6)
    maps = exact_maps(cameras, scale)
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(6, (500,), generator=generator)
    pixels = torch.randint(SIZE, (500, 2), generator=generator) + 0.5
    rays = cameras.generate_rays(index, pixels)
    _, truth = toy_color(rays)
    found = maps.distances(rays, cameras)
    assert torch.equal(found > 0, truth.isfinite())
    assert torch.allclose(found[found > 0], truth[found > 0], rtol=1e-4)
    assert (found > 0).sum() > 100


def test_a_map_of_another_size_and_lens_tells_the_same() -> None:
    cameras = toy_cameras(1)
    flat = np.full((10, 20), 2.0, np.float32)  # a wall across the axis, seen by a wide lens
    maps = DepthMaps.from_arrays([flat], [(7.0, 7.0, 10.0, 5.0)], 1.0)
    pixels = torch.tensor([[16.0, 16.0], [30.5, 16.0], [16.0, 1.5], [0.5, 31.5]])
    rays = cameras.generate_rays(torch.zeros(4, dtype=torch.int64), pixels)
    plane = (pixels - 16.0) / 28.0
    expected = 2.0 * (1.0 + plane.square().sum(-1)).sqrt()
    assert torch.allclose(maps.distances(rays, cameras), expected, rtol=1e-5)


def test_nothing_is_known_outside_of_a_map_or_behind_it() -> None:
    cameras = toy_cameras(2)
    small = np.ones((4, 4), np.float32)
    lenses = [(28.0, 28.0, 2.0, 2.0)] * 2
    maps = DepthMaps.from_arrays([small, np.zeros((4, 4), np.float32)], lenses, 1.0)
    pixels = torch.tensor([[0.5, 16.0], [16.0, 16.0], [16.0, 16.0], [17.9, 17.9]])
    rays = cameras.generate_rays(torch.tensor([0, 0, 1, 0]), pixels)
    assert (maps.distances(rays, cameras) > 0).tolist() == [False, True, False, True]
    back = replace(rays, directions=-rays.directions)
    assert not maps.distances(back, cameras).any()


def test_weight_and_spread_go_from_first_to_last() -> None:
    config = DepthLossConfig(
        weight=0.4, weight_final=0.1, spread=0.2, spread_final=0.05, spread_share=0.5
    )
    maps = DepthMaps.from_arrays([np.ones((1, 1), np.float32)], [(1.0, 1.0, 0.0, 0.0)], 1.0)
    told = DepthSupervision(maps, config, 100)
    assert told.schedule(0) == pytest.approx((0.4, 0.2))
    assert told.schedule(25) == pytest.approx((0.325, 0.1))
    assert told.schedule(50) == pytest.approx((0.25, 0.05))
    assert told.schedule(100) == pytest.approx((0.1, 0.05))
    at_once = DepthSupervision(maps, replace(config, spread_share=0.0), 100)
    assert at_once.schedule(0) == pytest.approx((0.4, 0.05))


def depth_error(config: TrainConfig, maps: DepthMaps | None) -> float:
    """Median relative error of the depth that a run learns, seen from a place of its own."""
    cameras = toy_cameras(12)
    model = train(toy_images(cameras), cameras, range(12), config, seed=1, depth=maps)
    seen = Renderer(model, SceneTransform((0.0, 0.0, 0.0), 1.0)).render(toy_cameras(11), 3)
    _, truth = toy_color(toy_cameras(11).image_rays(3))
    found, known = torch.as_tensor(seen.depth).reshape(-1), truth.isfinite()
    return float((found[known] / truth[known] - 1.0).abs().median())


def test_maps_bring_light_to_where_the_surface_is() -> None:
    maps = exact_maps(toy_cameras(12))
    told = tiny_config(max_steps=80, depth=DepthLossConfig(weight=0.05, weight_final=0.05))
    without = depth_error(tiny_config(max_steps=80), None)
    assert depth_error(told, maps) < 0.7 * without


def test_maps_without_weight_change_nothing() -> None:
    unused = tiny_config(max_steps=16, depth=DepthLossConfig(weight=0.0))
    told = replace(unused, depth=DepthLossConfig(weight=0.05))
    maps = exact_maps(toy_cameras(12))
    assert depth_error(unused, maps) == depth_error(unused, None) != depth_error(told, maps)


def test_maps_must_be_those_of_the_training_images() -> None:
    cameras = toy_cameras(6)
    with pytest.raises(NerfError, match="6 depth maps for 5 training images") as caught:
        train(
            toy_images(cameras),
            cameras,
            range(5),
            tiny_config(),
            seed=0,
            depth=exact_maps(cameras),
        )
    assert caught.value.code == "bad_depth_maps"


def test_steps_of_the_gpu_engine_learn_the_same_from_maps() -> None:
    config = tiny_config(
        max_steps=8,
        depth=DepthLossConfig(weight=0.05),
        flat=FlatLossConfig("always", weight=0.05, share=1.0, contrast=1.0, reach=0.3),
    )
    cameras, images = toy_cameras(6), toy_images(toy_cameras(6))
    told = DepthSupervision(exact_maps(cameras), config.depth, config.max_steps)
    shape, found = StepShape(config.rays_per_step, 1, ()), []
    for on_gpu in (False, True):
        state = initial_state(config, 6, 3, CPU)
        state.model.train()
        sampler, losses = PixelSampler(images, range(6), lines=PlainLines.of(config)), []
        steps = GpuSteps(state, sampler, cameras, depth=told)  # on a CPU without graphs
        for _ in range(8):
            if on_gpu:
                steps.run(config, shape, check=False)
                assert steps._step is not None
                done = steps._step.losses()
            else:
                step = optimise_once(state, sampler, cameras, config, shape, depth=told, check=True)
                assert step is not None
                done = step
            losses.append(done.values)
        found.append(losses)
    assert found[0] == found[1]
    assert found[0][-1]["depth"] < found[0][0]["depth"]
    assert found[0][0]["flat"] == 0.0 < found[0][-1]["flat"]
