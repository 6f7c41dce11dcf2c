"""A field that is known everywhere: the ball of `painted_ball` as a model of its own method.

Opaque within the ball, empty around it; its colour changes with the place alone, and is black below
half of the radius, where no short ray should get to. A wall of one colour may stand beside it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pipelines.exports.mesh import Floats
from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.along_ray.rendering import accumulation, composite, expected_depth, median_depth
from pipelines.nerf.models.base import Appearance, Model, Outputs, StepPlan
from pipelines.nerf.options.parts import ModelConfig
from pipelines.nerf.space.cameras import SceneTransform
from pipelines.nerf.space.rays import Rays, RaySamples
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.trained_scene import TrainedScene
from tests.unit.pipelines.exports.texture.painted_ball import CENTER, LENS, all_round

SCALE = 0.4
_SAMPLES = 48
_DENSITY = 2000.0
WALL = (0.9, 0.1, 0.1)


class GlowingBall(Model):
    """The model. wall: whether there is one, beyond x = 1.2. radius: of the ball."""

    method = "glowing_ball"

    def __init__(self, wall: bool = False, radius: float = 1.0) -> None:
        super().__init__(ModelConfig(camera_mode="off"), 1)
        self.config = ModelConfig(camera_mode="off")
        self.anything = torch.nn.Parameter(torch.zeros(1))
        self.wall, self.radius = wall, radius

    def density(self, points: Tensor) -> Tensor:
        away = points / SCALE  # the scene's origin is the ball's middle
        inside = away.norm(dim=-1) <= self.radius
        if self.wall:
            inside = inside | (away[..., 0] >= 1.2)
        return _DENSITY * inside

    def colors(self, points: Tensor) -> Tensor:
        x, y, z = (points / SCALE).unbind(dim=-1)
        rgb = torch.stack([0.5 + 0.3 * torch.sin(18.0 * z), 0.5 + 0.3 * x, 0.5 + 0.3 * y], dim=-1)
        rgb = rgb * (torch.stack([x, y, z], dim=-1).norm(dim=-1, keepdim=True) > 0.5)
        return torch.where(x[..., None] >= 1.2, torch.tensor(WALL), rgb).clamp(0.0, 1.0)

    def forward(
        self,
        rays: Rays,
        *,
        plan: StepPlan | None = None,
        appearance: Appearance = None,
        generator: torch.Generator | None = None,
    ) -> Outputs:
        edges = torch.linspace(self.config.near, self.config.far, _SAMPLES + 1)
        edges = edges.expand(len(rays), -1)
        samples = RaySamples(edges, edges)
        points = samples.positions(rays)
        weights = weights_from_density(self.density(points), edges)
        return Outputs(
            rgb=composite(self.colors(points), weights, self.config.background),
            accumulation=accumulation(weights),
            depth=median_depth(weights, edges),
            expected_depth=expected_depth(weights, edges),
            weights=[],
            samples=[],
        )

    def loss_dict(
        self, outputs: Outputs, truth: Tensor, *, plan: StepPlan | None = None
    ) -> dict[str, Tensor]:
        return {"rgb": (outputs["rgb"] - truth).square().mean()}


def scene_of(model: Model, num: int = 12) -> TrainedScene:
    """The model as a trained scene, with cameras all round it."""
    poses = all_round(num)
    images = tuple(
        PosedImage(
            f"{index:02d}.png", 0, tuple(tuple(map(float, row)) for row in pose), split="train"
        )
        for index, pose in enumerate(poses)
    )
    cameras = CamerasFile(cameras=(LENS,), images=images, metric=False)
    x, y, z = CENTER.tolist()
    return TrainedScene(model, SceneTransform((x, y, z), SCALE), cameras, {})


def on_ball(points: Floats, radius: float = 1.0) -> Floats:
    """The places of the ball that are nearest to points [N, 3]."""
    away = points - CENTER
    return CENTER + radius * away / np.linalg.norm(away, axis=1, keepdims=True)
