"""A trained model with its cameras, in world units: what every stage behind `train` works with.

`TrainedScene.load` needs `model.zip` alone, no capture. Poses are `world_from_camera` [3, 4],
OpenGL, world frame; pictures are uint8 sRGB. Errors of `pipelines.nerf` leave here as ours.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.errors import ExportError, PipelineError
from pipelines.nerf.devices import choose_device
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Appearance, Model
from pipelines.nerf.options.render import RenderConfig
from pipelines.nerf.renderer import RenderedImage, Renderer, seen_within
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.training.checkpoint import load_model
from pipelines.scene.bounds import SceneBounds, bounds_of_views
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.scene.depth_views import DepthView, Pinhole, z_depth_of

Floats = NDArray[np.float64]

_NUM_PROBES = 16
_PROBE_LONG_SIDE = 64


@contextlib.contextmanager
def nerf_errors_as(kind: type[PipelineError]) -> Iterator[None]:
    """Turn a NerfError of the block into `kind`, which says the same."""
    try:
        yield
    except NerfError as error:
        raise kind(
            error.message,
            code=error.code,
            hint=error.hint or None,
            retryable=True if error.retryable else None,
        ) from error


def use_all_cores() -> None:
    """Let torch use every core this process may run on, or OMP_NUM_THREADS where that is set."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS") or allowed or 1))


def nerf_cameras(
    lenses: Sequence[Intrinsics], poses: Sequence[Any] | Floats, scene: SceneTransform
) -> Cameras:
    """The library's cameras from lenses and world poses, one of each per camera."""
    return Cameras.from_arrays(
        world_from_camera=np.asarray(poses, np.float64),
        scene=scene,
        widths=[lens.width for lens in lenses],
        heights=[lens.height for lens in lenses],
        focal=[(lens.fl_x, lens.fl_y) for lens in lenses],
        principal=[(lens.cx, lens.cy) for lens in lenses],
        models=[lens.model for lens in lenses],
        distortion=[(lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2) for lens in lenses],
    )


def _cameras_of(extras: dict[str, Any]) -> CamerasFile:
    """The cameras in a model file. Raises ExportError where they make no sense."""
    try:
        return CamerasFile.from_dict(extras["cameras"])
    except (KeyError, TypeError, ValueError) as error:
        raise ExportError(
            f"The cameras in the model file cannot be read: {error}.",
            code="bad_model_file",
            hint="Train again with this version.",
        ) from error


class TrainedScene:
    """A model, its scene space and its cameras.

    cameras: all cameras of the training run with their split, in the order of the walk as far as
        names tell. extras: whatever else training wrote about the run. render_config: what
        rendering leaves out; None for the defaults. memory_share: how much of the usual memory
        rendering may take for its tiles.
    """

    def __init__(
        self,
        model: Model,
        scene: SceneTransform,
        cameras: CamerasFile,
        extras: dict[str, Any],
        render_config: RenderConfig | None = None,
        memory_share: float = 1.0,
    ) -> None:
        use_all_cores()
        self.model = model
        self.scene = scene
        self.cameras = cameras
        self.extras = extras
        self.renderer = Renderer(model, scene, config=render_config, memory_share=memory_share)
        self._render_config = render_config or RenderConfig()
        self._memory_share = memory_share

    @classmethod
    def load(
        cls, path: Path, render_config: RenderConfig | None = None, memory_share: float = 1.0
    ) -> TrainedScene:
        """Read `model.zip`, onto the GPU where there is one. Raises ExportError for a bad file."""
        with nerf_errors_as(ExportError):
            loaded = load_model(path)
            model = loaded.model.to(choose_device("auto"))
        cameras = _cameras_of(loaded.extras)
        return cls(model, loaded.scene, cameras, loaded.extras, render_config, memory_share)

    def by_default(self) -> TrainedScene:
        """The same, rendered with the default options: for what is not to depend on those."""
        if self._render_config == RenderConfig():
            return self
        return TrainedScene(
            self.model, self.scene, self.cameras, self.extras, None, self._memory_share
        )

    @property
    def bend(self) -> float | None:
        """Of the camera's curve, where pictures were brought to one light; else None."""
        return self.cameras.bend

    @property
    def trained_long_side_px(self) -> int:
        """Of the pictures as they were trained on."""
        largest = max(max(lens.width, lens.height) for lens in self.cameras.cameras)
        width, height = (int(self.extras.get(side, largest)) for side in ("width", "height"))
        return max(width, height)

    def training_images(self, at_most: int = 0) -> list[PosedImage]:
        """The images that were trained on, in the file's order; or so many, evenly picked."""
        return self._images("train", at_most)

    def test_images(self, at_most: int = 0) -> list[PosedImage]:
        """The images that were held out, in the file's order; or so many, evenly picked."""
        return self._images("test", at_most)

    def _images(self, split: str, at_most: int) -> list[PosedImage]:
        images = [image for image in self.cameras.images if image.split == split]
        if not at_most or len(images) <= at_most:
            return images
        picked = np.unique(np.linspace(0, len(images) - 1, at_most).round().astype(int))
        return [images[index] for index in picked]

    def lens_of(self, image: PosedImage) -> Intrinsics:
        """The lens of an image, for its full size."""
        return self.cameras.cameras[image.camera]

    def render(
        self,
        lens: Intrinsics,
        pose: Floats,
        long_side: int | None = None,
        *,
        appearance: Appearance = None,
    ) -> RenderedImage:
        """What a lens, distortion and all, sees from a world pose, at its own or a smaller size.

        appearance: a code [A], the training image whose code to use, or None for the mean code.
        """
        with nerf_errors_as(ExportError):
            cameras = nerf_cameras([lens], [pose], self.scene)
            sized = cameras.resized(long_side) if long_side else cameras
            return self.renderer.render(sized, 0, appearance=appearance)

    def short_rays(
        self,
        begins: Floats,
        directions: Floats,
        length: float,
        on_part: Callable[[float], None] = lambda done: None,
    ) -> RenderedImage:
        """What short rays see, in the mean appearance: [R] in place of [H, W].

        begins: [R, 3], world. directions: [R, 3], unit. length: world units; what a ray has not met
        by then is of the colour that it ends in. on_part: told the share that is done; may raise.
        """
        length *= self.scene.scale
        near = 1e-3 * length  # 0 is no place for samples that are spaced by disparity
        with nerf_errors_as(ExportError):
            renderer = Renderer(
                seen_within(self.model, near, near + length),
                self.scene,
                engine=self.renderer.engine,
                # Both look for surfaces along the whole of a ray, and coarsely.
                config=replace(self._render_config, baked_cells=0, skip_below=0.0),
                memory_share=self._memory_share,
            )
            starts = self.scene.scene_from_world(begins)
            return renderer.render_rays(
                starts.astype(np.float32), directions.astype(np.float32), progress=on_part
            )

    def density(self, points: Floats) -> NDArray[np.float32]:
        """The trained density [N] per world unit at points [N, 3] of the world."""
        device, engine = next(self.model.parameters()).device, self.model.engine
        places = torch.as_tensor(self.scene.scene_from_world(points), dtype=torch.float32)
        self.model.set_engine("fast" if device.type == "cpu" else engine)
        try:
            with torch.no_grad(), nerf_errors_as(ExportError):
                found = self.model.density(places.to(device)).float().cpu().numpy()
        finally:
            self.model.set_engine(engine)
        dense: NDArray[np.float32] = found * np.float32(self.scene.scale)
        return dense

    def picture(self, lens: Pinhole, pose: Floats) -> NDArray[np.uint8]:
        """[H, W, 3] uint8: an undistorted picture."""
        return as_uint8(self.render(lens.intrinsics(), pose).rgb)

    def depth_view(self, lens: Pinhole, pose: Floats) -> DepthView:
        """An undistorted picture with z-depth."""
        return self.seen(lens, pose)[0]

    def seen(self, lens: Pinhole, pose: Floats) -> tuple[DepthView, Floats]:
        """An undistorted picture with z-depth, and its accumulation [H, W] in [0, 1]."""
        seen = self.render(lens.intrinsics(), pose)
        accumulation = as_array(seen.accumulation)
        z_depth = z_depth_of(
            lens, as_array(seen.depth), as_array(seen.expected_depth), accumulation
        )
        return DepthView(lens, pose, as_uint8(seen.rgb), z_depth), accumulation

    def probe_views(self, check: Callable[[], None] = lambda: None) -> list[DepthView]:
        """Small depth views spread over the training images. check: called between them."""
        views = []
        for image in self.training_images(_NUM_PROBES):
            check()
            lens = Pinhole.of(self.lens_of(image), _PROBE_LONG_SIDE)
            pose = np.asarray(image.world_from_camera, np.float64)
            views.append(self.depth_view(lens, pose))
        return views

    def bounds(
        self,
        max_distance: float,
        check: Callable[[], None] = lambda: None,
        probes: Sequence[DepthView] | None = None,
    ) -> SceneBounds | None:
        """The part of the world that is the scene (`pipelines.scene.bounds`), or None.

        probes: what `probe_views` gave, to save rendering them again.
        """
        views = self.probe_views(check) if probes is None else probes
        poses = np.asarray(
            [image.world_from_camera for image in self.training_images()], np.float64
        )
        return bounds_of_views(views, poses, max_distance)


def as_array(values: Any) -> Floats:
    """A tensor or array as float64 on the CPU."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    return np.asarray(values, np.float64)


def as_uint8(rgb: Any) -> NDArray[np.uint8]:
    """Colours in [0, 1] as uint8."""
    return np.rint(255.0 * np.clip(as_array(rgb), 0.0, 1.0)).astype(np.uint8)
