"""Tiny jobs on made data: each launches every kernel that a part of a real job launches.

So whatever kernels those are is compiled, with the types that they have in a job, and nothing here
knows their names. Who compiles them, and when, is in `pipelines.nerf.compiling`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.stereo.maps import find_depth_maps
from pipelines.nerf.stereo.refinement import Pictures, photo_offsets
from pipelines.nerf.stereo.views import StereoView
from pipelines.nerf.training.loop import train

_MOST = {"log2_table_size": 10, "occupancy_resolution": 16, "num_steps": 64, "max_samples": 4096}
"""Options of models that decide sizes only, and what is enough here."""
_SIDE_PX, _NUM_IMAGES, _NUM_RAYS, _NUM_STEPS = 16, 4, 64, 2
_SCENE = SceneTransform((0.0, 0.0, 0.0), 1.0)


def run_part(part: str, config: TrainConfig) -> None:
    """Launch in this process every kernel that the part of a job launches."""
    tiny = _tiny(config)
    cameras, images = made_capture()
    if part == "stereo":
        _find_made_depth()
    elif part == "training":
        train(images, cameras, range(_NUM_IMAGES), tiny, seed=0)
    else:
        model = find_method(tiny.method).build(tiny.model, _NUM_IMAGES).eval()
        Renderer(model, _SCENE, device="cpu").render(cameras, 0)


def _tiny(config: TrainConfig) -> TrainConfig:
    """The run shortened and its tables and grids made small: neither changes a type."""
    return dataclasses.replace(
        config,
        max_steps=_NUM_STEPS,
        max_seconds=0.0,
        rays_per_step=_NUM_RAYS,
        device="cpu",
        model=_small(config.model),
    )


def _small(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_small(item) for item in value)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    changes = {}
    for item in dataclasses.fields(value):
        given = getattr(value, item.name)
        changes[item.name] = min(given, _MOST[item.name]) if item.name in _MOST else _small(given)
    return dataclasses.replace(value, **changes)


def made_capture() -> tuple[Cameras, ImageData]:
    """Grey pictures by cameras on a ring of radius 1/2 that look at its middle, in scene space."""
    poses = []
    for index in range(_NUM_IMAGES):
        angle = 2.0 * math.pi * index / _NUM_IMAGES
        back = np.array([math.cos(angle), math.sin(angle), 0.0])
        right = np.array([-math.sin(angle), math.cos(angle), 0.0])
        poses.append(np.stack([right, [0.0, 0.0, 1.0], back, 0.5 * back], axis=-1))
    cameras = Cameras.from_arrays(
        world_from_camera=np.stack(poses),
        scene=_SCENE,
        widths=[_SIDE_PX] * _NUM_IMAGES,
        heights=[_SIDE_PX] * _NUM_IMAGES,
        focal=[(float(_SIDE_PX), float(_SIDE_PX))] * _NUM_IMAGES,
        principal=[(_SIDE_PX / 2, _SIDE_PX / 2)] * _NUM_IMAGES,
    )
    grey = np.full((_SIDE_PX, _SIDE_PX, 3), 128, np.uint8)
    return cameras, ImageData.from_arrays([grey] * _NUM_IMAGES)


def _find_made_depth() -> None:
    """Depth maps of three cameras in a row before a grey wall, whose points are known."""
    lens = (float(_SIDE_PX), float(_SIDE_PX), _SIDE_PX / 2, _SIDE_PX / 2)
    grey = np.full((_SIDE_PX, _SIDE_PX), 0.5, np.float32)
    places = np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    views = [StereoView(grey, lens, np.column_stack([np.eye(3), place])) for place in places]
    wall = np.column_stack([np.linspace(-0.5, 0.5, 50), np.zeros(50), np.full(50, 2.0)])
    find_depth_maps(views, StereoConfig(num_planes=16), wall)
    toward = np.tile([0.0, 0.0, -1.0], (len(wall), 1))
    everywhere = np.ones((len(views), len(wall)), np.uint8)
    photo_offsets(wall, toward, everywhere, Pictures.of(views, np.zeros(3)), 1)
