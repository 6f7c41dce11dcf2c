"""The occupancy grid and the march: cells, updates, step lengths, what is left out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pipelines.nerf.along_ray.occupancy import OccupancyGrid, Stride, box_bounds, march
from pipelines.nerf.space.rays import Rays


def _grid(resolution: int = 8, cascades: int = 3, **changes: float) -> OccupancyGrid:
    return OccupancyGrid(resolution, cascades, **{"decay": 0.5, "threshold": 1.0, **changes})


def _ball(points: Tensor) -> Tensor:
    """Density 10 in the ball of radius 1/2, else 0."""
    return 10.0 * (points.norm(dim=-1) < 0.5).float()


def _rays(num: int, seed: int = 0) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    return Rays(
        6.0 * torch.rand(num, 3, generator=generator) - 3.0,
        torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1),
        torch.zeros(num, dtype=torch.int64),
    )


def test_a_point_lies_in_the_smallest_cascade_around_it() -> None:
    grid = _grid()
    for point in _rays(200).origins.mul(1.8).tolist():
        row, inside = grid.cell_of(torch.tensor(point))
        size = max(map(abs, point))
        assert bool(inside) == (size < 4.0)
        if size >= 4.0:
            continue
        cascade = next(c for c in range(3) if size < 2.0**c)
        x, y, z = (math.floor((p / 2.0**cascade + 1.0) / 2.0 * 8) for p in point)
        assert int(row) == cascade * 512 + (x * 8 + y) * 8 + z


def test_the_faces_between_cascades_belong_to_the_larger_one() -> None:
    row, inside = _grid().cell_of(torch.tensor([[1.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [4.0, 0, 0]]))
    assert (row[:2] // 512).tolist() == [1, 2]
    assert inside.tolist() == [True, True, False]


def test_a_new_grid_is_full_and_an_update_finds_the_ball() -> None:
    grid = _grid(16, 2)
    points = _rays(500).origins / 3.0
    assert bool(grid.contains(points).all())
    grid.update(_ball, everywhere=True, generator=torch.Generator().manual_seed(0))
    radius = points.norm(dim=-1)
    cell = math.sqrt(3.0) * 2.0 / 16
    assert bool(grid.contains(points[radius < 0.5 - cell]).all())
    assert not bool(grid.contains(points[radius > 0.5 + cell]).any())


def test_old_density_fades_and_the_larger_one_stays() -> None:
    grid = _grid(4, 1)
    grid.update(lambda points: torch.full(points.shape[:-1], 8.0), everywhere=True)
    grid.update(lambda points: torch.full(points.shape[:-1], 3.0), everywhere=True)
    assert torch.equal(grid.density, torch.full((1, 64), 4.0))  # max(8 / 2, 3)
    grid.update(lambda points: torch.full(points.shape[:-1], 3.0), everywhere=True)
    assert torch.equal(grid.density, torch.full((1, 64), 3.0))  # max(4 / 2, 3)
    assert float(grid.mean_density) == 3.0


def test_a_cell_is_full_above_the_threshold_or_above_the_mean_where_that_is_lower() -> None:
    values = torch.arange(64.0)  # mean 31.5

    def by_cell(points: Tensor) -> Tensor:
        return values[_grid(4, 1).cell_of(points)[0]]

    low, high = _grid(4, 1, threshold=9.5), _grid(4, 1, threshold=1000.0)
    for grid in (low, high):
        grid.update(by_cell, everywhere=True)
    assert torch.equal(low.occupied[0], values > 9.5)
    assert torch.equal(high.occupied[0], values > 31.5)


def test_a_cell_twice_as_wide_is_full_at_half_the_density() -> None:
    grid = _grid(4, 3, threshold=8.0)
    for density, full in ((9.0, [1, 1, 1]), (5.0, [0, 1, 1]), (3.0, [0, 0, 1]), (1.0, [0, 0, 0])):
        # A mean above the threshold, so that the threshold decides.
        grid.density.zero_()
        grid.density[:, 0] = 1e6

        def same(points: Tensor, density: float = density) -> Tensor:
            return torch.full(points.shape[:-1], density)

        grid.update(same, everywhere=True)
        assert grid.occupied[:, 1].int().tolist() == full


def test_an_empty_world_has_no_full_cell() -> None:
    grid = _grid(4, 1)
    grid.update(lambda points: torch.zeros(points.shape[:-1]), everywhere=True)
    assert not bool(grid.occupied.any())
    # and what appears later is found again
    grid.update(_ball, everywhere=False, generator=torch.Generator().manual_seed(0))
    assert bool(grid.occupied.any())


def test_a_partial_update_looks_at_a_quarter_of_all_and_at_full_cells() -> None:
    grid = _grid(8, 1, decay=1.0)
    grid.update(_ball, everywhere=True)
    full = grid.occupied.clone()
    seen: list[Tensor] = []

    def look(points: Tensor) -> Tensor:
        seen.append(grid.cell_of(points)[0])
        return torch.full(points.shape[:-1], 5.0)

    grid.update(look, everywhere=False, generator=torch.Generator().manual_seed(1))
    rows = torch.cat(seen)
    assert len(rows) == 2 * (512 // 4)
    assert bool(full[0, rows[128:]].all())
    assert not bool(full[0, rows[:128]].all())
    untouched = torch.ones(512, dtype=torch.bool)
    untouched[rows] = False
    assert bool((grid.density[0, ~untouched] >= 5.0).all())
    assert torch.equal(grid.density[0, untouched] > 0.0, full[0, untouched])


def test_each_cell_is_asked_at_a_place_inside_it() -> None:
    grid = _grid(4, 3)
    for generator in (None, torch.Generator().manual_seed(0)):
        rows: list[Tensor] = []

        def look(points: Tensor, rows: list[Tensor] = rows) -> Tensor:
            # Inner cells of outer cascades lie in an inner one: compare places, not rows.
            rows.append(points)
            return torch.zeros(points.shape[:-1])

        grid.update(look, everywhere=True, generator=generator)
        places = torch.cat(rows).reshape(3, 4, 4, 4, 3)
        for cascade in range(3):
            cell = torch.floor((places[cascade] / 2.0**cascade + 1.0) * 2.0).long()
            index = torch.arange(4)
            expected = torch.stack(torch.meshgrid(index, index, index, indexing="ij"), -1)
            assert torch.equal(cell, expected)


@pytest.mark.parametrize("cone_angle", [0.0, 1 / 64])
def test_counting_steps_and_distance_are_inverse(cone_angle: float) -> None:
    stride = Stride(0.01, cone_angle)
    t = torch.linspace(0.0, 20.0, 500, dtype=torch.float64)
    assert torch.allclose(stride.distance(stride.count(t)), t, atol=1e-12)


def test_steps_have_one_length_and_then_a_share_of_the_distance() -> None:
    stride = Stride(0.01, 1 / 64)
    assert stride.turn == pytest.approx(0.64)
    edges = stride.distance(torch.arange(0.0, 300.0, dtype=torch.float64))
    lengths, starts = edges.diff(), edges[:-1]
    near, far = edges[1:] < 0.64, starts > 0.64
    assert torch.allclose(lengths[near], torch.full_like(lengths[near], 0.01))
    share = math.expm1(1 / 64)  # of a step: t grows by e^(1/64)
    assert torch.allclose(lengths[far], share * starts[far])


def test_box_bounds_are_where_a_ray_is_inside() -> None:
    rays = _rays(300)
    enter, leave = box_bounds(rays.origins, rays.directions, 2.0, 0.1, 5.0)
    t = torch.linspace(0.1, 5.0, 4000)
    points = rays.origins[:, None] + rays.directions[:, None] * t[:, None]
    inside = (points.abs() < 2.0).all(dim=-1)
    found = (t > enter[:, None]) & (t < leave[:, None])
    assert float((inside != found).float().mean()) < 1e-3
    assert bool((leave < enter).any())


def test_a_level_ray_in_the_plane_of_a_face_has_finite_bounds() -> None:
    enter, leave = box_bounds(
        torch.tensor([[-3.0, 1.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]), 1.0, 0.05, 10.0
    )
    assert bool(enter.isfinite().all() and leave.isfinite().all())


def _march_by_loop(
    rays: Rays, grid: OccupancyGrid, near: float, far: float, stride: Stride
) -> list[tuple[int, float, float]]:
    found = []
    for index in range(len(rays)):
        one = rays.select(slice(index, index + 1))
        enter, leave = box_bounds(one.origins, one.directions, grid.half_side, near, far)
        start = float(stride.count(enter))
        for step in range(10_000):
            low, high = (float(stride.distance(torch.tensor(start + step + k))) for k in (0, 1))
            middle = 0.5 * (low + high)
            if middle >= float(leave):
                break
            if bool(grid.contains(one.origins[0] + middle * one.directions[0])):
                found.append((index, low, high))
    return found


@pytest.mark.parametrize("cone_angle", [0.0, 1 / 16])
def test_a_march_keeps_the_steps_in_full_cells(cone_angle: float) -> None:
    grid, rays, stride = _grid(8, 2), _rays(30), Stride(0.11, cone_angle)
    grid.update(_ball, everywhere=True)
    grid.occupied[1, ::3] = True
    samples = march(rays, grid, 0.05, 6.0, stride)
    expected = _march_by_loop(rays, grid, 0.05, 6.0, stride)
    assert 30 < len(samples) < 0.8 * 30 * 4.0 / 0.11
    # A midpoint on the face of a cell may fall on either side by rounding.
    assert abs(len(expected) - len(samples)) <= 2
    if len(expected) == len(samples):
        rows = torch.tensor(expected)
        assert torch.equal(rows[:, 0].long(), samples.ray)
        assert torch.allclose(rows[:, 1], samples.t_start, atol=1e-4)
        assert torch.allclose(rows[:, 2], samples.t_end, atol=1e-4)
    assert samples.num_rays == 30


def test_the_tiles_of_a_march_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, rays, stride = _grid(8, 2), _rays(50), Stride(0.1, 1 / 16)
    grid.update(_ball, everywhere=True)
    whole = march(rays, grid, 0.05, 6.0, stride)
    monkeypatch.setattr("pipelines.nerf.along_ray.occupancy.CANDIDATES_PER_CHUNK", {"cpu": 100})
    tiled = march(rays, grid, 0.05, 6.0, stride)
    assert torch.equal(whole.ray, tiled.ray)
    assert torch.equal(whole.t_start, tiled.t_start)


def test_a_generator_moves_the_steps_of_each_ray_by_less_than_one() -> None:
    grid, stride = _grid(8, 1), Stride(0.1, 0.0)
    rays = Rays(torch.zeros(9, 3), _rays(9).directions, torch.zeros(9, dtype=torch.int64))
    still = march(rays, grid, 0.2, 6.0, stride)
    moved = march(rays, grid, 0.2, 6.0, stride, generator=torch.Generator().manual_seed(0))
    first = torch.stack([moved.t_start[moved.ray == ray][0] for ray in range(9)]) - 0.2
    assert bool(((first >= 0.0) & (first < 0.1 + 1e-6)).all())
    assert float(first.std()) > 0.01
    again = march(rays, grid, 0.2, 6.0, stride, generator=torch.Generator().manual_seed(0))
    assert torch.equal(moved.t_start, again.t_start)
    assert float(still.t_start.min()) == pytest.approx(0.2)


def test_a_ray_that_misses_everything_has_no_samples() -> None:
    grid = _grid(8, 1)
    rays = Rays(
        torch.tensor([[5.0, 5.0, 5.0]]),
        torch.tensor([[0.0, 0.0, 1.0]]),
        torch.zeros(1, dtype=torch.int64),
    )
    assert len(march(rays, grid, 0.05, 100.0, Stride(0.1, 0.0))) == 0
    assert len(march(rays.select(slice(0, 0)), grid, 0.05, 100.0, Stride(0.1, 0.0))) == 0
