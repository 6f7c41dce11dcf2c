"""Which code reads a hash grid, and what the compiled one refuses."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from pipelines.nerf.engines.hash_encoders import hash_encode_compiled
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.encodings import HashGrid, hash_encode
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig

SMALL = HashGridConfig(num_levels=4, min_res=3, max_res=24, log2_table_size=8, features_per_level=2)


def test_the_compiled_grid_refuses_second_derivatives() -> None:
    torch.manual_seed(0)
    grid = HashGrid(SMALL)
    points = torch.rand(5, 3, requires_grad=True)
    (once,) = torch.autograd.grad(grid(points).sum(), points)
    grid.encode = hash_encode_compiled
    (found,) = torch.autograd.grad(grid(points).sum(), points)
    assert torch.allclose(found, once, atol=1e-6)
    with pytest.raises(NerfError, match="engine 'plain'") as caught:
        torch.autograd.grad(grid(points).sum(), points, create_graph=True)
    assert caught.value.code == "bad_config"


@pytest.mark.parametrize(
    ("num_features", "dtype"), [(1, torch.float32), (4, torch.float32), (2, torch.float64)]
)
def test_a_table_without_a_kernel_is_read_by_the_definition(
    num_features: int, dtype: torch.dtype
) -> None:
    torch.manual_seed(0)
    config = HashGridConfig(
        num_levels=4, min_res=3, max_res=24, log2_table_size=8, features_per_level=num_features
    )
    grid = HashGrid(config).to(dtype)
    points = torch.rand(5, 3, dtype=dtype, requires_grad=True)
    plain = grid(points)
    grid.encode = hash_encode_compiled
    found = grid(points)
    assert torch.equal(found, plain)
    # The definition has second derivatives too.
    (once,) = torch.autograd.grad(found.square().sum(), points, create_graph=True)
    once.square().sum().backward()
    assert grid.table.grad is not None


def test_an_engine_is_handed_to_every_grid_of_a_model() -> None:
    config = NerfactoConfig(grid=SMALL, proposals=(ProposalConfig(grid=SMALL),) * 2)
    model = Nerfacto(config, 3)
    grids = [module for module in model.modules() if isinstance(module, HashGrid)]
    assert [grid.encode for grid in grids] == [hash_encode] * 3
    model.set_engine("fast")
    assert [grid.encode for grid in grids] == [hash_encode_compiled] * 3
    model.set_engine("plain")
    assert [grid.encode for grid in grids] == [hash_encode] * 3


def test_the_plain_engine_loads_no_compiler() -> None:
    program = """
import sys, torch
import pipelines.nerf.models.nerfacto
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.parts import HashGridConfig
HashGrid(HashGridConfig(num_levels=2, max_res=20, log2_table_size=8))(torch.rand(4, 3))
print("numba" in sys.modules)
"""
    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert loaded.stdout.split() == ["False"]
