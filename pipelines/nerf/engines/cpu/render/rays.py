"""Nerfacto's whole forward pass for rendering, fused per block of rays: twin of `Nerfacto` in eval.

With `ALL_SAMPLES` the values are those of the plain model to rounding. The options of
`RenderConfig` leave out what can hardly be seen:

- `baked_cells`: the first round reads a grid (`render_grid`) in place of its network;
- `skip_below`: samples in intervals that the round before gave at most this weight hold nothing;
- `early_stop`: samples behind a transmittance below it are not looked at: accumulation changes by
  at most early_stop;
- `color_weight`: the colour network is asked once for neighbouring samples until they weigh more
  than this together, for the mean of what the density network told it about them.

R rays; results repeat whatever the number of threads, and however rays are cut into calls.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.along_ray.intervals import spacing_piecewise
from pipelines.nerf.engines.cpu.parts.color_net import pack_color
from pipelines.nerf.engines.cpu.parts.density_net import DensityNet, pack_density
from pipelines.nerf.engines.cpu.parts.hash_lanes import NUM_FEATURES, pack_grid
from pipelines.nerf.engines.cpu.parts.intervals import CONTRACTION_CODES
from pipelines.nerf.engines.cpu.parts.runtime import run_threads
from pipelines.nerf.engines.cpu.render.baked_grid import NO_GRID, BakedGrid
from pipelines.nerf.engines.cpu.render.block import (
    BACKGROUNDS,
    PackedModel,
    Settings,
    render_blocks,
)
from pipelines.nerf.models.base import Appearance, Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.networks.fields import MLP
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.render import ALL_SAMPLES, RenderConfig

FloatArray = NDArray[np.float32]


def supports(model: Model) -> bool:
    """Whether the kernel knows the method and the parts it is made of."""
    if not isinstance(model, Nerfacto):
        return False
    config = model.config
    return (
        config.position_encoding == "hash"
        and config.direction_encoding == "spherical_harmonics"
        and config.spacing == "piecewise"
        and config.contraction in CONTRACTION_CODES
        and all(grid.features_per_level == NUM_FEATURES for grid in _grids(config))
    )


def _grids(config: NerfactoConfig) -> list[HashGridConfig]:
    return [config.grid, *(proposal.grid for proposal in config.proposals)]


def _pack_density(grid: HashGrid, network: MLP) -> DensityNet:
    arrays = pack_grid(grid.table, grid.resolutions, grid.dense, grid.offsets)
    return pack_density(arrays, network.layers)


def pack_model(
    model: Model,
    *,
    appearance: Appearance = None,
    options: RenderConfig = ALL_SAMPLES,
    baked: BakedGrid | None = None,
) -> PackedModel:
    """The model as arrays. Tables are shared with a float32 model on the CPU, layers are copied.

    appearance: a code [A], whose training image's code to use, or None for the mean code.
    options: what to leave out. baked: where to keep the first round's grid for the next packing.
    Raises ValueError for a model that the kernel does not know (`supports`).
    """
    if not (isinstance(model, Nerfacto) and supports(model)):
        raise ValueError(f"the kernel does not render this {type(model).__name__}")
    config, field = model.config, model.field
    with torch.no_grad():
        code = field.mean_code()
        if isinstance(appearance, Tensor):
            code = None if code is None else appearance
        elif appearance is not None and field.appearance is not None:
            code = field.appearance.weight[appearance]
    ends = spacing_piecewise(torch.tensor([config.near, config.far], dtype=torch.float64))
    s_near, s_far = ends.tolist()
    proposals = tuple(_pack_density(net.grid, net.mlp) for net in model.round_networks())  # type: ignore[arg-type]
    grid = NO_GRID
    if options.baked_cells > 0:
        grid = (baked or BakedGrid()).of(proposals[0], options.baked_cells)
    return PackedModel(
        (*proposals, _pack_density(field.grid, field.density_mlp)),
        grid,
        pack_color(field.color_mlp.layers, config.geo_feature_dim, code),
        Settings(
            np.array([*config.num_proposal_samples, config.num_nerf_samples], np.int64),
            np.float32(s_near),
            np.float32(s_far),
            np.float32(config.average_init_density),
            CONTRACTION_CODES[config.contraction],
            BACKGROUNDS[config.background],
            float(options.skip_below),
            float(options.early_stop),
            float(options.color_weight),
        ),
    )


def render_rays(
    model: PackedModel, origins: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """What rays show.

    origins, directions: [R, 3] float32, scene space, unit directions.
    Returns rgb [R, 3] in [0, 1], accumulation [R], median and expected depth [R] along the ray in
    scene units.
    """
    num_rays = len(origins)
    rgb = np.zeros((num_rays, 3), np.float32)
    accumulation, median, expected = (np.zeros(num_rays, np.float32) for _ in range(3))
    run_threads(
        render_blocks,
        model,
        np.ascontiguousarray(origins, np.float32),
        np.ascontiguousarray(directions, np.float32),
        rgb,
        accumulation,
        median,
        expected,
    )
    return rgb, accumulation, median, expected
