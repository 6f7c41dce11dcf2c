"""A trained model and a camera -> pictures, in tiles of bounded memory.

On the CPU the whole forward pass runs in a compiled kernel (`kernels.render_rays`); elsewhere, or
with engine "plain", the model itself is asked in chunks. Depths are distances along the ray in
world units, not z. Symbols: R rays, H and W of a picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.cameras import Cameras, SceneTransform
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.rays import Rays

FloatArray = NDArray[np.float32]
Progress = Callable[[float], None]

FAST_TILE_RAYS = 8192
"""Rays of one kernel call: a fraction of a second, so that progress moves and a cancel is seen."""
PLAIN_BYTES = {"cpu": 256 * 2**20, "cuda": 2 * 2**30}
"""Memory that the intermediate tensors of one plain chunk may take, by kind of device."""
MAX_PLAIN_RAYS = 32768


@dataclass(frozen=True)
class RenderedImage:
    """What a camera sees, or, with [R] in place of [H, W], what rays see. Arrays of float32.

    rgb: [H, W, 3], sRGB in [0, 1]. accumulation: [H, W] in [0, 1], the chance that the ray ends.
    depth, expected_depth: [H, W], median and mean distance along the ray, world units.
    """

    rgb: FloatArray
    accumulation: FloatArray
    depth: FloatArray
    expected_depth: FloatArray


class Renderer:
    """Renders a model that others may go on training: its state is read anew in every call.

    model: is moved to `device` where one is given. scene: gives the world's unit.
    engine: "fast" is the compiled kernel, on the CPU only; "plain" the model in PyTorch; "auto" is
        fast on the CPU and plain elsewhere.
    early_stop, weight_threshold: what the fast engine may leave out, see `kernels.render_rays`;
        with both at 0 it agrees with the plain one to rounding.
    Raises NerfError `bad_config` for an unknown engine, or for "fast" away from the CPU.
    """

    def __init__(
        self,
        model: Nerfacto,
        scene: SceneTransform,
        *,
        engine: str = "auto",
        device: torch.device | str | None = None,
        early_stop: float = 1e-3,
        weight_threshold: float = 1e-3,
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
        if engine == "fast" and not on_cpu:
            raise NerfError(
                "bad_config",
                f"The fast renderer runs on the CPU, and the model is on {self._device}.",
                "Use engine auto, or move the model to the CPU.",
            )
        self.engine = ("fast" if on_cpu else "plain") if engine == "auto" else engine

    def render(
        self,
        cameras: Cameras,
        index: int,
        *,
        appearance: int | None = None,
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
        return RenderedImage(
            rgb=flat.rgb.reshape(height, width, 3),
            accumulation=flat.accumulation.reshape(height, width),
            depth=flat.depth.reshape(height, width),
            expected_depth=flat.expected_depth.reshape(height, width),
        )

    def render_rays(
        self,
        origins: Tensor | FloatArray,
        directions: Tensor | FloatArray,
        *,
        appearance: int | None = None,
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
        appearance: int | None,
        progress: Progress | None,
    ) -> RenderedImage:
        """`rays_of(begin, end)` makes the rays of one tile."""
        result = np.zeros((num_rays, 6), np.float32)
        tile, draw = self._drawer(appearance)
        was_training = self._model.training
        self._model.eval()
        try:
            with torch.no_grad():
                for begin in range(0, num_rays, tile):
                    end = min(begin + tile, num_rays)
                    rgb, *others = draw(rays_of(begin, end))
                    result[begin:end, :3] = rgb
                    result[begin:end, 3:] = np.stack(others, axis=-1)
                    if progress is not None:
                        progress(end / num_rays)
        finally:
            self._model.train(was_training)
        to_world = np.float32(1.0 / self._scene.scale)
        return RenderedImage(
            rgb=result[:, :3].clip(0.0, 1.0),
            accumulation=result[:, 3].clip(0.0, 1.0),
            depth=result[:, 4] * to_world,
            expected_depth=result[:, 5] * to_world,
        )

    def _drawer(
        self, appearance: int | None
    ) -> tuple[int, Callable[[Rays], tuple[FloatArray, ...]]]:
        """(rays per tile, a function from rays to rgb, accumulation, median, expected depth)."""
        if self.engine == "plain":

            def draw_plain(rays: Rays) -> tuple[FloatArray, ...]:
                seen = self._model(rays, appearance=appearance)
                names = ("rgb", "accumulation", "depth", "expected_depth")
                return tuple(seen[name].float().cpu().numpy() for name in names)

            return self._plain_tile(), draw_plain

        # Imported here: a machine that only renders on a GPU never loads the compiler.
        from pipelines.nerf.kernels.render_rays import pack_model, render_rays

        packed = pack_model(
            self._model,
            appearance=appearance,
            early_stop=self._early_stop,
            weight_threshold=self._weight_threshold,
        )

        def draw_fast(rays: Rays) -> tuple[FloatArray, ...]:
            return render_rays(packed, rays.origins.numpy(), rays.directions.numpy())

        return FAST_TILE_RAYS, draw_fast

    def _plain_tile(self) -> int:
        """Rays whose intermediate tensors fit the memory that a plain chunk may take."""
        config = self._model.config
        proposals = config.proposals[: len(self._model.proposals)]
        rounds = range(len(config.num_proposal_samples))
        grids = [proposals[min(i, len(proposals) - 1)].grid for i in rounds] + [config.grid]
        samples = [*config.num_proposal_samples, config.num_nerf_samples]
        # Per sample, level and corner: an index (8 bytes), a weight (4), features (4 F), twice.
        per_ray = max(
            count * grid.num_levels * 8 * 2 * (12 + 4 * grid.features_per_level)
            for count, grid in zip(samples, grids, strict=True)
        )
        budget = PLAIN_BYTES.get(self._device.type, PLAIN_BYTES["cpu"])
        return max(1, min(MAX_PLAIN_RAYS, budget // per_ray))
