"""A whole density network per tile of samples: hash grid, hidden layer, output; nothing in between.

Used for the proposal networks and for the density half of the field, whose output layer has more
rows. Forward only. Twin of `fields.DensityField` up to the logit.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import nn

from pipelines.nerf.engines.cpu.parts.dense_layers import PackedLayer, apply_layer, pack_layer
from pipelines.nerf.engines.cpu.parts.hash_lanes import GridArrays, encode_columns
from pipelines.nerf.engines.cpu.parts.runtime import merged


class DensityNet(NamedTuple):
    """A hash grid and the two layers behind it, as arrays that a kernel can take."""

    grid: GridArrays
    hidden: PackedLayer
    output: PackedLayer


def pack_density(grid: GridArrays, layers: nn.ModuleList) -> DensityNet:
    """The network as arrays: the grid is shared, the small layers are copied.

    layers: two `nn.Linear`, L * F -> hidden -> outputs, of which the first is the logit.
    Raises ValueError for another number of layers or a table that is not float32.
    """
    if len(layers) != 2:
        raise ValueError(f"the compiled density network has 2 layers, this one has {len(layers)}")
    if grid.table.dtype != np.float32:
        raise ValueError(f"the compiled hash grid needs float32, this one is {grid.table.dtype}")
    hidden, output = layers
    assert isinstance(hidden, nn.Linear)
    assert isinstance(output, nn.Linear)
    return DensityNet(grid, pack_layer(hidden), pack_layer(output))


@merged
def density_logits(net, points, count, features, hidden, out):
    """Row 0 of out[O, TILE] becomes the logits at points[:count], the other rows the features.

    points: [3, TILE] in [0, 1]. features [L * F, TILE] and hidden [H, TILE] are scratch.
    """
    encode_columns(points, 0, count, net.grid, features)
    apply_layer(features, net.hidden, count, True, False, hidden)
    apply_layer(hidden, net.output, count, False, False, out)
