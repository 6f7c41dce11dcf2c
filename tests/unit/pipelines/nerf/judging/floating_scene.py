"""A scene traced in closed form, with balls of fog planted in it, and a ring of cameras.

An opaque ball at the origin, a ground plane, a far shell around everything, and twelve cameras that
look at the origin. Floaters are balls of radius r whose optical thickness through the middle is
kappa: the chance to end in a chord of length c is 1 - exp(-kappa c / 2r). Everything is in scene
units but where a name says world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.space.cameras import Cameras, SceneTransform

SCENE = SceneTransform(center=(40.0, -7.0, 2.0), scale=0.25)
WIDTH, HEIGHT, FOCAL = 64, 48, 48.0
RING, RISE, NUM = 2.0, 0.6, 12
LN2 = math.log(2.0)
FOG = 1.5
"""Optical thickness of the planted fog: 78 % of the light through the middle stays in it."""


@dataclass
class Scene:
    """Solid balls [K, 4] (x, y, z, radius), the ground, the shell, and fog balls alike."""

    solids: list[tuple[float, float, float, float]] = field(
        default_factory=lambda: [(0.0, 0.0, 0.0, 0.4)]
    )
    floaters: list[tuple[float, float, float, float]] = field(default_factory=list)
    kappa: float = FOG
    ground: float = -0.5
    shell: float = 6.0

    def solid_depth(self, origins: Tensor, ways: Tensor) -> Tensor:
        """Distance to the first solid [R]."""
        down = ways[:, 2].clamp_max(-1e-12)
        depth = torch.where(ways[:, 2] < 0, (self.ground - origins[:, 2]) / down, torch.inf)
        _, leave = chord(origins, ways, (0.0, 0.0, 0.0, self.shell))
        depth = torch.minimum(depth, leave)
        for ball in self.solids:
            enter, leave = chord(origins, ways, ball)
            depth = torch.where((leave > enter) & (enter > 0), torch.minimum(depth, enter), depth)
        return depth

    def fog(self, origins: Tensor, ways: Tensor) -> list[tuple[float, Tensor, Tensor]]:
        """Of each fog ball that a ray meets: thickness per length, where rays enter and leave [R].

        A ray that starts inside enters at 0.
        """
        met = []
        for ball in self.floaters:
            enter, leave = chord(origins, ways, ball)
            if bool((leave > 0.0).any()):
                met.append((self.kappa / (2.0 * ball[3]), enter.clamp_min(0.0), leave))
        return met

    def median_depth(self, origins: Tensor, ways: Tensor) -> Tensor:
        """Where half of the light is gone [R]; bisection, as thickness only grows."""
        depth = self.solid_depth(origins, ways)
        foggy = thickness(self.fog(origins, ways), depth) >= LN2
        fog = self.fog(origins[foggy], ways[foggy])
        low, high = torch.zeros_like(depth[foggy]), depth[foggy]
        for _ in range(30):
            middle = 0.5 * (low + high)
            gone = thickness(fog, middle) >= LN2
            low, high = torch.where(gone, low, middle), torch.where(gone, middle, high)
        depth[foggy] = high
        return depth

    def opacity_before(self, origins: Tensor, ways: Tensor, t: float) -> Tensor:
        """Chance to end before t [R]."""
        upto = torch.full_like(origins[:, 0], t)
        fog = -torch.expm1(-thickness(self.fog(origins, ways), upto))
        return torch.where(self.solid_depth(origins, ways) < t, torch.ones_like(fog), fog)

    def render_rays(self, origins: Tensor, ways: Tensor) -> Picture:
        """As a renderer does: world units."""
        depth = self.median_depth(origins.double(), ways.double()) / SCENE.scale
        shown = depth.numpy().astype(np.float32)
        return Picture(depth=shown, accumulation=np.ones_like(shown))


@dataclass
class Picture:
    depth: np.ndarray
    accumulation: np.ndarray


def thickness(fog: list[tuple[float, Tensor, Tensor]], upto: Tensor) -> Tensor:
    """Optical thickness between 0 and `upto` along each ray [R] of what `Scene.fog` finds."""
    total = torch.zeros_like(upto)
    for per_length, enter, leave in fog:
        total += per_length * (torch.minimum(leave, upto) - enter).clamp_min(0.0)
    return total


def chord(origins: Tensor, ways: Tensor, ball: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a ball; leave < enter where they miss it."""
    toward = torch.tensor(ball[:3], dtype=origins.dtype) - origins
    along = (toward * ways).sum(-1)
    square = ball[3] ** 2 - (toward.square().sum(-1) - along.square())
    half = square.clamp_min(0.0).sqrt()
    missed = square <= 0.0
    return torch.where(missed, torch.inf, along - half), torch.where(
        missed, -torch.inf, along + half
    )


def look_at(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, place], axis=1)


def cameras_of(poses: list[np.ndarray], focal: float = FOCAL) -> Cameras:
    """Cameras from poses in scene units."""
    world = np.stack(poses)
    world[:, :, 3] = SCENE.world_from_scene(world[:, :, 3])
    num = len(poses)
    return Cameras.from_arrays(
        world_from_camera=world,
        scene=SCENE,
        widths=[WIDTH] * num,
        heights=[HEIGHT] * num,
        focal=[[focal, focal]] * num,
        principal=[[WIDTH / 2, HEIGHT / 2]] * num,
    )


def ring_places() -> list[np.ndarray]:
    angles = 2.0 * np.pi * np.arange(NUM) / NUM
    return [np.array([RING * np.cos(a), RING * np.sin(a), RISE]) for a in angles]


def planted(radius: float, ahead: float = 0.45) -> list[tuple[float, float, float, float]]:
    """One floater on the axis of each camera of the ring."""
    balls = []
    for place in ring_places():
        x, y, z = place * (1.0 - ahead / np.linalg.norm(place))
        balls.append((float(x), float(y), float(z), radius))
    return balls


def ring_cameras() -> Cameras:
    return cameras_of([look_at(place, np.zeros(3)) for place in ring_places()])
