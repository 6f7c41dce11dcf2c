"""Where there is something: grids of cells, and the march along rays that leaves out empty ones.

Symbols: C cascades, N cells per side; cascade c covers [-2^c, 2^c]^3 in scene space. `t` distance
along a unit ray, scene units; `g` the same counted in steps. Where the density comes from is left
to a function. Source: Instant-NGP, arXiv:2201.05989, appendix E.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pipelines.nerf.along_ray.packed import PackedSamples
from pipelines.nerf.space.rays import Rays

DensityFunction = Callable[[Tensor], Tensor]
"""Scene points [..., 3] to densities [...], per scene unit."""

SCENE_DIAGONAL = 2.0 * math.sqrt(3.0)
"""Of [-1, 1]^3, scene units."""
POINTS_PER_UPDATE = {"cpu": 2**16, "cuda": 2**19}
"""Cells whose density is asked for at once, by kind of device."""
CANDIDATES_PER_CHUNK = {"cpu": 2**18, "cuda": 2**24}
"""Intervals that are looked up at once, by kind of device."""
LOWEST_THRESHOLD = 1e-6
"""Per scene unit: a cell whose density is below it is empty even in a grid of empty cells."""


class OccupancyGrid(nn.Module):
    """Which cells hold matter; state that is saved with the model.

    resolution: N. num_cascades: C. decay: share of a cell's density that is left at an update.
    threshold: density per scene unit above which a cell of the first cascade is full; where the
        mean of all cells is lower, that. Cascade c takes 2^-c of it, since cells and steps are
        longer there: by one limit for all, what is far and thin would be lost for good.
        A new grid is full everywhere.
    density: [C, N^3], largest recent density of each cell, x slowest. occupied: [C, N^3] bool.
    mean_density: [], over all cells; 0 in a new grid.
    """

    density: Tensor
    occupied: Tensor
    mean_density: Tensor

    def __init__(
        self, resolution: int, num_cascades: int, *, decay: float, threshold: float
    ) -> None:
        super().__init__()
        self.resolution, self.num_cascades = resolution, num_cascades
        self.decay, self.threshold = decay, threshold
        shape = (num_cascades, resolution**3)
        self.register_buffer("density", torch.zeros(shape))
        self.register_buffer("occupied", torch.ones(shape, dtype=torch.bool))
        self.register_buffer("mean_density", torch.zeros(()))

    @property
    def half_side(self) -> float:
        """Half the side of the outermost cascade, scene units."""
        return float(2 ** (self.num_cascades - 1))

    def cell_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Rows [...] of the flattened grids, and whether the points lie in any, [...] bool.

        points: [..., 3], scene space. A point belongs to the smallest cascade around it.
        """
        size = points.abs().amax(dim=-1)
        # size = m 2^e with m in [1/2, 1): the smallest power of two above it is 2^e.
        cascade = torch.frexp(size).exponent.clamp(0, self.num_cascades - 1)
        unit = points * torch.exp2(-cascade.to(points.dtype))[..., None] * 0.5 + 0.5
        cell = (unit * self.resolution).long().clamp_(0, self.resolution - 1)
        x, y, z = cell.unbind(-1)
        row = ((cascade.long() * self.resolution + x) * self.resolution + y) * self.resolution + z
        return row, size < self.half_side

    def contains(self, points: Tensor) -> Tensor:
        """Whether points [..., 3] of scene space lie in full cells; [...] bool."""
        row, inside = self.cell_of(points)
        return self.occupied.view(-1)[row] & inside

    @torch.no_grad()
    def update(
        self,
        density: DensityFunction,
        *,
        everywhere: bool,
        generator: torch.Generator | None = None,
    ) -> None:
        """Let the old densities fade, look at cells anew and keep the larger of both.

        everywhere: look at every cell; else at a quarter of their number drawn from all and at a
            quarter drawn from full ones.
        generator: random numbers on the grid's device, for a place in each cell and for the cells;
            None for the centres, with `everywhere` alone.
        """
        rows = None if everywhere else self._drawn_rows(generator)
        total = self.density.numel()
        known = self.density.view(-1)
        known.mul_(self.decay)
        count = total if rows is None else len(rows)
        tile = POINTS_PER_UPDATE.get(known.device.type, POINTS_PER_UPDATE["cpu"])
        for begin in range(0, count, tile):
            end = min(begin + tile, count)
            if rows is None:
                chosen = torch.arange(begin, end, device=known.device)
            else:
                chosen = rows[begin:end]
            found = density(self._places(chosen, generator)).to(known.dtype)
            # A cell that was drawn twice gets the larger one, in any order.
            known.scatter_reduce_(0, chosen, found, "amax")
        self.mean_density.copy_(self.density.mean())
        limit = self.mean_density.clamp(LOWEST_THRESHOLD, max(self.threshold, LOWEST_THRESHOLD))
        widths = torch.exp2(torch.arange(self.num_cascades, device=limit.device))[:, None]
        self.occupied.copy_(self.density > limit / widths)

    def _drawn_rows(self, generator: torch.Generator | None) -> Tensor:
        total, device = self.occupied.numel(), self.occupied.device
        quarter = max(1, total // 4)
        drawn = torch.randint(total, (quarter,), generator=generator, device=device)
        full = self.occupied.view(-1).nonzero().squeeze(-1)
        if len(full) == 0:
            return drawn
        picked = torch.randint(len(full), (quarter,), generator=generator, device=device)
        return torch.cat([drawn, full[picked]])

    def _places(self, rows: Tensor, generator: torch.Generator | None) -> Tensor:
        """A place [K, 3] in scene space in each of the cells [K]."""
        n = self.resolution
        cell = torch.stack([rows // n**2 % n, rows // n % n, rows % n], dim=-1)
        offset: float | Tensor = 0.5
        if generator is not None:
            offset = torch.rand(cell.shape, generator=generator, device=cell.device)
        side = torch.exp2((rows // n**3).float())[:, None]
        return ((cell + offset) * (2.0 / n) - 1.0) * side


@dataclass(frozen=True)
class Stride:
    """Step lengths that grow with the distance: max(`length`, `cone_angle` * t).

    g(t) counts the steps from the camera: t / length up to the distance where both are equal, and
    from there on so that dg/dt = 1 / (cone_angle t).
    Source: Instant-NGP, arXiv:2201.05989, appendix E.1, whose steps approach it.
    """

    length: float
    cone_angle: float

    @property
    def turn(self) -> float:
        """Distance from which steps grow, scene units."""
        return self.length / self.cone_angle if self.cone_angle > 0.0 else math.inf

    def count(self, t: Tensor) -> Tensor:
        """g of distances t >= 0, scene units; same shape."""
        near = t / self.length
        if self.cone_angle == 0.0:
            return near
        start = self.turn / self.length
        beyond = start + torch.log(t.clamp_min(self.turn) / self.turn) / self.cone_angle
        return torch.where(t < self.turn, near, beyond)

    def distance(self, g: Tensor) -> Tensor:
        """The inverse of `count`."""
        near = g * self.length
        if self.cone_angle == 0.0:
            return near
        start = self.turn / self.length
        beyond = self.turn * torch.exp((g.clamp_min(start) - start) * self.cone_angle)
        return torch.where(g < start, near, beyond)


@torch.no_grad()
def march(
    rays: Rays,
    grid: OccupancyGrid,
    near: float,
    far: float,
    stride: Stride,
    *,
    generator: torch.Generator | None = None,
) -> PackedSamples:
    """The steps of each ray through the grid whose midpoints lie in full cells.

    near, far: scene units. generator: moves the steps of each ray by one random share of a step;
    without one they begin where the ray enters the grid.
    Samples carry no gradient to the rays.
    """
    origins, directions = rays.origins.detach(), rays.directions.detach()
    enter, leave = box_bounds(origins, directions, grid.half_side, near, far)
    start, stop = stride.count(enter), stride.count(leave)
    if generator is not None:
        start = start + torch.rand(
            start.shape, generator=generator, device=start.device, dtype=start.dtype
        )
    longest = int((stop - start).clamp_min(0.0).amax().ceil().item()) if len(rays) else 0
    budget = CANDIDATES_PER_CHUNK.get(origins.device.type, CANDIDATES_PER_CHUNK["cpu"])
    tile = max(1, budget // max(longest, 1))
    step = torch.arange(longest + 1, device=origins.device, dtype=origins.dtype)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for begin in range(0, len(rays), tile):
        part = slice(begin, begin + tile)
        edges = stride.distance(start[part, None] + step)
        middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
        points = torch.addcmul(origins[part, None], directions[part, None], middles[..., None])
        kept = grid.contains(points) & (middles < leave[part, None])
        row, column = kept.nonzero(as_tuple=True)
        found.append((row + begin, edges[row, column], edges[row, column + 1]))
    if not found:
        nothing = origins.new_zeros(0)
        return PackedSamples(nothing.long(), nothing, nothing, len(rays))
    ray, t_start, t_end = (torch.cat(parts) for parts in zip(*found, strict=True))
    return PackedSamples(ray, t_start, t_end, len(rays))


def box_bounds(
    origins: Tensor, directions: Tensor, half_side: float, near: float, far: float
) -> tuple[Tensor, Tensor]:
    """Distances [R] at which rays enter and leave the cube [-h, h]^3, within [near, far].

    origins, directions: [R, 3]. half_side: h, scene units. A ray that misses the cube leaves before
    it enters.
    """
    # A direction of 0 would divide 0 by 0 for a ray in the plane of a face.
    safe = torch.where(directions.abs() < 1e-9, 1e-9, directions)
    first, second = (-half_side - origins) / safe, (half_side - origins) / safe
    enter = torch.minimum(first, second).amax(dim=-1).clamp_min(near)
    leave = torch.maximum(first, second).amin(dim=-1).clamp_max(far)
    return enter, leave
