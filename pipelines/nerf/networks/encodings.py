"""What the networks see of a place and of a direction: hash grid and spherical harmonics.

Symbols: L levels, F features per entry, E entries of all levels together, T = 2^log2_table_size
entries of a hashed level, N_l cells per side of level l. The definitions here are plain PyTorch and
differentiable; the engines hold fast twins with the same values, which a grid is handed from above.
The parameter layout is described in README.md. Points arrive in unit space, [0, 1]^3; bounding the
world is left to `contraction`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.harmonics import NUM_SPHERICAL_HARMONICS, spherical_harmonics
from pipelines.nerf.space.hash_levels import HASH_PRIMES, level_layout

INIT_RANGE = 1e-3

HashEncode = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]
"""`hash_encode`, or a twin of it."""


def hash_encode(
    points: Tensor, table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
) -> Tensor:
    """Trilinear features of every level at each point.

    points: [..., 3] in [0, 1]; what lies outside is moved to the nearest face.
    table: [E, F]. resolutions [L], dense [L], offsets [L + 1]: as `level_layout`.
    Returns [..., L * F], coarsest level first; differentiable twice in `points` and `table`.
    Source: Instant-NGP, arXiv:2201.05989, section 3 and eq. 4.
    """
    lead = points.shape[:-1]
    num_levels, num_features = len(resolutions), table.shape[1]
    position = points.reshape(-1, 1, 3).clamp(0.0, 1.0) * resolutions[:, None].to(points.dtype)
    with torch.no_grad():
        # The far face belongs to the last cell, so that vertex N_l + 1 is never asked for.
        cell = torch.minimum(position.long(), resolutions[:, None] - 1)
    fraction = position - cell  # [P, L, 3]
    low, high = 1.0 - fraction, fraction

    indices, weights = [], []
    for corner in range(8):
        bits = (corner & 1, corner >> 1 & 1, corner >> 2 & 1)
        x, y, z = (part + bit for part, bit in zip(cell.unbind(-1), bits, strict=True))
        indices.append(_entry_index(x, y, z, resolutions, dense, offsets))
        parts = [(high if bit else low)[..., axis] for axis, bit in enumerate(bits)]
        weights.append(parts[0] * parts[1] * parts[2])
    index = torch.stack(indices)  # [8, P, L]; one gather, so one scatter in the backward pass
    entries = table.index_select(0, index.reshape(-1)).reshape(*index.shape, num_features)
    features = (torch.stack(weights)[..., None] * entries).sum(0)
    return features.reshape(*lead, num_levels * num_features)


def _entry_index(
    x: Tensor, y: Tensor, z: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
) -> Tensor:
    """Rows of the table that hold the vertices x, y, z, each [P, L] int64; returns [P, L]."""
    stride = resolutions + 1
    linear = x + stride * (y + stride * z)
    # T is a power of two, so the remainder in uint32 equals the low bits of the int64 product.
    mask = offsets[1:] - offsets[:-1] - 1
    hashed = (x ^ (y * HASH_PRIMES[1]) ^ (z * HASH_PRIMES[2])) & mask
    return torch.where(dense, linear, hashed) + offsets[:-1]


class HashGrid(nn.Module):
    """A trainable multi-resolution hash grid.

    table: [E, F] parameter, uniform in [-1e-3, 1e-3] at the start; 0 in levels that are learned
    later (`start_levels`), so that whoever reads all levels gets the same features.
    active_levels: the coarsest levels, those that are read and learned; all of them where nobody
    trains.
    encode: what reads the table, `hash_encode` unless an engine put its twin there
        (`Model.set_engine`). The compiled twins have no second derivatives: a loss on normals of
        the density in training needs the definition. Normals for pictures and exports take one
        derivative, which all have.
    """

    resolutions: Tensor
    dense: Tensor
    offsets: Tensor

    def __init__(self, config: HashGridConfig) -> None:
        super().__init__()
        layout = level_layout(config)
        self.config = config
        self.encode: HashEncode = hash_encode
        self.active_levels = config.num_levels
        table = torch.empty(layout.offsets[-1], config.features_per_level)
        table.uniform_(-INIT_RANGE, INIT_RANGE)
        table[layout.offsets[self.levels_at(0)] :] = 0.0
        self.table = nn.Parameter(table)
        self.register_buffer("offsets", torch.tensor(layout.offsets, dtype=torch.int64))
        self.register_buffer("resolutions", torch.tensor(layout.resolutions, dtype=torch.int64))
        self.register_buffer("dense", torch.tensor(layout.dense, dtype=torch.bool))

    @property
    def num_outputs(self) -> int:
        """Features per point, L * F."""
        return self.config.num_levels * self.config.features_per_level

    def levels_at(self, step: int) -> int:
        """How many levels, coarsest first, a training step reads and learns; all in the end.

        Source: the coarse-to-fine schedule of Neuralangelo, arXiv:2306.03092, section 3.3.
        """
        config = self.config
        first = config.start_levels or config.num_levels
        return min(config.num_levels, first + step // config.steps_per_level)

    def active(self) -> tuple[Tensor, Tensor, Tensor]:
        """(resolutions, dense, offsets) of the active levels, as `hash_encode` takes them."""
        count = self.active_levels
        return self.resolutions[:count], self.dense[:count], self.offsets[: count + 1]

    def forward(self, unit_points: Tensor) -> Tensor:
        """Features [..., L * F] at points [..., 3] in [0, 1]^3; 0 in levels that are not active."""
        encoded = self.encode(unit_points, self.table, *self.active())
        missing = self.num_outputs - encoded.shape[-1]
        return nn.functional.pad(encoded, (0, missing)) if missing else encoded


class SphericalHarmonics(nn.Module):
    """`spherical_harmonics` as a component: 16 values per direction, nothing trained."""

    num_outputs = NUM_SPHERICAL_HARMONICS

    def forward(self, directions: Tensor) -> Tensor:
        """Unit vectors [..., 3] to [..., 16]."""
        return spherical_harmonics(directions)
