"""Grids of values with linear interpolation, whole or factored into lines and planes.

Symbols: N vertices per side (the resolution), F features, Q components (the rank), P points. A unit
coordinate u in [0, 1] lies at u (N - 1) between vertices 0..N - 1, so that the outer vertices stand
on the faces of the unit cube; what lies outside is moved to the nearest face, as in the hash grid.
Mixing the components into density or colour is left to a linear layer behind these encodings.
Everything is plain PyTorch and can be differentiated twice.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor, nn

from pipelines.nerf.errors import NerfError

INITIAL_SCALE = 0.1
"""Standard deviation of the values at the start, as in TensoRF."""

PLANE_AXES = ((1, 2), (0, 2), (0, 1))
"""The two axes of the plane that goes with the line along axis 0, 1 and 2."""


def interpolate(vertices: Tensor, coordinates: Tensor) -> Tensor:
    """Multilinear interpolation in a grid of D dimensions.

    vertices: [N, .., N, F], D axes of N >= 2 vertices. coordinates: [P, D] in [0, 1].
    Returns [P, F]; differentiable twice in both.
    """
    num_axes, size = coordinates.shape[-1], vertices.shape[0]
    position = coordinates.clamp(0.0, 1.0) * (size - 1)
    with torch.no_grad():
        # The far face belongs to the last cell, so that no vertex behind it is asked for.
        cell = position.long().clamp_max(size - 2)
    fraction = position - cell
    table = vertices.reshape(-1, vertices.shape[-1])
    total = torch.zeros((), dtype=table.dtype, device=table.device)
    for corner in product((0, 1), repeat=num_axes):
        row = torch.zeros_like(cell[:, 0])
        weight = torch.ones_like(fraction[:, 0])
        for axis, bit in enumerate(corner):
            row = row * size + cell[:, axis] + bit
            weight = weight * (fraction[:, axis] if bit else 1.0 - fraction[:, axis])
        total = total + weight[:, None] * table.index_select(0, row)
    return total


def resample(vertices: Tensor, axes: tuple[int, ...], resolution: int) -> Tensor:
    """The same function of place on a grid of `resolution` vertices along `axes`.

    Linear interpolation of the old vertices. Where N - 1 divides resolution - 1 every old vertex
    is a new one and keeps its value, and the interpolated function stays what it was.
    """
    for axis in axes:
        old = vertices.shape[axis]
        # k (N - 1) is a whole number, so the quotient is exact where the grids share a vertex.
        steps = torch.arange(resolution, device=vertices.device) * (old - 1)
        position = steps.to(torch.float64) / (resolution - 1)
        low = position.long().clamp_max(old - 2)
        shape = [-1 if at == axis % vertices.dim() else 1 for at in range(vertices.dim())]
        share = (position - low).to(vertices.dtype).reshape(shape)
        vertices = torch.lerp(
            vertices.index_select(axis, low), vertices.index_select(axis, low + 1), share
        )
    return vertices


class CPEncoding(nn.Module):
    """Rank-one components: the product of one factor along each axis.

    lines: [3, N, Q] parameter. resolution: N >= 2 vertices. rank: Q.
    A saved grid that was refined is loaded into one made with its refined resolution.
    Source: TensoRF, arXiv:2203.09517, section 3 (CANDECOMP/PARAFAC decomposition).
    """

    def __init__(self, resolution: int, rank: int) -> None:
        super().__init__()
        _check(resolution, rank)
        self.lines = nn.Parameter(INITIAL_SCALE * torch.randn(3, resolution, rank))

    @property
    def resolution(self) -> int:
        """Vertices per side."""
        return self.lines.shape[1]

    @property
    def num_outputs(self) -> int:
        """Features per point, Q."""
        return self.lines.shape[2]

    def forward(self, unit_points: Tensor) -> Tensor:
        """v1_q(x) v2_q(y) v3_q(z) for every q: [..., 3] in [0, 1] to [..., Q]."""
        points = unit_points.reshape(-1, 3)
        x, y, z = (interpolate(self.lines[axis], points[:, axis, None]) for axis in range(3))
        return (x * y * z).reshape(*unit_points.shape[:-1], self.num_outputs)

    @torch.no_grad()
    def upsample(self, resolution: int) -> None:
        """Refine to `resolution` vertices; the parameter is new, so its optimiser must be too."""
        _check(resolution, self.num_outputs)
        self.lines = nn.Parameter(resample(self.lines, (1,), resolution))


class VMEncoding(nn.Module):
    """Vector-matrix components: a factor along one axis times one over the plane of the others.

    lines: [3, N, Q]; planes: [3, N, N, Q], axes as `PLANE_AXES`. resolution: N >= 2. rank: Q per
    mode. A saved grid that was refined is loaded into one made with its refined resolution.
    Source: TensoRF, arXiv:2203.09517, section 3 (VM decomposition).
    """

    def __init__(self, resolution: int, rank: int) -> None:
        super().__init__()
        _check(resolution, rank)
        self.lines = nn.Parameter(INITIAL_SCALE * torch.randn(3, resolution, rank))
        self.planes = nn.Parameter(INITIAL_SCALE * torch.randn(3, resolution, resolution, rank))

    @property
    def resolution(self) -> int:
        """Vertices per side."""
        return self.lines.shape[1]

    @property
    def num_outputs(self) -> int:
        """Features per point, 3 Q."""
        return 3 * self.lines.shape[2]

    def forward(self, unit_points: Tensor) -> Tensor:
        """v1_q(x) M23_q(y, z), v2_q(y) M13_q(x, z), v3_q(z) M12_q(x, y), mode after mode.

        unit_points: [..., 3] in [0, 1]. Returns [..., 3 Q].
        """
        points = unit_points.reshape(-1, 3)
        features = [
            interpolate(self.lines[axis], points[:, axis, None])
            * interpolate(self.planes[axis], points[:, plane_axes])
            for axis, plane_axes in enumerate(PLANE_AXES)
        ]
        return torch.cat(features, dim=-1).reshape(*unit_points.shape[:-1], self.num_outputs)

    @torch.no_grad()
    def upsample(self, resolution: int) -> None:
        """Refine to `resolution` vertices; the parameters are new, so their optimiser must be."""
        _check(resolution, self.lines.shape[2])
        self.lines = nn.Parameter(resample(self.lines, (1,), resolution))
        self.planes = nn.Parameter(resample(self.planes, (1, 2), resolution))


class VoxelGrid(nn.Module):
    """A dense grid of features with trilinear interpolation.

    vertices: [N, N, N, F] parameter, axes x, y, z. resolution: N >= 2. num_features: F.
    A saved grid that was refined is loaded into one made with its refined resolution.
    Source: the dense grid that TensoRF, arXiv:2203.09517, section 3 factors.
    """

    def __init__(self, resolution: int, num_features: int) -> None:
        super().__init__()
        _check(resolution, num_features)
        shape = (resolution, resolution, resolution, num_features)
        self.vertices = nn.Parameter(INITIAL_SCALE * torch.randn(shape))

    @property
    def resolution(self) -> int:
        """Vertices per side."""
        return self.vertices.shape[0]

    @property
    def num_outputs(self) -> int:
        """Features per point, F."""
        return self.vertices.shape[3]

    def forward(self, unit_points: Tensor) -> Tensor:
        """Features [..., F] at points [..., 3] in [0, 1]^3."""
        features = interpolate(self.vertices, unit_points.reshape(-1, 3))
        return features.reshape(*unit_points.shape[:-1], self.num_outputs)

    @torch.no_grad()
    def upsample(self, resolution: int) -> None:
        """Refine to `resolution` vertices; the parameter is new, so its optimiser must be too."""
        _check(resolution, self.num_outputs)
        self.vertices = nn.Parameter(resample(self.vertices, (0, 1, 2), resolution))


def _check(resolution: int, num_features: int) -> None:
    if resolution < 2 or num_features < 1:
        raise NerfError(
            "bad_config",
            f"A grid of {resolution} vertices per side and {num_features} features cannot be made.",
            "Give at least 2 vertices per side and 1 feature or component.",
        )
