"""A trained model and a camera -> pictures, in tiles of bounded memory.

On the CPU the whole forward pass runs in a compiled kernel (`kernels.render_rays`) where that knows
the model; elsewhere, or with engine "plain", the model itself is asked in chunks. Depths are
distances along the ray in world units, not z. Symbols: R rays, H and W of a picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.cameras import Cameras, SceneTransform
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Appearance, Model
from pipelines.nerf.rays import Rays

FloatArray = NDArray[np.float32]
Progress = Callable[[float], None]

FAST_TILE_RAYS = 8192
"""Rays of one kernel call: a fraction of a second, so that progress moves and a cancel is seen."""
PLAIN_BYTES = {"cpu": 256 * 2**20, "cuda": 2 * 2**30}
"""Memory that the intermediate tensors of one plain chunk may take, by kind of device."""
MAX_PLAIN_RAYS = 32768
_CHANNELS: dict[str, tuple[int, ...]] = {
    "rgb": (3,),
    "accumulation": (),
    "depth": (),
    "expected_depth": (),
    "normals": (3,),
    "predicted_normals": (3,),
}


@dataclass(frozen=True)
class RenderedImage:
    """What a camera sees, or, with [R] in place of [H, W], what rays see. Arrays of float32.

    rgb: [H, W, 3], sRGB in [0, 1]. accumulation: [H, W] in [0, 1], the chance that the ray ends.
    depth, expected_depth: [H, W], median and mean distance along the ray, world units.
    normals, predicted_normals: [H, W, 3], world axes, unit or zero, from a model that learned them.
    """

    rgb: FloatArray
    accumulation: FloatArray
    depth: FloatArray
    expected_depth: FloatArray
    normals: FloatArray | None = None
    predicted_normals: FloatArray | None = None


class Renderer:
    """Renders a model that others may go on training: its state is read anew in every call.

    model: is moved to `device` where one is given. scene: gives the world's unit.
    engine: "fast" is the compiled kernel, on the CPU only; "plain" the model in PyTorch; "auto" is
        fast on the CPU where the kernel knows the model, and plain elsewhere.
    early_stop, weight_threshold: what the fast engine may leave out, see `kernels.render_rays`;
        with both at 0 it agrees with the plain one to rounding.
    normals: also render normals, which needs a model that learned them and the plain engine.
    Raises NerfError `bad_config` for an unknown engine, or for "fast" where it cannot be.
    """

    def __init__(
        self,
        model: Model,
        scene: SceneTransform,
        *,
        engine: str = "auto",
        device: torch.device | str | None = None,
        early_stop: float = 1e-3,
        weight_threshold: float = 1e-3,
        normals: bool = False,
    ) -> None:
        self._model = model if device is None else model.to(device)
        self._scene = scene
        self._device = next(model.parameters()).device
        self._early_stop = early_stop
        self._weight_threshold = weight_threshold
        if engine not in ("auto", "plain", "fast"):
            raise NerfError(
                "bad_config", f"There is no engine {engine}.", "Use auto, plain or fast."
            )
        on_cpu = self._device.type == "cpu"
        is_fast = engine != "plain" and on_cpu and not normals and _kernel_knows(model)
        if engine == "fast" and not is_fast:
            raise NerfError(
                "bad_config",
                "The fast renderer knows Nerfacto with a hash grid, on the CPU, without normals; "
                f"this is {type(model).__name__} on {self._device}.",
                "Use engine auto.",
            )
        self.engine = "fast" if is_fast else "plain"
        if engine != "plain" and on_cpu and not is_fast:
            model.set_engine("fast")  # its grids, where the whole model has no kernel

    def render(
        self,
        cameras: Cameras,
        index: int,
        *,
        appearance: Appearance = None,
        progress: Progress | None = None,
    ) -> RenderedImage:
        """The picture of camera `index`, at the size and with the lens that the camera has.

        cameras: in scene space. appearance: whose training image's code to use; None for the mean.
        progress: called with the share that is done, in (0, 1]; what it raises ends the rendering.
        """
        width, height = (int(side) for side in cameras.size[index].tolist())
        source = cameras.select([index]).to(self._device)

        def rays_of(begin: int, end: int) -> Rays:
            pixel = torch.arange(begin, end, device=self._device)
            columns, rows = pixel % width, pixel // width
            return source.generate_rays(
                torch.zeros_like(pixel), torch.stack([columns, rows], dim=-1).float() + 0.5
            )

        flat = self._render(rays_of, width * height, appearance, progress)
        shaped = {
            item.name: getattr(flat, item.name).reshape(height, width, *_CHANNELS[item.name])
            for item in fields(flat)
            if getattr(flat, item.name) is not None
        }
        return RenderedImage(**shaped)

    def render_rays(
        self,
        origins: Tensor | FloatArray,
        directions: Tensor | FloatArray,
        *,
        appearance: Appearance = None,
        progress: Progress | None = None,
    ) -> RenderedImage:
        """What single rays see, with [R] for [H, W] in the result.

        origins: [R, 3], scene units. directions: [R, 3], unit vectors.
        """
        starts = torch.as_tensor(origins, dtype=torch.float32, device=self._device)
        ways = torch.as_tensor(directions, dtype=torch.float32, device=self._device)

        def rays_of(begin: int, end: int) -> Rays:
            nobody = torch.zeros(end - begin, dtype=torch.int64, device=self._device)
            return Rays(starts[begin:end], ways[begin:end], nobody)

        return self._render(rays_of, len(starts), appearance, progress)

    def _render(
        self,
        rays_of: Callable[[int, int], Rays],
        num_rays: int,
        appearance: Appearance,
        progress: Progress | None,
    ) -> RenderedImage:
        """`rays_of(begin, end)` makes the rays of one tile."""
        result: dict[str, FloatArray] = {}
        tile, draw = self._drawer(appearance)
        was_training = self._model.training
        self._model.eval()
        try:
            with torch.no_grad():
                for begin in range(0, num_rays, tile):
                    end = min(begin + tile, num_rays)
                    for name, values in draw(rays_of(begin, end)).items():
                        if name not in result:
                            result[name] = np.zeros((num_rays, *_CHANNELS[name]), np.float32)
                        result[name][begin:end] = values
                    if progress is not None:
                        progress(end / num_rays)
        finally:
            self._model.train(was_training)
        to_world = np.float32(1.0 / self._scene.scale)
        for name in ("depth", "expected_depth"):
            result[name] *= to_world
        for name in ("rgb", "accumulation"):
            result[name].clip(0.0, 1.0, out=result[name])
        return RenderedImage(**result)

    def _drawer(
        self, appearance: Appearance
    ) -> tuple[int, Callable[[Rays], dict[str, FloatArray]]]:
        """(rays per tile, a function from rays to the fields of `RenderedImage`, scene units)."""
        if self.engine == "plain":

            def draw_plain(rays: Rays) -> dict[str, FloatArray]:
                seen: dict[str, Any] = self._model(rays, appearance=appearance)
                return {
                    name: seen[name].float().cpu().numpy() for name in _CHANNELS if name in seen
                }

            return self._plain_tile(), draw_plain

        # Imported here: a machine that only renders on a GPU never loads the compiler.
        from pipelines.nerf.kernels.render_rays import pack_model, render_rays

        packed = pack_model(
            self._model,
            appearance=appearance,
            early_stop=self._early_stop,
            weight_threshold=self._weight_threshold,
        )

        def draw_fast(rays: Rays) -> dict[str, FloatArray]:
            found = render_rays(packed, rays.origins.numpy(), rays.directions.numpy())
            return dict(zip(_CHANNELS, found, strict=False))

        return FAST_TILE_RAYS, draw_fast

    def _plain_tile(self) -> int:
        """Rays whose intermediate tensors fit the memory that a plain chunk may take."""
        budget = PLAIN_BYTES.get(self._device.type, PLAIN_BYTES["cpu"])
        return max(1, min(MAX_PLAIN_RAYS, budget // self._model.bytes_per_ray()))


def _kernel_knows(model: Model) -> bool:
    # Imported here: a machine that only renders on a GPU never loads the compiler.
    from pipelines.nerf.kernels.render_rays import supports

    return supports(model)
