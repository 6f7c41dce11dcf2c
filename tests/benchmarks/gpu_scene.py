"""A capture in closed form for the benchmarks of GPUs: no file is read, and its truth is known.

A patterned ball hovers over a patterned floor that ends in the distance, before a sky; cameras
stand on two rings of radius 1 around it and look at its centre. World and scene are the same, +Z
up. Symbols: o and d, origin and unit direction of a ray; t, the distance along it.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.data.images import ImageData, split_indices
from pipelines.nerf.options.train import DataConfig
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.space.rays import Rays
from tests.benchmarks.capture_data import BenchmarkCapture

BALL_RADIUS = 0.35
FLOOR_Z = -0.4
FLOOR_FADES_AT = 6.0
"""The pattern's contrast is halved at this distance, so that it does not alias into noise."""
RING_HEIGHTS = (-0.15, 0.45)
FIELD_OF_VIEW = math.radians(60.0)
BALL_WAVES, FLOOR_WAVES = 9.0, 6.0
PHASES = (0.0, 2.0, 4.0)


def seen_color(rays: Rays) -> Tensor:
    """Colours [R, 3] in [0, 1] of what rays meet first."""
    origins, directions = rays.origins, rays.directions
    phases = torch.tensor(PHASES, device=origins.device)
    across = torch.tensor([[0.0, 0.3, 0.6]], device=origins.device)
    sky = 0.75 - across * directions[:, 2:].clamp_min(0.0) * 0.8
    to_floor = (FLOOR_Z - origins[:, 2]) / directions[:, 2].clamp_max(-1e-6)
    place = origins + to_floor[:, None] * directions
    waves = torch.sin(FLOOR_WAVES * place[:, :1]) * torch.sin(FLOOR_WAVES * place[:, 1:2] + phases)
    contrast = 0.4 / (1.0 + (to_floor / FLOOR_FADES_AT).square())[:, None]
    seen = torch.where(directions[:, 2:] < 0.0, 0.45 + contrast * waves, sky)
    # |o + t d| = radius, the nearer of the two.
    along = (origins * directions).sum(-1)
    root = along.square() - origins.square().sum(-1) + BALL_RADIUS**2
    normal = (origins + (-along - root.clamp_min(0.0).sqrt())[:, None] * directions) / BALL_RADIUS
    shade = 0.6 + 0.4 * normal[:, 2:]
    ball = shade * (0.5 + 0.45 * torch.sin(BALL_WAVES * normal + phases))
    return torch.where((root > 0.0)[:, None], ball, seen).clamp(0.0, 1.0)


def ring_cameras(num: int, width: int, height: int) -> Cameras:
    """Cameras around the ball, each second one on the upper ring."""
    poses = [_pose(2.0 * math.pi * i / num, RING_HEIGHTS[i % 2]) for i in range(num)]
    focal = 0.5 * width / math.tan(0.5 * FIELD_OF_VIEW)
    return Cameras.from_arrays(
        world_from_camera=np.stack(poses),
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[width] * num,
        heights=[height] * num,
        focal=[[focal, focal]] * num,
        principal=[[width / 2, height / 2]] * num,
    )


def ball_capture(num: int, width: int, height: int, device: torch.device) -> BenchmarkCapture:
    """What the cameras see; the colours are worked out on `device`, the pictures are on the CPU."""
    cameras = ring_cameras(num, width, height)
    posed = cameras.to(device)
    pictures = []
    for index in range(num):
        colors = seen_color(posed.image_rays(index)) * 255.0
        pictures.append(colors.round().byte().reshape(height, width, 3).cpu().numpy())
    train, test = split_indices(num, DataConfig())
    return BenchmarkCapture(
        name="a ball in closed form",
        images=ImageData.from_arrays(pictures),
        cameras=cameras,
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        names=[f"{index:04d}" for index in range(num)],
        train=train,
        test=test,
    )


def _pose(angle: float, z: float) -> NDArray[np.float64]:
    """[3, 4], OpenGL, at distance 1 of the ball's centre."""
    eye = np.array([math.cos(angle), math.sin(angle), z])
    eye /= np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], eye)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(eye, right), eye, eye], axis=-1)
