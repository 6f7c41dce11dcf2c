"""The field's hash grid for training: features with their slopes, and the way back to the table.

Symbols as in `field_forward`. All tiles go through one level before the next: neighbouring rays
share entries, and one level stays in the cache where all of them do not. The slopes are taken while
the corners are at hand, since to fetch them again in the backward pass costs more than to keep
three numbers per feature.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from pipelines.nerf.engines.cpu.parts.dense_layers import TILE
from pipelines.nerf.engines.cpu.parts.hash_lanes import (
    NUM_FEATURES,
    PLACE_ROWS,
    encode_columns,
    one_level,
    scatter_columns,
)
from pipelines.nerf.engines.cpu.parts.hash_slopes import encode_slopes
from pipelines.nerf.engines.cpu.parts.runtime import compiled


@compiled
def encode_levels(share, shares, grid, counts, points, features, slopes):
    """Features [N, L * 2, TILE] of points [N, 4, TILE], and their slopes [N, 3 * L * 2, TILE].

    counts: [N] samples of each tile; up to 15 columns behind them are read and written as well.
    slopes may be [N, 0, TILE]: then nobody wants them.
    """
    num_levels = len(grid.resolutions)
    for turn in range(share, num_levels, shares):
        level = num_levels - 1 - turn  # finest first: they take longest
        row = NUM_FEATURES * level
        alone = one_level(grid, level)
        for tile in range(len(counts)):
            out = features[tile, row : row + NUM_FEATURES]
            if slopes.size > 0:
                along = slopes[tile, 3 * row : 3 * (row + NUM_FEATURES)]
                encode_slopes(grid, level, points[tile], counts[tile], out, along)
            else:
                encode_columns(points[tile], 0, counts[tile], alone, out)


@compiled
def scatter_levels(share, shares, grid, counts, points, grad_features, grad_table):
    """Add to grad_table [E, 2] what comes back for features [N, L * 2, TILE]; a level per turn."""
    places = np.zeros((PLACE_ROWS, TILE), np.float32)
    num_levels = len(grid.resolutions)
    for turn in range(share, num_levels, shares):
        level = num_levels - 1 - turn
        row = NUM_FEATURES * level
        alone = one_level(grid, level)
        for tile in range(len(counts)):
            upstream = grad_features[tile, row : row + NUM_FEATURES]
            scatter_columns(points[tile], 0, counts[tile], alone, upstream, places, grad_table)
