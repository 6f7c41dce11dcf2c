"""A coloured ball before a coloured sky, in closed form: training material with exact truth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import DataConfig, OptimizerConfig, TrainConfig
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.space.rays import Rays

RADIUS = 0.5
SIZE = 32


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[3, 4] OpenGL pose at `eye` that looks at `target`, +Z up."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, eye], axis=-1)


def toy_cameras(num: int = 24) -> Cameras:
    """A ring of pinhole cameras around the ball, at two heights."""
    poses = []
    for index in range(num):
        angle = 2.0 * math.pi * index / num
        eye = np.array([math.cos(angle), math.sin(angle), 0.35 if index % 2 else -0.2])
        poses.append(look_at(eye, np.zeros(3)))
    return Cameras.from_arrays(
        world_from_camera=np.stack(poses),
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[SIZE] * num,
        heights=[SIZE] * num,
        focal=[[28.0, 28.0]] * num,
        principal=[[SIZE / 2, SIZE / 2]] * num,
    )


def toy_color(rays: Rays) -> tuple[Tensor, Tensor]:
    """(colours [R, 3], distance [R] to the ball, inf where it is missed)."""
    along = (rays.origins * rays.directions).sum(-1)
    inside = along.square() - rays.origins.square().sum(-1) + RADIUS**2
    distance = torch.where(inside > 0, -along - inside.clamp_min(0).sqrt(), torch.inf)
    normal = (rays.origins + rays.directions * distance.nan_to_num(posinf=0)[:, None]) / RADIUS
    ball = 0.5 + 0.45 * torch.sin(3.0 * normal + torch.tensor([0.0, 2.0, 4.0]))
    sky = torch.stack([0.3 + 0 * along, 0.5 + 0.3 * rays.directions[:, 2], 0.7 + 0 * along], -1)
    return torch.where((inside > 0)[:, None], ball, sky), distance


def toy_images(cameras: Cameras) -> ImageData:
    """What the cameras see, as uint8."""
    images = []
    for index in range(len(cameras)):
        colors, _ = toy_color(cameras.image_rays(index))
        images.append((colors.reshape(SIZE, SIZE, 3) * 255).round().byte().numpy())
    return ImageData.from_arrays(images)


def tiny_model() -> NerfactoConfig:
    """A model small enough for dozens of steps a second."""
    proposal = ProposalConfig(
        grid=HashGridConfig(num_levels=3, min_res=8, max_res=32, log2_table_size=12), hidden_dim=8
    )
    return NerfactoConfig(
        num_proposal_samples=(24, 16),
        num_nerf_samples=12,
        proposals=(proposal, proposal),
        grid=HashGridConfig(num_levels=6, min_res=8, max_res=64, log2_table_size=13),
        hidden_dim=32,
        hidden_dim_color=32,
        appearance_dim=4,
        # What lies right before one camera no other sees: a place for errors to hide in.
        near=0.3,
        # Few steps are not enough to bring matter in from the far end, where 0.01 leaves it.
        average_init_density=1.0,
        anneal_steps=40,
    )


def tiny_config(**changes: object) -> TrainConfig:
    """A whole run of `tiny_model`."""
    values: dict[str, object] = {
        "max_steps": 80,
        "rays_per_step": 256,
        "device": "cpu",
        "engine": "plain",
        "model": tiny_model(),
        "data": DataConfig(long_side_px=SIZE),
        "optimizer": OptimizerConfig(decay_steps=1000),
    }
    return TrainConfig(**{**values, **changes})  # type: ignore[arg-type]


def with_model(config: TrainConfig, **changes: Any) -> TrainConfig:
    """The run with other options of its model."""
    return replace(config, model=replace(config.model, **changes))
