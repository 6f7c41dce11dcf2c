"""Short runs on the analytic ball before its sky, with views that are held out."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.judging.metrics import psnr
from pipelines.nerf.models.base import Model
from pipelines.nerf.options.parts import ModelConfig
from pipelines.nerf.options.train import DataConfig, OptimizerConfig, TrainConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from tests.unit.pipelines.nerf.toy_scene import SIZE, toy_cameras, toy_images

SCENE = SceneTransform((0.0, 0.0, 0.0), 1.0)


def toy_capture(num_views: int) -> tuple[ImageData, Cameras, list[int], list[int]]:
    """(images, cameras, positions learned from, positions held out: every ninth)."""
    cameras = toy_cameras(num_views)
    held_out = list(range(3, num_views, 9))
    learned = [index for index in range(num_views) if index not in held_out]
    return toy_images(cameras), cameras, learned, held_out


def toy_run(method: str, model: ModelConfig, steps: int, *, lr: float) -> TrainConfig:
    """A run on the CPU of 256 rays a step, whose learning rate falls by ten."""
    return TrainConfig(
        method=method,
        max_steps=steps,
        rays_per_step=256,
        device="cpu",
        model=model,
        data=DataConfig(long_side_px=SIZE),
        optimizer=OptimizerConfig(lr=lr, lr_final=0.1 * lr, decay_steps=steps),
    )


def held_out_psnr(
    model: Model, images: ImageData, cameras: Cameras, held_out: Sequence[int]
) -> float:
    """Mean over the held-out views, dB, as the renderer shows them."""
    renderer = Renderer(model, SCENE)
    values = [
        psnr(torch.as_tensor(renderer.render(cameras, index).rgb), images.image(index))
        for index in held_out
    ]
    return sum(values) / len(values)


def same_state(one: Model, other: Model) -> bool:
    """Whether all parameters and buffers are equal, bit by bit."""
    first, second = one.state_dict(), other.state_dict()
    return first.keys() == second.keys() and all(
        torch.equal(first[name], second[name]) for name in first
    )
