"""Compiles the Triton kernels for GPUs that need not be there; run by `test_compile`.

    python -m tests.unit.pipelines.nerf.engines.gpu.compile_kernels 90 75 80 120

For the first architecture every kernel that training and rendering launch with the paper's sizes,
for the others the largest. Each kernel becomes one line of JSON: the fields of
`pretend_gpu.Compiled`, with "arch" and "resident_share".
"""

from __future__ import annotations

import json
import sys

import torch
from torch import Tensor

from pipelines.nerf.engines.gpu.parts.hash_grid import hash_encode_triton
from pipelines.nerf.engines.gpu.parts.mlp import fused_mlp
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.networks.fields import MLP
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from tests.unit.pipelines.nerf.engines.gpu.pretend_gpu import PretendGpu

NUM_POINTS = 4096
FUSED_FROM = 80
"""`mlp.has_room`: older matrix units are not Triton's."""
PAPER = NerfactoConfig()


def encode(grid: HashGrid, points: Tensor, lookup: Tensor | None = None) -> Tensor:
    """What `HashGrid.forward` asks for on a GPU."""
    levels = (grid.resolutions, grid.dense, grid.offsets)
    return hash_encode_triton(points, grid.table, *levels, lookup=lookup)


def learn(grid: HashGrid, points: Tensor) -> None:
    """Forward and backward, as a training step does it; points that require a gradient get one."""
    with torch.autocast("cpu", torch.float16):
        features = encode(grid, points)
    torch.autograd.backward(features.sum())


def launch_all() -> None:
    """Every launch of training and rendering, with the paper's sizes."""
    points = torch.zeros(NUM_POINTS, 3)
    proposal = HashGrid(PAPER.proposals[0].grid)
    learn(proposal, points)
    learn(HashGrid(PAPER.grid), points.clone().requires_grad_())
    for grid in (proposal, HashGrid(PAPER.grid)):
        encode(grid, points, grid.table.detach().half())
    for widths in [(10, 16, 1), (32, 64, 16), (63, 64, 64, 3)]:
        values = torch.zeros(NUM_POINTS, widths[0], requires_grad=True)
        torch.autograd.backward(fused_mlp(values, MLP(*widths).layers).sum())


def launch_largest(arch: int) -> None:
    """Both gradients of the field's grid; of the networks the deepest."""
    learn(HashGrid(PAPER.grid), torch.zeros(NUM_POINTS, 3, requires_grad=True))
    if arch >= FUSED_FROM:
        with torch.no_grad():
            fused_mlp(torch.zeros(NUM_POINTS, 63), MLP(63, 64, 64, 3).layers)


def main() -> None:
    """Compile and print."""
    for index, arch in enumerate(map(int, sys.argv[1:])):
        with PretendGpu(arch) as gpu:
            if index == 0:
                launch_all()
            else:
                launch_largest(arch)
        for made in gpu.compiled:
            share = made.resident_share(arch)
            print(json.dumps({**vars(made), "arch": arch, "resident_share": share}))


if __name__ == "__main__":
    main()
