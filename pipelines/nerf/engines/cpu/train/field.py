"""The field for training on the CPU: one differentiable function from rays to colours and weights.

Symbols: R rays, S samples, A appearance numbers, G geometry features. The kernels are in
`field_forward` and `field_backward`; this module packs the layers for them and unpacks gradients.
Values and gradients are those of `NerfactoField.density`, `weights_from_density`,
`NerfactoField.color` and `composite` one after the other, to float32 rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pipelines.nerf.engines.cpu.parts.dense_layers import (
    TILE,
    PackedLayer,
    pack_arrays,
    pack_transposed,
    products_shape,
    round_up,
    unpack_products,
)
from pipelines.nerf.engines.cpu.parts.hash_lanes import NUM_FEATURES, pack_grid
from pipelines.nerf.engines.cpu.parts.intervals import CONTRACTION_CODES
from pipelines.nerf.engines.cpu.parts.runtime import run_threads
from pipelines.nerf.engines.cpu.train.field_backward import (
    PARTS,
    BackwardNet,
    Gradients,
    Sums,
    Upstream,
    backward_blocks,
)
from pipelines.nerf.engines.cpu.train.field_forward import (
    BLOCK_RAYS,
    FieldNet,
    Kept,
    RayBatch,
    Settings,
    forward_blocks,
    place_samples,
    tiles_of_block,
)
from pipelines.nerf.engines.cpu.train.field_grid import encode_levels, scatter_levels
from pipelines.nerf.engines.cpu.train.gradients import (
    accumulates_in_place,
    returned_gradient,
    table_gradient,
)
from pipelines.nerf.networks.fields import NerfactoField
from pipelines.nerf.space.harmonics import NUM_SPHERICAL_HARMONICS

FloatArray = NDArray[np.float32]
BACKGROUND_VALUES = {"last_sample": 0.0, "black": 0.0, "random": 0.0, "white": 1.0}


def supports(field: NerfactoField) -> bool:
    """Whether `render_field` can take the field: its two MLPs have 2 and 3 layers with biases, and
    the grid has two features, and all parameters are contiguous float32 on the CPU. Widths and
    levels are free.
    """
    layers = [*field.density_mlp.layers, *field.color_mlp.layers]
    if (len(field.density_mlp.layers), len(field.color_mlp.layers)) != (2, 3):
        return False
    if field.grid.table.shape[1] != NUM_FEATURES:
        return False
    if not all(isinstance(layer, nn.Linear) and layer.bias is not None for layer in layers):
        return False
    return all(
        p.device.type == "cpu" and p.dtype == torch.float32 and p.is_contiguous()
        for p in field.parameters()
    )


def render_field(
    origins: Tensor,
    directions: Tensor,
    t_edges: Tensor,
    codes: Tensor | None,
    field: NerfactoField,
    background: str,
    *,
    noise: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """What rays show, and the chance that they end in each interval.

    origins, directions: [R, 3], scene space, unit directions. t_edges: [R, S + 1], increasing,
    scene units; no gradient flows to them. codes: [R, A], or None where the field has none.
    background: as `rendering.composite`; for "random", `noise` [R, 3] in [0, 1] holds the colours
    behind the rays, None stands for black.
    Returns rgb [R, 3] and weights [R, S] in [0, 1], float32, differentiable once in origins,
    directions, codes and all parameters of the field.
    Raises ValueError for a field that `supports` refuses, for other shapes and backgrounds.
    """
    if not supports(field):
        raise ValueError(
            "the compiled field takes 2 features per entry, 2 density and 3 colour layers, all in "
            "float32 on the CPU: use engine 'plain'"
        )
    if background not in BACKGROUND_VALUES:
        raise ValueError(f"no background {background!r}: one of {sorted(BACKGROUND_VALUES)}")
    num_rays = len(origins)
    behind = torch.full((num_rays, 3), BACKGROUND_VALUES[background])
    if background == "random" and noise is not None:
        behind = noise.detach().to(torch.float32)
    if codes is None:
        codes = torch.zeros(num_rays, 0)
    _check_shapes(origins, directions, t_edges, codes, behind, field)
    layers = [*field.density_mlp.layers, *field.color_mlp.layers]
    parameters = [p for layer in layers for p in (layer.weight, layer.bias)]
    rgb, weights = _RenderField.apply(  # type: ignore[no-untyped-call]
        origins.to(torch.float32),
        directions.to(torch.float32),
        t_edges.detach().to(torch.float32),
        codes.to(torch.float32),
        behind,
        field,
        background == "last_sample",
        field.grid.table,
        *parameters,
    )
    return rgb, weights


def _check_shapes(
    origins: Tensor,
    directions: Tensor,
    t_edges: Tensor,
    codes: Tensor,
    behind: Tensor,
    field: NerfactoField,
) -> None:
    num_rays = len(origins)
    first = field.color_mlp.layers[0]
    assert isinstance(first, nn.Linear)
    num_codes = first.in_features - NUM_SPHERICAL_HARMONICS - field.geo_feature_dim
    wanted = {
        "origins": (origins, (num_rays, 3)),
        "directions": (directions, (num_rays, 3)),
        "codes": (codes, (num_rays, num_codes)),
        "noise": (behind, (num_rays, 3)),
        "t_edges": (t_edges, (num_rays, max(t_edges.shape[-1], 2))),
    }
    for name, (tensor, shape) in wanted.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")


class _RenderField(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        origins: Tensor,
        directions: Tensor,
        t_edges: Tensor,
        codes: Tensor,
        behind: Tensor,
        field: NerfactoField,
        last_sample: bool,
        table: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        num_rays, num_samples = len(origins), t_edges.shape[1] - 1
        arrays = [_array(p) for p in parameters]
        net = _pack(field, table, arrays)
        settings = Settings(
            np.float32(field.average_init_density),
            CONTRACTION_CODES[field.contraction],
            last_sample,
        )
        rays = RayBatch(*map(_array, (origins, directions, t_edges, codes, behind)))
        counts = _tile_counts(num_rays, num_samples)
        tiles, features = len(counts), field.grid.num_outputs
        moving = ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
        # Levels that are not active are not written: their features and slopes are 0.
        empty = np.empty if len(net.grid.resolutions) * NUM_FEATURES == features else np.zeros
        kept = Kept(
            counts,
            np.zeros((tiles, 4, TILE), np.float32),
            empty((tiles, round_up(features, 4), TILE), np.float32),
            empty((tiles, 3 * features if moving else 0, TILE), np.float32),
            np.empty((num_rays, num_samples), np.float32),
            np.empty((num_rays * num_samples, 3), np.float32),
        )
        rgb, weights = torch.empty(num_rays, 3), torch.empty(num_rays, num_samples)
        run_threads(place_samples, rays, settings, counts, kept.points)
        run_threads(encode_levels, net.grid, counts, kept.points, kept.features, kept.slopes)
        run_threads(forward_blocks, net, settings, rays, kept, rgb.numpy(), weights.numpy())
        # Saved for the check that nobody changed them before backward: their memory is shared.
        ctx.save_for_backward(table, origins, directions, t_edges, codes, behind, *parameters)
        ctx.state = net, settings, rays, kept, weights.numpy().copy(), arrays
        ctx.field = field
        ctx.set_materialize_grads(False)
        return rgb, weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        table = ctx.saved_tensors[0]
        net, settings, rays, kept, weights, arrays = ctx.state
        num_rays, num_samples = weights.shape
        moving = ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
        upstream = Upstream(
            *(
                np.zeros(shape, np.float32) if gradient is None else _array(gradient)
                for gradient, shape in zip(
                    grad_outputs, ((num_rays, 3), (num_rays, num_samples)), strict=True
                )
            )
        )
        gradients = Gradients(
            np.empty_like(kept.features),
            np.zeros_like(rays.codes),
            np.zeros((num_rays if moving else 0, 3), np.float32),
            np.zeros((num_rays if moving else 0, 3), np.float32),
        )
        sums = _make_sums(net)
        run_threads(
            backward_blocks,
            net,
            _pack_backward(ctx.field, arrays),
            settings,
            rays,
            kept,
            weights,
            upstream,
            sums,
            gradients,
        )
        grad_table = None
        if ctx.needs_input_grad[7]:
            buffer = table_gradient(table, accumulates_in_place(ctx.field.grid))
            run_threads(
                scatter_levels,
                net.grid,
                kept.counts,
                kept.points,
                gradients.features,
                buffer.numpy(),
            )
            grad_table = returned_gradient(table, buffer)
        return (
            torch.from_numpy(gradients.origins) if ctx.needs_input_grad[0] else None,
            torch.from_numpy(gradients.directions) if ctx.needs_input_grad[1] else None,
            None,
            torch.from_numpy(gradients.codes) if ctx.needs_input_grad[3] else None,
            None,
            None,
            None,
            grad_table,
            *(torch.from_numpy(found) for found in _unpack_sums(ctx.field, sums, arrays)),
        )


def _array(tensor: Tensor) -> FloatArray:
    """The memory of a CPU tensor, contiguous; copied only where it was not."""
    return tensor.detach().contiguous().numpy()


def _tile_counts(num_rays: int, num_samples: int) -> NDArray[np.int64]:
    """Samples in each tile: those of BLOCK_RAYS rays begin a new tile."""
    blocks = np.arange(-(-num_rays // BLOCK_RAYS))[:, None] * BLOCK_RAYS
    tiles = np.arange(tiles_of_block(num_samples)) * TILE
    samples = np.minimum(BLOCK_RAYS, num_rays - blocks) * num_samples
    counts: NDArray[np.int64] = (samples - tiles).clip(0, TILE).astype(np.int64).reshape(-1)
    return counts


def _split_first(field: NerfactoField, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights [H, 16 + A] and [H, 1 + G] of the colour network's first layer [H, 16 + G + A]."""
    start, stop = NUM_SPHERICAL_HARMONICS, NUM_SPHERICAL_HARMONICS + field.geo_feature_dim
    from_ray = np.concatenate([weight[:, :start], weight[:, stop:]], axis=1)
    nothing = np.zeros((len(weight), 1), np.float32)
    return from_ray, np.concatenate([nothing, weight[:, start:stop]], axis=1)


def _pack(field: NerfactoField, table: Tensor, arrays: list[FloatArray]) -> FieldNet:
    """The field for the kernel: the table is shared, the layers are copied.

    arrays: weight and bias of the two density and the three colour layers.
    """
    from_ray, from_outputs = _split_first(field, arrays[4])
    return FieldNet(
        pack_grid(table, *field.grid.active()),
        pack_arrays(arrays[0], arrays[1]),
        pack_arrays(arrays[2], arrays[3]),
        pack_arrays(from_ray, arrays[5]),
        pack_arrays(from_outputs, None),
        pack_arrays(arrays[6], arrays[7]),
        pack_arrays(arrays[8], arrays[9]),
    )


def _pack_backward(field: NerfactoField, arrays: list[FloatArray]) -> BackwardNet:
    from_ray, from_outputs = _split_first(field, arrays[4])
    weights = (arrays[0], arrays[2], from_ray, from_outputs, arrays[6], arrays[8])
    return BackwardNet(*(pack_transposed(weight) for weight in weights))


def _make_sums(net: FieldNet) -> Sums:
    """Zeros for the gradients of all layers, once per part."""

    def products(layer: PackedLayer) -> FloatArray:
        shape = products_shape(len(layer.bias), layer.weights.shape[1])
        return np.zeros((PARTS, *shape), np.float32)

    def bias(layer: PackedLayer) -> FloatArray:
        return np.zeros((PARTS, len(layer.bias)), np.float32)

    return Sums(
        products(net.density_hidden),
        bias(net.density_hidden),
        products(net.density_output),
        bias(net.density_output),
        products(net.from_ray),
        bias(net.from_ray),
        products(net.from_outputs),
        products(net.color_hidden),
        bias(net.color_hidden),
        products(net.color_output),
        bias(net.color_output),
    )


def _unpack_sums(field: NerfactoField, sums: Sums, arrays: list[FloatArray]) -> list[FloatArray]:
    """Gradients in the order and the shapes of `arrays`; the parts are added in their order."""
    total = Sums(
        *(
            unpack_products(part.sum(axis=0)) if part.ndim == 4 else part.sum(axis=0)
            for part in sums
        )
    )
    harmonics, geometry = NUM_SPHERICAL_HARMONICS, field.geo_feature_dim
    num_codes = arrays[4].shape[1] - harmonics - geometry
    first = np.concatenate(
        [
            total.from_ray[:, :harmonics],
            total.from_outputs[:, 1 : 1 + geometry],
            total.from_ray[:, harmonics : harmonics + num_codes],
        ],
        axis=1,
    )
    found = (
        total.density_hidden,
        total.density_hidden_bias,
        total.density_output,
        total.density_output_bias,
        first,
        total.from_ray_bias,
        total.color_hidden,
        total.color_hidden_bias,
        total.color_output,
        total.color_output_bias,
    )
    return [
        np.ascontiguousarray(gradient[tuple(map(slice, array.shape))])
        for gradient, array in zip(found, arrays, strict=True)
    ]
