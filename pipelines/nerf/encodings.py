"""What the networks see of a place and of a direction: hash grid and spherical harmonics.

Symbols: L levels, F features per entry, E entries of all levels together, T = 2^log2_table_size
entries of a hashed level, N_l cells per side of level l. The definitions here are plain PyTorch and
differentiable; `kernels/` holds fast twins with the same values. The parameter layout is described
in README.md. Points arrive in unit space, [0, 1]^3; bounding the world is left to `contraction`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pipelines.nerf.config import HashGridConfig
from pipelines.nerf.errors import NerfError

HASH_PRIMES = (1, 2654435761, 805459861)
NUM_SPHERICAL_HARMONICS = 16
INIT_RANGE = 1e-3


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
    engine: "plain" for the PyTorch definition; "fast" uses the compiled twin where there is one
    for the table (float32, on the CPU or a CUDA GPU) and the plain definition elsewhere. The twin
    has no second derivatives: a loss on normals of the density in training needs "plain", and a
    backward pass through the twin with `create_graph` raises NerfError `bad_config`. Normals for
    pictures and exports take one derivative, which both engines have.
    """

    resolutions: Tensor
    dense: Tensor
    offsets: Tensor

    def __init__(self, config: HashGridConfig) -> None:
        super().__init__()
        layout = level_layout(config)
        self.config = config
        self.engine = "plain"
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
        encode = self._compiled_twin(unit_points)
        encoded = (encode or hash_encode)(unit_points, self.table, *self.active())
        if encode is not None and encoded.requires_grad:
            encoded.register_hook(_refuse_second_derivatives)  # type: ignore[no-untyped-call]
        missing = self.num_outputs - encoded.shape[-1]
        return nn.functional.pad(encoded, (0, missing)) if missing else encoded

    def _compiled_twin(self, unit_points: Tensor) -> Callable[..., Tensor] | None:
        """The kernel for where table and points are, if the engine wants one and there is one."""
        where = {self.table.device.type, unit_points.device.type}
        if self.engine != "fast" or self.table.dtype != torch.float32:
            return None
        # Imported here: a machine that only uses the plain definition never loads a compiler.
        if where == {"cpu"}:
            from pipelines.nerf.kernels.hash_grid import hash_encode_fast

            return hash_encode_fast
        if where == {"cuda"}:
            from pipelines.nerf.gpu.hash_grid import hash_encode_triton

            return hash_encode_triton
        return None


def _refuse_second_derivatives(gradient: Tensor) -> None:
    """A backward hook: to a second pass the compiled twin's gradients would be constants."""
    # Inside a backward pass gradients are only recorded when it was asked to create a graph.
    if torch.is_grad_enabled():
        raise NerfError(
            "bad_config",
            "The compiled hash grid has no second derivatives, which were asked for on features "
            f"{list(gradient.shape)}.",
            "Train normals with the engine 'plain'.",
        )


class SphericalHarmonics(nn.Module):
    """`spherical_harmonics` as a component: 16 values per direction, nothing trained."""

    num_outputs = NUM_SPHERICAL_HARMONICS

    def forward(self, directions: Tensor) -> Tensor:
        """Unit vectors [..., 3] to [..., 16]."""
        return spherical_harmonics(directions)


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Real spherical harmonics of degrees 0 to 3, in the order (l, m) with m from -l to l.

    directions: [..., 3], unit vectors. Returns [..., 16]; orthonormal over the sphere.
    Source: the polynomial forms of Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2013,
    with the Condon-Shortley phase.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3.0 * zz - 1.0),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5.0 * zz - 1.0),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            -0.4570457994644658 * x * (5.0 * zz - 1.0),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ],
        dim=-1,
    )
