"""The fused proposal round against the plain network in float64, values and gradients."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import t_from_s, weights_from_density
from pipelines.nerf.engines.cpu.train.adam import FusedAdam
from pipelines.nerf.engines.cpu.train.gradients import accumulate_in_place
from pipelines.nerf.engines.cpu.train.proposal import is_compiled, proposal_weights
from pipelines.nerf.networks.fields import DensityField
from pipelines.nerf.options.methods.nerfacto import ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig

# Two dense levels (8^3 and 15^3 vertices fit into 4096) and two hashed ones.
SMALL = HashGridConfig(num_levels=4, min_res=7, max_res=60, log2_table_size=12)
TINY = HashGridConfig(num_levels=1, min_res=5, max_res=5, log2_table_size=8)


@pytest.fixture(params=[1, 2], ids=["one thread", "two threads"])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def random_network(
    grid: HashGridConfig = SMALL, hidden: int = 16, contraction: str = "linf"
) -> DensityField:
    """A network whose densities reach from fog to walls."""
    torch.manual_seed(1)
    network = DensityField(
        ProposalConfig(grid=grid, hidden_dim=hidden),
        contraction=contraction,
        average_init_density=0.5,
    )
    network.grid.table.data.normal_()
    for parameter in network.mlp.parameters():
        parameter.data.normal_(std=0.7)
    return network


def random_rays(num_rays: int, num_samples: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(num_rays * 1000 + num_samples)
    origins = torch.randn(num_rays, 3, generator=generator) * 0.4
    directions = torch.randn(num_rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    s_edges = torch.rand(num_rays, num_samples + 1, generator=generator).sort(dim=-1).values
    return origins, directions, t_from_s(s_edges, 0.05, 50.0)


def plain_weights(rays: tuple[Tensor, ...], network: DensityField) -> Tensor:
    """The definition: positions, network, transmittance; in the precision of its arguments."""
    origins, directions, t_edges = rays
    middles = 0.5 * (t_edges[:, :-1] + t_edges[:, 1:])
    positions = origins[:, None] + directions[:, None] * middles[..., None]
    return weights_from_density(network(positions), t_edges)


def gradients(weights: Tensor, network: DensityField, upstream: Tensor) -> list[Tensor]:
    return list(torch.autograd.grad(weights, list(network.parameters()), upstream))


@pytest.mark.parametrize("contraction", ["linf", "l2", "none"])
@pytest.mark.parametrize(
    ("grid", "hidden", "num_rays", "num_samples"),
    [(SMALL, 16, 37, 40), (SMALL, 5, 3, 257), (TINY, 3, 300, 1), (SMALL, 64, 1, 1)],
    ids=["rays of all lengths", "longer than a tile", "one sample", "one ray"],
)
def test_values_and_gradients_are_those_of_the_plain_network(
    contraction: str,
    grid: HashGridConfig,
    hidden: int,
    num_rays: int,
    num_samples: int,
    threads: int,
) -> None:
    network = random_network(grid, hidden, contraction)
    rays = random_rays(num_rays, num_samples)
    upstream = torch.randn(num_rays, num_samples, generator=torch.Generator().manual_seed(3))
    fast = proposal_weights(*rays, network)
    found = gradients(fast, network, upstream)

    precise = copy.deepcopy(network).double()
    expected = plain_weights(tuple(item.double() for item in rays), precise)
    truth = gradients(expected, precise, upstream.double())
    # float32 places in cells are known to 1e-7 * 60 cells, which features of size 1 pass on.
    assert (fast - expected).abs().max() < 2e-5
    names = [name for name, _ in network.named_parameters()]
    for name, grad, true in zip(names, found, truth, strict=True):
        scale = float(true.abs().max())
        assert scale > 1e-4 or contraction == "none", name
        assert (grad - true).abs().max() <= 1e-4 * scale + 1e-6, name


def test_forward_without_graph_has_the_same_values(threads: int) -> None:
    network, rays = random_network(), random_rays(50, 30)
    with torch.no_grad():
        silent = proposal_weights(*rays, network)
    learned = proposal_weights(*rays, network)
    assert not silent.requires_grad
    assert learned.requires_grad
    assert torch.equal(silent, learned.detach())


def test_gradients_repeat_to_the_bit(threads: int) -> None:
    network, rays = random_network(), random_rays(200, 33)
    upstream = torch.randn(200, 33)
    first = gradients(proposal_weights(*rays, network), network, upstream)
    for _ in range(3):
        again = gradients(proposal_weights(*rays, network), network, upstream)
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_rays_without_a_gradient_add_nothing(threads: int) -> None:
    network = random_network()
    rays = random_rays(90, 20)
    upstream = torch.randn(90, 20)
    upstream[torch.arange(90) % 7 != 2] = 0.0
    origins, directions, t_edges = (item[2::7] for item in rays)  # not contiguous
    whole = gradients(proposal_weights(*rays, network), network, upstream)
    alone = gradients(
        proposal_weights(origins, directions, t_edges, network), network, upstream[2::7]
    )
    for a, b in zip(whole, alone, strict=True):
        assert (a - b).abs().max() <= 1e-5 * b.abs().max()


def test_strided_gradients_and_rays_are_read_as_they_stand() -> None:
    network, rays = random_network(), random_rays(24, 10)
    upstream = torch.randn(10, 24).T
    origins, directions, t_edges = (item.T.contiguous().T for item in rays)
    expected = gradients(proposal_weights(*rays, network), network, upstream.contiguous())
    found = gradients(proposal_weights(origins, directions, t_edges, network), network, upstream)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    # The gradient of a sum is a single number, spread over all weights with strides of 0.
    (table,) = torch.autograd.grad(proposal_weights(*rays, network).sum(), network.grid.table)
    assert table.abs().max() > 0.0


def test_no_rays_give_no_weights_and_zero_gradients(threads: int) -> None:
    network = random_network()
    weights = proposal_weights(*random_rays(0, 12), network)
    assert weights.shape == (0, 12)
    for grad, parameter in zip(
        gradients(weights, network, weights.detach()), network.parameters(), strict=True
    ):
        assert torch.equal(grad, torch.zeros_like(parameter))


def test_growth_beyond_the_clamp_has_a_bounded_gradient() -> None:
    """Twin of `truncated_exp`: the derivative of exp at 20 is taken as e^15."""
    network = random_network(TINY, 4)
    network.mlp.layers[1].bias.data.fill_(20.0)  # type: ignore[operator]
    network.average_init_density = 1e-9
    rays = random_rays(16, 4)
    upstream = torch.randn(16, 4)
    found = gradients(proposal_weights(*rays, network), network, upstream)
    truth = gradients(plain_weights(rays, network), network, upstream)
    for grad, true in zip(found, truth, strict=True):
        assert (grad - true).abs().max() <= 1e-4 * true.abs().max()


def test_infinite_density_stops_the_ray_and_leaves_gradients_finite() -> None:
    network = random_network(TINY, 4)
    network.mlp.layers[1].bias.data.fill_(200.0)  # type: ignore[operator]
    weights = proposal_weights(*random_rays(8, 6), network)
    expected = torch.zeros(8, 6)
    expected[:, 0] = 1.0
    assert torch.equal(weights.detach(), expected)
    found = gradients(weights, network, torch.randn(8, 6))
    assert all(bool(torch.isfinite(grad).all()) for grad in found)


def test_in_place_accumulation_adds_to_the_same_memory(threads: int) -> None:
    network, rays = random_network(), random_rays(40, 25)
    upstream = torch.randn(40, 25)
    expected = gradients(proposal_weights(*rays, network), network, upstream)
    accumulate_in_place(network)
    table = network.grid.table
    assert table.grad is not None
    memory = table.grad.data_ptr()
    for _ in range(2):
        proposal_weights(*rays, network).backward(upstream)
    assert table.grad.data_ptr() == memory
    for parameter, once in zip(network.parameters(), expected, strict=True):
        assert parameter.grad is not None
        assert (parameter.grad - 2.0 * once).abs().max() <= 1e-5 * once.abs().max()


def test_parameters_changed_between_forward_and_backward_are_noticed() -> None:
    network = random_network()
    weights = proposal_weights(*random_rays(4, 4), network)
    with torch.no_grad():
        network.grid.table.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        weights.sum().backward()


def test_second_derivatives_are_refused() -> None:
    network = random_network()
    weights = proposal_weights(*random_rays(4, 4), network)
    bias = network.mlp.layers[1].bias
    assert isinstance(bias, Tensor)
    (slope,) = torch.autograd.grad(weights.square().sum(), bias, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


@pytest.mark.parametrize("num_features", [1, 4])
def test_other_networks_take_the_plain_way(num_features: int) -> None:
    grid = HashGridConfig(
        num_levels=2, min_res=4, max_res=8, log2_table_size=10, features_per_level=num_features
    )
    network, rays = random_network(grid), random_rays(5, 6)
    assert not is_compiled(network)
    assert torch.equal(proposal_weights(*rays, network), plain_weights(rays, network))


def test_training_with_all_parts_follows_the_plain_run(threads: int) -> None:
    """Kernel, gradients in place and one-pass Adam; every third step leaves the network out."""
    rays = random_rays(30, 24)
    target = torch.rand(30, 24) / 24

    def losses(fast: bool) -> list[float]:
        network = random_network()
        parameters = list(network.parameters())
        kind = FusedAdam if fast else torch.optim.Adam
        optimizer = kind(parameters, lr=1e-2, eps=1e-5)
        if fast:
            accumulate_in_place(network)
        found = []
        for step in range(15):
            optimizer.zero_grad()
            if step % 3 != 2:
                weights = proposal_weights(*rays, network) if fast else plain_weights(rays, network)
                loss = (weights - target).square().sum()
                loss.backward()
                found.append(loss.item())
            optimizer.step()
        return found

    plain, fast = losses(fast=False), losses(fast=True)
    assert plain[-1] < 0.7 * plain[0]
    assert fast == pytest.approx(plain, rel=1e-4)


def test_levels_that_wait_are_left_alone(threads: int) -> None:
    network = random_network(SMALL)
    first = int(network.grid.offsets[2])
    with torch.no_grad():
        network.grid.table[first:] = 0.0
    network.grid.active_levels = 2
    rays, upstream = random_rays(37, 40), torch.randn(37, 40)
    found = proposal_weights(*rays, network)
    expected = plain_weights(rays, network)
    assert (found - expected).abs().max() < 2e-5
    table, *_ = gradients(found, network, upstream)
    truth, *_ = gradients(expected, network, upstream)
    assert float(table[first:].abs().sum()) == 0.0
    assert (table - truth).abs().max() <= 1e-3 * truth.abs().max()
