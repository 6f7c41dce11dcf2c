"""One-pass Adam against torch's."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch
from torch import nn

from pipelines.nerf.engines.cpu.train.adam import THREADED_SIZE, FusedAdam
from pipelines.nerf.networks.decay import DECAYS, decay_gradients

RATE, EPS = 1e-2, 1e-15


@pytest.fixture(params=[1, 2], ids=["one thread", "two threads"])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def sparse_gradient(shape: tuple[int, ...], step: int) -> torch.Tensor:
    """A tenth of the rows have a gradient, some of them for the first time late or never."""
    generator = torch.Generator().manual_seed(step)
    rows = torch.rand(shape[0], generator=generator) < 0.1
    rows[shape[0] // 2 :] &= step > 50
    rows[-shape[0] // 4 :] = False
    gradient = torch.randn(shape, generator=generator) * 10.0 ** (step % 5 - 3)
    return gradient * rows.reshape(-1, *[1] * (len(shape) - 1))


@pytest.mark.parametrize("decay", [0.0, 1e-2])
@pytest.mark.parametrize("shape", [(THREADED_SIZE, 2), (1003, 2), (7,), (16, 10)])
def test_equals_torch_over_a_hundred_steps(
    shape: tuple[int, ...], decay: float, threads: int
) -> None:
    torch.manual_seed(0)
    ours = nn.Parameter(torch.randn(shape) * 1e-3)
    start = ours.detach().clone()
    theirs = nn.Parameter(ours.detach().double())
    fused = FusedAdam([ours], lr=RATE, eps=EPS)
    truth = torch.optim.Adam([theirs], lr=RATE, eps=EPS)
    truth.register_step_pre_hook(decay_gradients)
    ours.grad = torch.zeros(shape)
    for step in range(100):
        gradient = sparse_gradient(shape, step)
        ours.grad += gradient
        theirs.grad = gradient.double()
        for optimizer in (fused, truth):
            optimizer.param_groups[0]["lr"] = RATE * 0.99**step
            optimizer.param_groups[0][DECAYS] = (decay,)
            optimizer.step()
    quiet = slice(shape[0] - shape[0] // 4, None)
    assert torch.equal(ours[quiet], start[quiet])
    # A hundred steps of at most 0.01 each, with a few rounding errors of float32 in each.
    assert theirs.detach().abs().max() > 0.1 or shape == (7,)
    assert (ours - theirs).abs().max() < 100 * RATE * 1e-6


def test_momentum_moves_entries_on_that_have_no_gradient() -> None:
    """With g = 1 once, m = 0.1 * 0.9^k and v = 0.001 * 0.999^k; the formula step by step."""
    parameter = nn.Parameter(torch.zeros(64))
    optimizer = FusedAdam([parameter], lr=RATE, eps=EPS)
    expected = 0.0
    for step in range(1, 6):
        parameter.grad = torch.zeros(64)
        parameter.grad[3] = 1.0 if step == 1 else 0.0
        optimizer.step()
        m, v = 0.1 * 0.9 ** (step - 1), 0.001 * 0.999 ** (step - 1)
        expected -= RATE * (m / (1 - 0.9**step)) / (v / (1 - 0.999**step)) ** 0.5
    assert parameter[3].item() == pytest.approx(expected, rel=1e-5)
    assert parameter.detach().count_nonzero() == 1


def test_each_parameter_decays_by_its_own_number() -> None:
    """One step of g + d p, of which Adam's first step takes the sign."""
    kept, decayed = (nn.Parameter(torch.full((40,), 0.5)) for _ in range(2))
    optimizer = FusedAdam([kept, decayed], lr=RATE, eps=EPS)
    optimizer.param_groups[0][DECAYS] = (0.0, 0.1)
    for parameter in (kept, decayed):
        parameter.grad = torch.zeros(40)
        parameter.grad[[3, 39]] = -0.01
    optimizer.step()
    expected = torch.full((40,), 0.5)
    expected[[3, 39]] = 0.5 + RATE
    torch.testing.assert_close(kept.detach(), expected)
    expected[[3, 39]] = 0.5 - RATE
    torch.testing.assert_close(decayed.detach(), expected)
    assert optimizer.state[decayed]["exp_avg"][3].item() == pytest.approx(0.1 * 0.04)


@pytest.mark.parametrize("eps", [EPS, 0.0])
def test_a_step_leaves_zeros_in_the_same_memory(eps: float) -> None:
    parameter = nn.Parameter(torch.randn(100, 2))
    optimizer = FusedAdam([parameter], lr=RATE, eps=eps)
    parameter.grad = sparse_gradient((100, 2), 3)
    memory = parameter.grad.data_ptr()
    optimizer.step()
    optimizer.zero_grad()
    assert parameter.grad.data_ptr() == memory
    assert not parameter.grad.any()
    assert torch.isfinite(parameter).all()


def test_zero_grad_clears_what_came_after_the_step() -> None:
    parameter = nn.Parameter(torch.randn(10))
    optimizer = FusedAdam([parameter], lr=RATE)
    parameter.square().sum().backward()
    optimizer.step()
    parameter.square().sum().backward()
    assert parameter.grad is not None
    assert parameter.grad.any()
    optimizer.zero_grad()
    assert not parameter.grad.any()
    optimizer.zero_grad(set_to_none=True)
    assert parameter.grad is None


def test_parameters_without_a_new_gradient_are_left_out_as_in_torch() -> None:
    torch.manual_seed(0)
    ours = [nn.Parameter(torch.randn(40)), nn.Parameter(torch.randn(40))]
    theirs = [nn.Parameter(parameter.detach().clone()) for parameter in ours]
    fused, truth = FusedAdam(ours, lr=RATE), torch.optim.Adam(theirs, lr=RATE)
    for step in range(20):
        for parameters, optimizer in ((ours, fused), (theirs, truth)):
            loss = parameters[0].square().sum()
            if step % 5 == 0:
                loss = loss + parameters[1].sin().sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    for a, b in zip(ours, theirs, strict=True):
        assert (a - b).abs().max() < 1e-6
    assert fused.state[ours[1]]["step"] == 4


def test_a_fresh_buffer_of_zeros_is_no_gradient() -> None:
    """As after a resume, where a step may come that leaves the proposal networks out."""
    parameter = nn.Parameter(torch.randn(40))
    before = parameter.detach().clone()
    optimizer = FusedAdam([parameter], lr=RATE)
    parameter.grad = torch.ones(40)
    optimizer.step()
    resumed_parameter = nn.Parameter(parameter.detach().clone())
    resumed = FusedAdam([resumed_parameter], lr=RATE)
    resumed.load_state_dict(optimizer.state_dict())
    resumed_parameter.grad = torch.zeros(40)
    for item in (optimizer, resumed):
        item.zero_grad()
        item.step()
    assert not torch.equal(parameter, before)
    assert torch.equal(parameter, resumed_parameter)
    assert resumed.state[resumed_parameter]["step"] == 1


def test_resumes_to_the_bit_and_exchanges_its_state_with_torch(threads: int) -> None:
    shape = (THREADED_SIZE, 1)
    torch.manual_seed(0)
    parameter = nn.Parameter(torch.randn(shape))
    optimizer = FusedAdam([parameter], lr=RATE, eps=EPS)

    def advance(p: nn.Parameter, o: torch.optim.Optimizer, steps: range) -> None:
        for step in steps:
            p.grad = sparse_gradient(shape, step)
            o.step()

    advance(parameter, optimizer, range(5))
    resumed = nn.Parameter(parameter.detach().clone())
    other = FusedAdam([resumed], lr=0.5)
    other.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    plain_parameter = nn.Parameter(parameter.detach().clone())
    plain = torch.optim.Adam([plain_parameter], lr=0.5)
    plain.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    for p, o in ((parameter, optimizer), (resumed, other), (plain_parameter, plain)):
        advance(p, o, range(5, 9))
    assert torch.equal(parameter, resumed)
    assert (parameter - plain_parameter).abs().max() < 1e-6


def test_refuses_what_it_cannot_update() -> None:
    with pytest.raises(ValueError, match=r"float32 parameters on the CPU.*torch\.float64"):
        FusedAdam([nn.Parameter(torch.zeros(3, dtype=torch.float64))])
    with pytest.raises(ValueError, match="contiguous"):
        FusedAdam([nn.Parameter(torch.zeros(3, 4).T)])


def test_a_graph_notices_that_a_step_changed_its_parameters() -> None:
    parameter = nn.Parameter(torch.ones(3))
    optimizer = FusedAdam([parameter])
    loss = parameter.square().sum()
    parameter.grad = torch.ones(3)
    optimizer.step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
