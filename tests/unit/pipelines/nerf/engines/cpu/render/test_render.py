"""What rendering leaves out, each option against a slow twin made of the plain parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.engines.cpu.parts.density_net import DensityNet, pack_density
from pipelines.nerf.engines.cpu.parts.hash_lanes import pack_grid
from pipelines.nerf.engines.cpu.render.baked_grid import BakedGrid, bake_logits, look_up
from pipelines.nerf.engines.cpu.render.rays import pack_model, render_rays
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.fields import DensityField
from pipelines.nerf.options.render import ALL_SAMPLES, RenderConfig
from pipelines.nerf.space.rays import Rays
from tests.threads import torch_threads
from tests.unit.pipelines.nerf.engines.cpu.parts.test_hash_grid import random_model, random_rays

CELLS = 10


def render(model: Nerfacto, rays: Rays, options: RenderConfig) -> tuple[np.ndarray, ...]:
    packed = pack_model(model, options=options)
    return render_rays(packed, rays.origins.numpy(), rays.directions.numpy())


def network() -> DensityField:
    found = random_model().proposals[0]
    assert isinstance(found, DensityField)
    return found


def pack(net: DensityField) -> DensityNet:
    grid = net.grid
    arrays = pack_grid(grid.table, grid.resolutions, grid.dense, grid.offsets)
    return pack_density(arrays, net.mlp.layers)


def logits_at(net: DensityField, unit: torch.Tensor) -> np.ndarray:
    with torch.no_grad():
        logits: torch.Tensor = net.mlp(net.grid(unit)).squeeze(-1)
    return logits.numpy()


def test_a_baked_grid_holds_the_logits_of_the_network_at_its_vertices() -> None:
    net = network()
    grid = bake_logits(pack(net), CELLS).reshape((CELLS + 1,) * 3)
    side = torch.linspace(0.0, 1.0, CELLS + 1)
    z, y, x = torch.meshgrid(side, side, side, indexing="ij")
    expected = logits_at(net, torch.stack([x, y, z], dim=-1))
    assert expected.std() > 0.1
    np.testing.assert_allclose(grid, expected, atol=2e-3)  # a vertex may fall just beside itself


def test_a_baked_grid_is_no_finer_than_the_network() -> None:
    net = network()
    assert len(bake_logits(pack(net), 512)) == int(net.grid.resolutions[-1]) + 1


def test_a_grid_is_read_trilinearly_and_held_at_its_sides() -> None:
    n = CELLS + 1
    rng = np.random.default_rng(0)
    grid = rng.normal(size=(n, n * n)).astype(np.float32)
    points = rng.uniform(-0.1, 1.1, (3, 64)).astype(np.float32)
    found = np.zeros(64, np.float32)
    look_up(grid, points, 64, found)
    cube = grid.reshape(n, n, n)
    for column in range(64):
        place = np.clip(points[:, column].astype(np.float64), 0.0, 1.0) * CELLS
        cell = np.minimum(place.astype(int), CELLS - 1)
        x, y, z = place - cell
        i, j, k = cell
        expected = 0.0
        for dz, wz in ((0, 1 - z), (1, z)):
            for dy, wy in ((0, 1 - y), (1, y)):
                for dx, wx in ((0, 1 - x), (1, x)):
                    expected += wz * wy * wx * cube[k + dz, j + dy, i + dx]
        assert found[column] == pytest.approx(expected, abs=1e-5)


def test_a_baked_grid_is_kept_until_the_network_changes() -> None:
    net, baked = network(), BakedGrid()
    first = baked.of(pack(net), CELLS)
    assert baked.of(pack(net), CELLS) is first
    assert baked.of(pack(net), CELLS - 1) is not first
    with torch.no_grad():
        net.mlp.layers[-1].get_parameter("bias").add_(1.0)
    np.testing.assert_allclose(baked.of(pack(net), CELLS), first + 1.0, atol=1e-5)


def test_a_first_round_that_lies_in_the_grid_exactly_changes_nothing() -> None:
    """Where all levels but the constant one are empty, interpolation makes no error."""
    model, rays = random_model(), random_rays()
    first = model.proposals[0]
    assert isinstance(first, DensityField)
    with torch.no_grad():
        first.grid.table.zero_()
    exact = render(model, rays, ALL_SAMPLES)
    baked = render(model, rays, replace(ALL_SAMPLES, baked_cells=CELLS))
    np.testing.assert_allclose(baked[0], exact[0], atol=1e-3)
    np.testing.assert_allclose(baked[1], exact[1], atol=1e-3)


def _masses(weights: torch.Tensor, edges: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """What lies of a histogram between other edges, [R, S], by its cumulative sum."""
    found = []
    for row, at, new in zip(weights.double(), edges.double(), wanted.double(), strict=True):
        reached = np.concatenate([[0.0], np.cumsum(row.numpy())])
        found.append(np.diff(np.interp(new.numpy(), at.numpy(), reached)))
    return torch.from_numpy(np.stack(found)).float()


@pytest.mark.parametrize("background", ["last_sample", "black", "white"])
def test_samples_where_the_round_before_saw_little_hold_nothing(background: str) -> None:
    model = random_model(num_proposal_samples=(24,), background=background)
    rays = random_rays()
    with torch.no_grad():
        outputs = model(rays)
        (first, _), (samples, final) = outputs["weights"], outputs["samples"]
        masses = _masses(first, samples.s_edges, final.s_edges)
        if background == "last_sample":
            masses[:, -1] += 1.0 - first.sum(dim=-1)
        threshold = float(masses.median())
        density, geometry = model.field.density(final.positions(rays))
        asked = masses > threshold
        weights = weights_from_density(density * asked, final.t_edges)
        total = weights.sum(dim=-1)
        code = model.field.mean_code()
        assert code is not None
        colors = model.field.color(rays.directions, geometry, code.expand(len(rays), -1))
        if background == "last_sample":
            weights[:, -1] += (1.0 - total) * asked[:, -1]
            weights /= weights.sum(dim=-1, keepdim=True).clamp_min(1e-9)
        rgb = (weights[..., None] * colors).sum(dim=1)
        if background == "white":
            rgb += 1.0 - total[:, None]
    assert 0.1 < float((~asked).float().mean()) < 0.9
    found = render(model, rays, replace(ALL_SAMPLES, skip_below=threshold))
    close = (masses - threshold).abs().amin(dim=1) > 1e-6  # others may fall on either side
    close &= weights.sum(dim=-1) > 1e-6
    np.testing.assert_allclose(found[1][close], total[close], atol=2e-4)
    np.testing.assert_allclose(found[0][close], rgb[close], atol=2e-4)


@pytest.mark.parametrize("least", [0.05, 0.3, 1.0])
def test_samples_that_share_a_colour_have_that_of_their_mean_geometry(least: float) -> None:
    model, rays = random_model(), random_rays(40)
    with torch.no_grad():
        outputs = model(rays)
        weights, final = outputs["weights"][-1], outputs["samples"][-1]
        _, geometry = model.field.density(final.positions(rays))
        weights[:, -1] += 1.0 - weights.sum(dim=-1)
        code = model.field.mean_code()
        assert code is not None
        expected = torch.zeros(len(rays), 3)
        for ray in range(len(rays)):
            begin = 0
            for end in range(1, weights.shape[1] + 1):
                group = weights[ray, begin:end]
                if group.sum() > least or end == weights.shape[1]:
                    mean = (group[:, None] * geometry[ray, begin:end]).sum(dim=0)
                    mean = mean / group.sum().clamp_min(1e-20)
                    direction = rays.directions[ray : ray + 1]
                    color = model.field.color(direction, mean[None, None], code[None])
                    expected[ray] += group.sum() * color[0, 0]
                    begin = end
    found = render(model, rays, replace(ALL_SAMPLES, color_weight=least))
    exact = render(model, rays, ALL_SAMPLES)
    assert np.abs(found[0] - exact[0]).max() > 1e-3
    error = np.abs(found[0] - expected.numpy())
    # A group that ends just at the threshold may end at either sample.
    assert (error.max(axis=1) < 5e-4).mean() > 0.9
    for index in (1, 2, 3):
        np.testing.assert_array_equal(found[index], exact[index])


@pytest.mark.parametrize("background", ["last_sample", "black", "white"])
def test_stopping_early_changes_no_more_than_stated(background: str) -> None:
    model, rays = random_model(background=background), random_rays(400)
    with torch.no_grad():
        model.field.density_mlp.layers[-1].get_parameter("bias")[0] += 3.0
    exact = render(model, rays, ALL_SAMPLES)
    limit = 0.01
    quick = render(model, rays, replace(ALL_SAMPLES, early_stop=limit))
    assert 0.0 < np.abs(quick[0] - exact[0]).max() <= limit + 1e-5
    assert 0.0 < np.abs(quick[1] - exact[1]).max() <= limit + 1e-6
    np.testing.assert_array_equal(quick[2], exact[2])  # the median lies before any early stop


def test_a_ray_shows_the_same_whatever_the_threads_and_its_company() -> None:
    model, rays = random_model(), random_rays(100)
    packed = pack_model(model, options=RenderConfig(baked_cells=CELLS))
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    with torch_threads(1):
        alone = render_rays(packed, origins, directions)
    with torch_threads(2):
        together = render_rays(packed, origins, directions)
    parts = [
        render_rays(packed, origins[begin : begin + 7], directions[begin : begin + 7])
        for begin in range(0, 100, 7)
    ]
    for index in range(4):
        np.testing.assert_array_equal(together[index], alone[index])
        np.testing.assert_array_equal(np.concatenate([part[index] for part in parts]), alone[index])


def test_the_defaults_show_nearly_what_all_samples_show() -> None:
    model, rays = random_model(), random_rays(400)
    exact = render(model, rays, ALL_SAMPLES)
    quick = render(model, rays, RenderConfig())
    error = quick[0] - exact[0]
    # Above 40 dB, of a model of noise, where nothing can be told from its neighbours.
    assert 1e-5 < float(np.square(error).mean()) < 1e-4
    assert float(np.abs(error).max()) < 0.06
