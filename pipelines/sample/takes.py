"""A take: a scene, the way of a hand-held camera through it, and its exposure along that way.

Progress runs from 0 at the first frame to 1 at the last, so that fewer frames film the same take.
Poses are world_from_camera [3, 4], OpenGL axes, in the scene's world.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipelines.sample.scene import Floats, Scene


def steady(progress: float) -> float:
    """An exposure that does not change."""
    del progress
    return 1.0


@dataclass(frozen=True)
class Take:
    """pose: progress to world_from_camera. gain: progress to the factor on linear light."""

    scene: Scene
    pose: Callable[[float], Floats]
    gain: Callable[[float], float] = steady


def sway(time: float, seed: float, *periods: float) -> float:
    """A smooth unsteadiness in [-1, 1]: a few sines whose periods do not match."""
    waves = [math.sin(2 * math.pi * time / p + seed * (i + 1)) for i, p in enumerate(periods)]
    return sum(waves) / len(waves)


def looking_at(eye: Floats, target: Floats, roll: float) -> Floats:
    """world_from_camera [3, 4] of a camera at `eye` [3] that looks at `target` [3].

    roll: radians about the gaze, 0 for a level horizon.
    """
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    level = np.cross(forward, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    above = np.cross(level, forward)
    right = math.cos(roll) * level + math.sin(roll) * above
    return np.stack([right, np.cross(right, forward), -forward, eye], axis=1)
