"""The analytic scene of `pipelines.sample`, small enough to learn within a minute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pipelines.nerf.cameras import Cameras, SceneTransform
from pipelines.nerf.data import ImageData
from pipelines.nerf.metrics import psnr
from pipelines.nerf.models.base import Model
from pipelines.nerf.renderer import Renderer
from pipelines.sample.film import phone_camera, render_all, walk

LONG_SIDE = 64
NUM_VIEWS = 32
HELD_OUT = (4, 12, 20, 28)


@dataclass(frozen=True)
class AnalyticScene:
    """Images and cameras of a walk through the scene; `train`, `test`: positions."""

    images: ImageData
    cameras: Cameras
    scene: SceneTransform
    train: list[int]
    test: list[int]


def analytic_scene() -> AnalyticScene:
    """32 upright views of 36x64 pixels, four of them held out."""
    camera = phone_camera(LONG_SIDE)
    truth = walk(NUM_VIEWS, camera)
    poses = np.array([image.world_from_camera for image in truth.images])
    scene = SceneTransform.fit(poses[:, :, 3])
    cameras = Cameras.from_arrays(
        world_from_camera=poses,
        scene=scene,
        widths=[camera.width] * NUM_VIEWS,
        heights=[camera.height] * NUM_VIEWS,
        focal=[[camera.fl_x, camera.fl_y]] * NUM_VIEWS,
        principal=[[camera.cx, camera.cy]] * NUM_VIEWS,
    )
    images = ImageData.from_arrays(list(render_all(truth, 1)))
    train = [index for index in range(NUM_VIEWS) if index not in HELD_OUT]
    return AnalyticScene(images, cameras, scene, train, list(HELD_OUT))


def held_out_psnr(model: Model, scene: AnalyticScene) -> float:
    """Mean over the held-out views, dB."""
    renderer = Renderer(model, scene.scene, engine="plain")
    values = [
        psnr(torch.as_tensor(renderer.render(scene.cameras, index).rgb), scene.images.image(index))
        for index in scene.test
    ]
    return sum(values) / len(values)
