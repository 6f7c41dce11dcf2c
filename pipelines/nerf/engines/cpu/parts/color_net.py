"""The colour half of the field per tile of samples. Forward only; twin of `NerfactoField.colors`.

The first layer sees [16 spherical harmonics, geometry, appearance]. The first and the last part are
the same for all samples of a ray, so their share of the first layer is computed once per ray.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from pipelines.nerf.engines.cpu.parts.dense_layers import PackedLayer, apply_layer, pack_layer
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged
from pipelines.nerf.space.harmonics import NUM_SPHERICAL_HARMONICS


class ColorNet(NamedTuple):
    """The colour layers, the first one cut into its parts.

    from_direction: 16 -> hidden; its bias holds the appearance's share. from_geometry: geo ->
    hidden, no bias. hidden: hidden -> hidden. output: hidden -> 3.
    """

    from_direction: PackedLayer
    from_geometry: PackedLayer
    hidden: PackedLayer
    output: PackedLayer


def pack_color(layers: nn.ModuleList, num_geometry: int, appearance: Tensor | None) -> ColorNet:
    """The colour MLP with one appearance code, as arrays.

    layers: three `nn.Linear`. appearance: [A], or None where the model has none.
    Raises ValueError where the layers do not take these inputs.
    """
    if len(layers) != 3:
        raise ValueError(f"the compiled colour network has 3 layers, this one has {len(layers)}")
    first, second, third = layers
    assert isinstance(first, nn.Linear)
    assert isinstance(second, nn.Linear)
    assert isinstance(third, nn.Linear)
    geometry_end = NUM_SPHERICAL_HARMONICS + num_geometry
    num_appearance = 0 if appearance is None else len(appearance)
    if first.in_features != geometry_end + num_appearance:
        raise ValueError(
            f"the colour network takes {first.in_features} inputs, expected 16 + {num_geometry} + "
            f"{num_appearance}"
        )
    direction = pack_layer(first, slice(0, NUM_SPHERICAL_HARMONICS))
    if appearance is not None:
        with torch.no_grad():
            share = first.weight[:, geometry_end:] @ appearance
        direction.bias[: len(share)] += share.cpu().float().numpy()
    geometry = pack_layer(first, slice(NUM_SPHERICAL_HARMONICS, geometry_end))
    geometry.bias[:] = np.float32(0.0)
    return ColorNet(direction, geometry, pack_layer(second), pack_layer(third))


@compiled
def direction_harmonics(direction, out, column):
    """out[:16, column] = spherical harmonics: twin of `harmonics.spherical_harmonics`."""
    x, y, z = direction[0], direction[1], direction[2]
    xx, yy, zz = x * x, y * y, z * z
    out[0, column] = 0.28209479177387814
    out[1, column] = -0.4886025119029199 * y
    out[2, column] = 0.4886025119029199 * z
    out[3, column] = -0.4886025119029199 * x
    out[4, column] = 1.0925484305920792 * x * y
    out[5, column] = -1.0925484305920792 * y * z
    out[6, column] = 0.31539156525252005 * (3.0 * zz - 1.0)
    out[7, column] = -1.0925484305920792 * x * z
    out[8, column] = 0.5462742152960396 * (xx - yy)
    out[9, column] = -0.5900435899266435 * y * (3.0 * xx - yy)
    out[10, column] = 2.890611442640554 * x * y * z
    out[11, column] = -0.4570457994644658 * y * (5.0 * zz - 1.0)
    out[12, column] = 0.3731763325901154 * z * (5.0 * zz - 3.0)
    out[13, column] = -0.4570457994644658 * x * (5.0 * zz - 1.0)
    out[14, column] = 1.445305721320277 * z * (xx - yy)
    out[15, column] = -0.5900435899266435 * x * (xx - 3.0 * yy)


@merged
def color_logits(net, geometry, count, first, second, out):
    """out[:3, :count] = colours before the sigmoid.

    geometry: [geo, TILE]. first: [hidden, TILE], holding the rays' share of the first layer; it and
    second [hidden, TILE] are overwritten.
    """
    apply_layer(geometry, net.from_geometry, count, True, True, first)
    apply_layer(first, net.hidden, count, True, False, second)
    apply_layer(second, net.output, count, False, False, out)
