"""How the levels of a hash grid lie over the unit cube and in its table.

Symbols: L levels, T = 2^log2_table_size entries of a hashed level, N_l cells per side of level l.
Plain numbers, which the definition and its compiled twins share; reading a table is left to them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pipelines.nerf.options.parts import HashGridConfig

HASH_PRIMES = (1, 2654435761, 805459861)
"""By axis: the hash of a vertex is the xor of its coordinates' products with them, modulo T."""


class LevelLayout(NamedTuple):
    """Where each level of a hash grid lies in its table, coarsest first.

    resolutions: L cell counts per side. dense: L flags, false for hashed levels.
    offsets: L + 1 first entries; the last one is the number of entries of all levels.
    """

    resolutions: list[int]
    dense: list[bool]
    offsets: list[int]


def level_layout(config: HashGridConfig) -> LevelLayout:
    """The levels of a grid: N_l = floor(min_res b^l), dense where (N_l + 1)^3 <= T.

    b = exp(ln(max_res / min_res) / (L - 1)), so that the last level has max_res cells per side.
    Source: Instant-NGP, arXiv:2201.05989, eqs. 2 and 3.
    """
    steps = max(config.num_levels - 1, 1)
    growth = math.exp(math.log(config.max_res / config.min_res) / steps)
    capacity = 2**config.log2_table_size
    resolutions: list[int] = []
    dense: list[bool] = []
    offsets = [0]
    for level in range(config.num_levels):
        # The small term keeps exact powers from falling to the integer below.
        resolution = math.floor(config.min_res * growth**level + 1e-6)
        vertices = (resolution + 1) ** 3
        resolutions.append(resolution)
        dense.append(vertices <= capacity)
        offsets.append(offsets[-1] + min(vertices, capacity))
    return LevelLayout(resolutions, dense, offsets)
