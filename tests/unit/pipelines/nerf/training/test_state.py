"""What a run takes over from a checkpoint of another optimiser, device or options."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from pipelines.nerf.engines.cpu.train.adam import FusedAdam
from pipelines.nerf.options.train import OptimizerConfig
from pipelines.nerf.training.state import initial_state, restore_optimizer, restore_scaler
from tests.unit.pipelines.nerf.toy_scene import tiny_config

RATE, EPS = 1e-2, 1e-15
SHAPES = ((40, 2), (7,))
MakeAdam = Callable[[list[nn.Parameter]], torch.optim.Adam]


def _capturable(parameters: list[nn.Parameter]) -> torch.optim.Adam:
    """As on a GPU, where steps are captured: the rate is a tensor."""
    return torch.optim.Adam(parameters, lr=torch.tensor(RATE), eps=EPS, fused=True, capturable=True)


KINDS: dict[str, MakeAdam] = {
    "plain": lambda parameters: torch.optim.Adam(parameters, lr=RATE, eps=EPS),
    "fused": lambda parameters: torch.optim.Adam(parameters, lr=RATE, eps=EPS, fused=True),
    "capturable": _capturable,
    "compiled": lambda parameters: FusedAdam(parameters, lr=RATE, eps=EPS),
}


def _parameters() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def _step(parameters: list[nn.Parameter], optimizer: torch.optim.Adam, number: int) -> None:
    generator = torch.Generator().manual_seed(number)
    for parameter in parameters:
        parameter.grad = torch.randn(parameter.shape, generator=generator)
    optimizer.step()


def _options(optimizer: torch.optim.Adam) -> list[dict[str, Any]]:
    return [
        {name: value for name, value in group.items() if name != "params"}
        for group in optimizer.param_groups
    ]


@pytest.mark.parametrize("into", KINDS)
@pytest.mark.parametrize("out_of", KINDS)
def test_every_adam_goes_on_from_the_state_of_every_other(out_of: str, into: str) -> None:
    parameters = _parameters()
    saver = KINDS[out_of](parameters)
    for number in range(5):
        _step(parameters, saver, number)
    taken = [nn.Parameter(parameter.detach().clone()) for parameter in parameters]
    loader = KINDS[into](taken)
    before = copy.deepcopy(_options(loader))
    restore_optimizer(loader, copy.deepcopy(saver.state_dict()))

    assert _options(loader) == before
    for old, new in zip(parameters, taken, strict=True):
        assert float(loader.state[new]["step"]) == 5.0
        for name in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(saver.state[old][name], loader.state[new][name])
    for number in range(5, 8):
        _step(parameters, saver, number)
        _step(taken, loader, number)
    for old, new in zip(parameters, taken, strict=True):
        torch.testing.assert_close(old, new, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("out_of", KINDS)
def test_counts_of_steps_go_where_the_optimiser_looks_for_them(out_of: str) -> None:
    parameters = _parameters()
    saver = KINDS[out_of](parameters)
    _step(parameters, saver, 0)
    # "meta" stands for a GPU: a device that is not the host.
    elsewhere = [nn.Parameter(parameter.detach().to("meta")) for parameter in parameters]
    for kind, device in (("plain", "cpu"), ("fused", "meta"), ("capturable", "meta")):
        loader = KINDS[kind](elsewhere)
        restore_optimizer(loader, copy.deepcopy(saver.state_dict()))
        for state in loader.state.values():
            assert state["step"].device.type == device, kind
            assert state["exp_avg"].device.type == "meta"


@pytest.mark.parametrize("engine", ["plain", "fast"])
def test_epsilon_and_betas_are_those_of_the_options_also_after_a_resume(engine: str) -> None:
    cpu = torch.device("cpu")
    begun = initial_state(tiny_config(engine=engine), 3, 0, cpu)
    rates = OptimizerConfig(eps=1e-8, beta2=0.95)
    resumed = initial_state(tiny_config(engine=engine, optimizer=rates), 3, 0, cpu)
    resumed.restore(copy.deepcopy(begun.as_dict()))
    for optimizer in resumed.optimizers.values():
        for group in optimizer.param_groups:
            assert (group["eps"], group["betas"]) == (1e-8, (0.9, 0.95))


def test_a_loss_scale_is_taken_over_and_the_rules_of_its_growth_are_not() -> None:
    growing = torch.amp.GradScaler("cpu", 2.0**10, growth_interval=2)
    never = torch.amp.GradScaler("cpu", 2.0**16, growth_interval=2**31 - 1)
    parameter = nn.Parameter(torch.ones(2))
    optimizer = torch.optim.SGD([parameter], lr=0.1)
    for scaler, steps in ((growing, 4), (never, 0)):
        for _ in range(steps):
            scaler.scale(parameter.sum()).backward()
            scaler.step(optimizer)
            scaler.update()
    assert growing.get_scale() == 2.0**12
    restore_scaler(never, growing.state_dict())
    assert never.get_scale() == 2.0**12
    assert never.get_growth_interval() == 2**31 - 1
