"""Every compiled kernel against its plain twin."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.nerf.engines.cpu.parts.dense_layers import TILE, apply_layer, pack_layer
from pipelines.nerf.engines.cpu.parts.hash_grid import hash_encode_fast
from pipelines.nerf.engines.cpu.render.rays import pack_model, render_rays
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.networks.fields import MLP, DensityField, NerfactoField
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.rays import Rays

SMALL = HashGridConfig(num_levels=5, max_res=100, log2_table_size=12)


@pytest.fixture(params=[1, 2], ids=["one thread", "two threads"])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def random_grid(config: HashGridConfig) -> HashGrid:
    torch.manual_seed(0)
    grid = HashGrid(config)
    grid.table.data.normal_()
    return grid


def test_hash_grid_equals_its_plain_twin(threads: int) -> None:
    grid = random_grid(SMALL)
    points = (torch.rand(700, 3) * 1.2 - 0.1).requires_grad_()
    with torch.no_grad():
        points[:2] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    plain = grid(points)
    upstream = torch.randn_like(plain)
    plain_grads = torch.autograd.grad(plain, (points, grid.table), upstream)
    grid.encode = hash_encode_fast
    fast = grid(points)
    fast_grads = torch.autograd.grad(fast, (points, grid.table), upstream)
    assert (fast - plain).abs().max() < 2e-6
    assert (fast_grads[1] - plain_grads[1]).abs().max() < 1e-5
    assert plain_grads[0].abs().max() > 100.0  # slopes are per unit, cells are small
    assert (fast_grads[0] - plain_grads[0]).abs().max() < 1e-3


def test_hash_grid_gradient_repeats_to_the_bit(threads: int) -> None:
    grid = random_grid(SMALL)
    grid.encode = hash_encode_fast
    points = torch.rand(5000, 3)

    def gradient() -> torch.Tensor:
        (found,) = torch.autograd.grad(grid(points).square().sum(), grid.table)
        return found

    assert torch.equal(gradient(), gradient())


def test_hash_grid_survives_points_that_are_not_numbers() -> None:
    grid = random_grid(SMALL)
    grid.encode = hash_encode_fast
    points = torch.tensor([[float("nan"), 0.5, 0.5], [float("inf"), -float("inf"), 0.5]])
    assert torch.isfinite(grid(points)[1]).all()


@pytest.mark.parametrize(("change", "problem"), [("type", "float32"), ("features", "2 features")])
def test_hash_grid_refuses_a_table_it_cannot_read(change: str, problem: str) -> None:
    grid = random_grid(replace(SMALL, features_per_level=3 if change == "features" else 2))
    table = grid.table.double() if change == "type" else grid.table
    with pytest.raises(ValueError, match=problem):
        hash_encode_fast(torch.rand(4, 3), table, grid.resolutions, grid.dense, grid.offsets)


@pytest.mark.parametrize(("inputs", "outputs", "count"), [(7, 3, 5), (32, 64, TILE), (10, 16, 17)])
def test_layer_equals_linear_and_relu(inputs: int, outputs: int, count: int) -> None:
    torch.manual_seed(0)
    linear = torch.nn.Linear(inputs, outputs)
    packed = pack_layer(linear)
    x = np.random.default_rng(0).normal(size=(inputs, TILE)).astype(np.float32)
    out = np.zeros((len(packed.bias), TILE), np.float32)
    expected = linear(torch.from_numpy(x.T)).detach().numpy().T[:, :count]
    apply_layer(x, packed, count, False, False, out)
    np.testing.assert_allclose(out[:outputs, :count], expected, atol=1e-5)
    before = out.copy()
    apply_layer(x, packed, count, False, True, out)  # adds the products, not the bias
    products = expected - linear.bias.detach().numpy()[:, None]
    np.testing.assert_allclose(
        out[:outputs, :count], before[:outputs, :count] + products, atol=1e-5
    )
    apply_layer(x, packed, count, True, False, out)
    np.testing.assert_allclose(out[:outputs, :count], expected.clip(0.0), atol=1e-5)


def last_layer(mlp: MLP) -> torch.nn.Linear:
    """The layer of an MLP that has no ReLU behind it."""
    last = mlp.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    return last


def random_model(**changes: object) -> Nerfacto:
    """A small model whose densities reach from fog to walls."""
    torch.manual_seed(1)
    settings: dict[str, object] = {
        "num_proposal_samples": (24, 12),
        "num_nerf_samples": 20,
        "grid": SMALL,
        "proposals": (ProposalConfig(grid=SMALL), ProposalConfig(grid=SMALL, hidden_dim=12)),
        "appearance_dim": 6,
        "far": 100.0,
    }
    model = Nerfacto(NerfactoConfig(**(settings | changes)), 4).eval()  # type: ignore[arg-type]
    for module in model.modules():
        if isinstance(module, HashGrid):
            module.table.data.normal_()
    with torch.no_grad():
        for network in (model.field, *model.proposals):
            assert isinstance(network, NerfactoField | DensityField)
            mlp = network.density_mlp if isinstance(network, NerfactoField) else network.mlp
            last = last_layer(mlp)
            last.weight[0] *= 8.0
            last.bias[0] += 4.0
        last_layer(model.field.color_mlp).weight.mul_(8.0)
    return model


def random_rays(count: int = 101) -> Rays:
    generator = torch.Generator().manual_seed(2)
    directions = torch.randn(count, 3, generator=generator)
    return Rays(
        torch.rand(count, 3, generator=generator) - 0.5,
        torch.nn.functional.normalize(directions, dim=-1),
        torch.zeros(count, dtype=torch.int64),
    )


def assert_close(found: np.ndarray, expected: np.ndarray) -> None:
    """Equal to rounding: in a field of noise a few rays amplify it, since their samples move."""
    error = np.abs(found - expected)
    assert error.mean() < 5e-5
    assert error.max() < 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"contraction": "l2", "background": "white"},
        {"contraction": "none", "background": "black", "appearance_dim": 0},
        {"hidden_dim": 19, "hidden_dim_color": 33, "geo_feature_dim": 5, "background": "random"},
        {"share_proposal_network": True, "num_nerf_samples": 1},
    ],
    ids=str,
)
def test_rendered_rays_equal_the_plain_model(changes: dict[str, object], threads: int) -> None:
    model, rays = random_model(**changes), random_rays()
    with torch.no_grad():
        plain = model(rays)
    rgb, accumulation, median, expected = render_rays(
        pack_model(model), rays.origins.numpy(), rays.directions.numpy()
    )
    assert plain["rgb"].std() > 0.02
    assert_close(rgb, plain["rgb"].numpy())
    assert_close(accumulation, plain["accumulation"].numpy())
    np.testing.assert_allclose(expected, plain["expected_depth"], rtol=1e-3)
    # A ray whose half-way weight falls on the edge of two samples may choose either.
    same = np.isclose(median, plain["depth"].numpy(), rtol=1e-3)
    assert same.mean() > 0.98


def test_appearance_chooses_the_code_of_an_image() -> None:
    model, rays = random_model(), random_rays()
    with torch.no_grad():
        plain = model(rays, appearance=2)["rgb"].numpy()
    arrays = rays.origins.numpy(), rays.directions.numpy()
    assert_close(render_rays(pack_model(model, appearance=2), *arrays)[0], plain)
    assert np.abs(render_rays(pack_model(model), *arrays)[0] - plain).max() > 1e-3


def test_kernels_compile_into_the_folder_that_is_asked_for(tmp_path: Path) -> None:
    code = (
        "from pipelines.nerf.engines.cpu.parts.dense_layers import apply_layer, pack_layer, TILE;"
        "import numpy as np, torch;"
        "apply_layer(np.zeros((4, TILE), np.float32), pack_layer(torch.nn.Linear(4, 4)), 4, True,"
        " False, np.zeros((4, TILE), np.float32))"
    )
    environment = {**os.environ, "NERFWORKS_HOME": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, timeout=120)
    assert list((tmp_path / "numba").glob("kernels-*/**/*.nbi"))
