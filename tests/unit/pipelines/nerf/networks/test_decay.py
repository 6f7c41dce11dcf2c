"""Tables that decay: the definition, whatever the optimiser and whoever scales the loss."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from pipelines.nerf.engines.gpu.step import capturable_adam
from pipelines.nerf.networks.decay import DECAYS, decay_gradients, set_table_decay
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.training.state import initial_state
from tests.unit.pipelines.nerf.toy_scene import tiny_config

CPU = torch.device("cpu")
DECAY = 1e-2


def make_net() -> nn.Sequential:
    torch.manual_seed(0)
    grid = HashGrid(HashGridConfig(num_levels=2, log2_table_size=8, min_res=4, max_res=16))
    with torch.no_grad():
        grid.table.uniform_(-1.0, 1.0)
    return nn.Sequential(grid, nn.Linear(grid.num_outputs, 1))


def run(net: nn.Module, optimizer: torch.optim.Adam, steps: int, scaler: bool = False) -> None:
    """Steps at a few points of a corner of the cube."""
    scaling = torch.amp.GradScaler("cpu", 2.0**12, enabled=scaler)
    random = torch.Generator().manual_seed(1)
    for _ in range(steps):
        points = 0.3 * torch.rand(8, 3, generator=random)
        optimizer.zero_grad()
        scaling.scale((net(points) - 1.0).square().mean()).backward()
        scaling.step(optimizer)
        scaling.update()


def decaying(net: nn.Module) -> torch.optim.Adam:
    optimizer = capturable_adam(net.parameters(), 1e-2, 1e-15, CPU)
    set_table_decay(optimizer, net, DECAY)
    return optimizer


def test_the_gradient_of_what_was_ever_read_gets_its_part_of_the_entry() -> None:
    net = make_net()
    optimizer = decaying(net)
    run(net, optimizer, 3)
    table: Tensor = net[0].table  # type: ignore[assignment]
    seen = optimizer.state[table]["exp_avg_sq"] != 0
    assert 0 < seen.sum() < seen.numel()
    optimizer.zero_grad()
    net(torch.full((1, 3), 0.1)).sum().backward()
    given = [parameter.grad.clone() for parameter in net.parameters()]  # type: ignore[union-attr]
    decay_gradients(optimizer)
    assert (given[0] != 0).sum() < seen.sum()
    seen |= given[0] != 0
    torch.testing.assert_close(table.grad, given[0] + DECAY * table.detach() * seen)
    for parameter, before in list(zip(net.parameters(), given, strict=True))[1:]:
        assert torch.equal(parameter.grad, before)  # type: ignore[arg-type]


def test_what_no_ray_reads_stays_and_what_rays_read_shrinks() -> None:
    plain, decayed = make_net(), make_net()
    start: Tensor = plain[0].table.detach().clone()  # type: ignore[operator]
    run(plain, capturable_adam(plain.parameters(), 1e-2, 1e-15, CPU), 200)
    optimizer = decaying(decayed)
    run(decayed, optimizer, 200)
    table: Tensor = decayed[0].table  # type: ignore[assignment]
    seen = optimizer.state[table]["exp_avg_sq"] != 0
    assert torch.equal(table[~seen], start[~seen])
    kept: Tensor = plain[0].table  # type: ignore[assignment]
    assert table[seen].square().mean() < 0.5 * kept[seen].square().mean()


def test_a_scaled_loss_decays_as_much() -> None:
    plain, scaled = make_net(), make_net()
    run(plain, decaying(plain), 20)
    run(scaled, decaying(scaled), 20, scaler=True)
    for one, other in zip(plain.parameters(), scaled.parameters(), strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("engine", ["plain", "fast"])
def test_a_run_decays_its_tables_alone_also_after_a_resume(engine: str) -> None:
    config = tiny_config(engine=engine)
    begun = initial_state(config, 3, 0, CPU)
    optimizer = config.optimizer.__class__(table_decay=DECAY)
    resumed = initial_state(tiny_config(engine=engine, optimizer=optimizer), 3, 0, CPU)
    resumed.restore(copy.deepcopy(begun.as_dict()))
    for state, decay in ((begun, 0.0), (resumed, DECAY)):
        grids = [module for module in state.model.modules() if isinstance(module, HashGrid)]
        assert len(grids) > 1
        (group,) = state.optimizers["networks"].param_groups
        by_parameter = dict(zip(group["params"], group[DECAYS], strict=True))
        assert all(by_parameter.pop(grid.table) == decay for grid in grids)
        assert by_parameter
        assert not any(by_parameter.values())
        assert DECAYS not in state.optimizers["cameras"].param_groups[0]
