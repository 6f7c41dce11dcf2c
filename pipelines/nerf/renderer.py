"""A trained model and a camera -> pictures, in tiles of bounded memory.

Where they know the model, the whole forward pass runs in a compiled kernel on the CPU
(`engines.cpu.render.rays`) and in large tiles on a GPU (`engines.gpu.render`); elsewhere, or with
engine "plain", the model itself is asked in chunks. Depths are distances along the ray in world
units, not z. Symbols: R rays, H and W of a picture.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Appearance, Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.render import RenderConfig
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.space.rays import Rays

if TYPE_CHECKING:
    from pipelines.nerf.engines.cpu.render.baked_grid import BakedGrid

FloatArray = NDArray[np.float32]
Drawer = Callable[[Rays], dict[str, FloatArray]]
"""From rays to the fields of `RenderedImage` by name, depths in scene units."""
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
    """Renders a model that others may go on training: its state is read anew in every call, and
    left as it was.

    model: is moved to `device` where one is given. scene: gives the world's unit.
    engine: "fast" is the compiled kernel on the CPU, `engines.gpu.render` on a GPU; "plain" the
        model in
        PyTorch; "auto" is fast where that knows the model and, on a GPU, agrees with it.
    config: what the fast engine may leave out; with `ALL_SAMPLES` it agrees with the plain one to
        rounding.
    normals: also render normals, which needs a model that learned them and the plain engine.
    memory_share: how much of the usual memory tiles may take; pictures are the same.
    Raises NerfError `bad_config` for an unknown engine, or for "fast" where it cannot be.
    """

    def __init__(
        self,
        model: Model,
        scene: SceneTransform,
        *,
        engine: str = "auto",
        device: torch.device | str | None = None,
        config: RenderConfig | None = None,
        normals: bool = False,
        memory_share: float = 1.0,
    ) -> None:
        self._model = model if device is None else model.to(device)
        self._scene = scene
        self._device = next(model.parameters()).device
        self._config = RenderConfig() if config is None else config
        self._memory_share = memory_share
        self._baked: BakedGrid | None = None
        if engine not in ("auto", "plain", "fast"):
            raise NerfError(
                "bad_config", f"There is no engine {engine}.", "Use auto, plain or fast."
            )
        on_cpu = self._device.type == "cpu"
        is_fast = engine != "plain" and not normals and _fast_engine_knows(model, on_cpu)
        if engine == "auto" and is_fast and not on_cpu:
            is_fast = _draws_right(model)
        if engine == "fast" and not is_fast:
            raise NerfError(
                "bad_config",
                "The fast renderer knows Nerfacto with a hash grid of two features per entry, "
                f"without normals; this is {type(model).__name__} on {self._device}.",
                "Use engine auto.",
            )
        self.engine = "fast" if is_fast else "plain"
        # What the model itself renders with: where it has no kernel as a whole, its parts may.
        self._model_engine = engine if engine == "plain" else "fast" if on_cpu else None

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
        side = self._config.block_px if self.engine == "fast" else 1
        order = pixels_in_blocks(width, height, side).to(self._device)

        def rays_of(begin: int, end: int) -> Rays:
            pixel = order[begin:end]
            columns, rows = pixel % width, pixel // width
            return source.generate_rays(
                torch.zeros_like(pixel), torch.stack([columns, rows], dim=-1).float() + 0.5
            )

        flat = self._render(rays_of, width * height, appearance, progress)
        place = np.empty(len(order), np.int64)
        place[order.cpu().numpy()] = np.arange(len(order))
        shaped = {
            item.name: getattr(flat, item.name)[place].reshape(height, width, *_CHANNELS[item.name])
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
        was_training, engine = self._model.training, self._model.engine
        self._model.eval()
        self._model.set_engine(self._model_engine or engine)
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
            self._model.set_engine(engine)
        to_world = np.float32(1.0 / self._scene.scale)
        for name in ("depth", "expected_depth"):
            result[name] *= to_world
        for name in ("rgb", "accumulation"):
            result[name].clip(0.0, 1.0, out=result[name])
        return RenderedImage(**result)

    def _drawer(self, appearance: Appearance) -> tuple[int, Drawer]:
        """Rays per tile, and what draws them."""
        if self.engine == "plain":

            def draw_plain(rays: Rays) -> dict[str, FloatArray]:
                seen: dict[str, Any] = self._model(rays, appearance=appearance)
                return {
                    name: seen[name].float().cpu().numpy() for name in _CHANNELS if name in seen
                }

            return self._plain_tile(), draw_plain

        return (
            self._gpu_drawer(appearance)
            if self._device.type != "cpu"
            else self._cpu_drawer(appearance)
        )

    def _cpu_drawer(self, appearance: Appearance) -> tuple[int, Drawer]:
        # Imported here: a machine that only renders on a GPU never loads the compiler.
        from pipelines.nerf.engines.cpu.render.baked_grid import BakedGrid
        from pipelines.nerf.engines.cpu.render.rays import pack_model, render_rays

        if self._baked is None:
            self._baked = BakedGrid()
        packed = pack_model(
            self._model, appearance=appearance, options=self._config, baked=self._baked
        )

        def draw(rays: Rays) -> dict[str, FloatArray]:
            found = render_rays(packed, rays.origins.numpy(), rays.directions.numpy())
            return dict(zip(_CHANNELS, found, strict=False))

        return FAST_TILE_RAYS, draw

    def _gpu_drawer(self, appearance: Appearance) -> tuple[int, Drawer]:
        # Imported here: only this engine wants it.
        from pipelines.nerf.engines.gpu.render import TileDrawer

        assert isinstance(self._model, Nerfacto)
        drawer = TileDrawer(
            self._model,
            appearance=appearance,
            early_stop=self._config.early_stop,
            weight_threshold=self._config.weight_threshold,
            memory_share=self._memory_share,
        )

        def draw(rays: Rays) -> dict[str, FloatArray]:
            return {name: seen.float().cpu().numpy() for name, seen in drawer.draw(rays).items()}

        return drawer.tile_rays, draw

    def _plain_tile(self) -> int:
        """Rays whose intermediate tensors fit the memory that a plain chunk may take."""
        budget = PLAIN_BYTES.get(self._device.type, PLAIN_BYTES["cpu"])
        budget = int(budget * self._memory_share)
        return max(1, min(MAX_PLAIN_RAYS, budget // self._model.bytes_per_ray()))


def seen_within(model: Model, near: float, far: float) -> Model:
    """The same networks asked along short rays: nothing counts but what lies from near to far.

    near, far: scene units. What of a ray goes on beyond `far` has the colour of its last sample.
    The weights are shared, not copied.
    """
    short = copy.copy(model)
    short.config = replace(model.config, near=near, far=far, background="last_sample")
    return short


def pixels_in_blocks(width: int, height: int, side: int) -> Tensor:
    """Every pixel's number, row by row [H * W] int64, in the order of blocks of side x side pixels.

    Rays through neighbouring pixels read the same parts of the tables.
    """
    padded_width, padded_height = (-(-size // side) * side for size in (width, height))
    rows, columns = torch.arange(padded_height), torch.arange(padded_width)
    number = torch.where(columns < width, rows[:, None] * width + columns, -1)
    number[height:] = -1
    blocks = number.reshape(padded_height // side, side, padded_width // side, side)
    ordered = blocks.transpose(1, 2).reshape(-1)
    return ordered[ordered >= 0]


def _fast_engine_knows(model: Model, on_cpu: bool) -> bool:
    # Imported here: a machine that only renders on a GPU never loads the compiler.
    if on_cpu:
        from pipelines.nerf.engines.cpu.render.rays import supports

        return supports(model)
    from pipelines.nerf.engines.gpu.render import can_draw

    return can_draw(model)


def _draws_right(model: Model) -> bool:
    # Imported here: a machine without a GPU needs no Triton.
    from pipelines.nerf.engines.gpu.self_check import picture_problem

    assert isinstance(model, Nerfacto)
    return picture_problem(model) is None
