"""Whether the GPU's kernels are right on the GPU at hand, before anything is timed.

Each compiled kernel against its plain twin, values and gradients: the norm of the difference over
the norm of what is expected. Then whole training steps, one kernel at a time and as CUDA graphs
(`engines.gpu.self_check`), and dense stereo by PyTorch against the CPU's numba kernels. Inputs are
random, of the paper's shapes. Works on any device where Triton's kernels run, the interpreter's CPU
included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.nerf.engines.gpu.parts.mlp import fused_mlp, has_room
from pipelines.nerf.engines.gpu.self_check import (
    engine_errors,
    engine_problem,
    grid_gaps,
    relative_gap,
)
from pipelines.nerf.networks.fields import MLP
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.stereo.engines import KERNELS, TorchEngine, engine_gaps
from tests.benchmarks.gpu_counts import mlp_widths
from tests.benchmarks.tables import markdown_table

NETWORK_OUTPUTS = 5e-3
"""Allowed gap of float16 products."""
NETWORK_GRADIENTS = 6e-2
"""Of float16 networks, whose hidden values change sign by rounding."""


@dataclass(frozen=True)
class Check:
    """One comparison. gap: what was found, at most `allowed`; problem: in words where it failed."""

    name: str
    gap: float
    allowed: float
    problem: str = ""

    @property
    def passed(self) -> bool:
        return not self.problem and self.gap <= self.allowed


def grid_checks(name: str, config: HashGridConfig, num: int, device: torch.device) -> list[Check]:
    """The hash grid at `num` points, see `self_check.grid_gaps`."""
    gaps = grid_gaps(config, num, device)
    return [Check(f"{name}: {what}", *gap) for what, gap in gaps.items()]


def network_checks(widths: Sequence[int], num: int, device: torch.device) -> list[Check]:
    """A fused network at `num` points, forward and backward, with float16 products."""
    torch.manual_seed(3)
    network = MLP(*widths).to(device)
    values = torch.randn(num, widths[0], device=device, requires_grad=True)
    incoming = torch.randn(num, widths[-1], device=device)
    wanted: list[Tensor] = [values, *network.parameters()]
    found, expected = fused_mlp(values, network.layers), network(values)
    ours = torch.autograd.grad(found, wanted, incoming)
    theirs = torch.autograd.grad(expected, wanted, incoming)
    worst = max(relative_gap(a, b) for a, b in zip(ours, theirs, strict=True))
    name = f"network {'-'.join(map(str, widths))}"
    return [
        Check(f"{name}: outputs", relative_gap(found, expected), NETWORK_OUTPUTS),
        Check(f"{name}: gradients", worst, NETWORK_GRADIENTS),
    ]


def networks(model: NerfactoConfig) -> list[tuple[int, ...]]:
    """Inputs, hidden layers and outputs of the first proposal, of density and of colour."""
    proposal = model.proposals[0]
    inputs = proposal.grid.num_levels * proposal.grid.features_per_level
    return [(inputs, proposal.hidden_dim, 1), *mlp_widths(model)]


def kernel_checks(model: NerfactoConfig, num: int, device: torch.device) -> list[Check]:
    """All kernels with the shapes of a model; those that raise fail with their error."""
    jobs: list[tuple[str, Callable[[], list[Check]]]] = [
        ("field grid", lambda: grid_checks("field grid", model.grid, num, device)),
        (
            "proposal grid",
            lambda: grid_checks("proposal grid", model.proposals[0].grid, num, device),
        ),
    ]
    if device.type == "cpu" or has_room(device):
        jobs += [
            (f"network {widths}", lambda widths=widths: network_checks(widths, num, device))  # type: ignore[misc]
            for widths in networks(model)
        ]
    checks = []
    for name, job in jobs:
        try:
            checks += job()
        except engine_errors() as error:
            checks.append(Check(name, float("nan"), 0.0, f"{type(error).__name__}: {error}"))
    return checks


def stereo_checks(device: torch.device) -> list[Check]:
    """Dense stereo on a device against the CPU's kernels: shares of pixels that differ."""
    try:
        gaps = engine_gaps(TorchEngine(device), KERNELS)
    except engine_errors() as error:
        return [Check("stereo", float("nan"), 0.0, f"{type(error).__name__}: {error}")]
    return [Check(f"stereo: {what}", *gap) for what, gap in gaps.items()]


def step_check(config: TrainConfig, device: torch.device) -> Check:
    """Whole steps of both engines, the fast one's as CUDA graphs."""
    problem = engine_problem(config, device)
    return Check("training steps, as graphs", 0.0 if problem is None else 1.0, 0.0, problem or "")


def print_checks(checks: Sequence[Check]) -> bool:
    """The table; whether all passed."""
    rows = [
        [check.name, f"{check.gap:.1e}", f"{check.allowed:.0e}", "yes" if check.passed else "NO"]
        for check in checks
    ]
    print("\nKernels against their plain twins\n")
    print(markdown_table(["what", "relative gap", "allowed", "right"], rows))
    for check in checks:
        if check.problem:
            print(f"\n{check.name}: {check.problem}")
    return all(check.passed for check in checks)
