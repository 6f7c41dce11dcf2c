"""Adam in one pass over memory, which also zeroes the gradient for the next step.

Twin of `torch.optim.Adam` without weight decay, with the same state, so that checkpoints fit both,
and of `networks.decay.decay_gradients`.
A table's step is bound by memory: gradient, two moments and parameter are read and written once.
Symbols: g gradient, m and v its first and second moment.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from torch import Tensor, nn

from pipelines.nerf.engines.cpu.parts.lanes import FLOATS, LANES, Lanes
from pipelines.nerf.engines.cpu.parts.runtime import exact, run_threads
from pipelines.nerf.networks.decay import DECAYS

THREADED_SIZE = 2**16
"""Smaller parameters are done before threads would have started."""
ZERO = np.float32(0.0)
NUM_NUMBERS = 7


def _not_zero(lanes: Lanes, *values: Any) -> Any:
    """The lanes in which any of the values is not 0; a NaN is not."""
    build = lanes.builder
    found = None
    for value in values:
        other = build.fcmp_unordered("!=", value, lanes.floats(0.0))
        found = other if found is None else build.or_(found, other)
    return found


def _any(lanes: Lanes, *values: Any) -> Any:
    """Whether a lane of any of the values is not 0."""
    build = lanes.builder
    bits = build.bitcast(_not_zero(lanes, *values), ir.IntType(LANES))
    return build.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


def _generate_update(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    *addresses, numbers = arguments
    lanes = Lanes(builder)
    p, g, m, v = (lanes.load(address) for address in addresses)
    has_gradient = _any(lanes, g)
    with builder.if_then(builder.or_(has_gradient, _any(lanes, m, v))):
        gain, keep, gain_square, step_size, root, eps, decay = (
            lanes.splat(lanes.load(lanes.at(numbers, 4 * i), ir.FloatType()))
            for i in range(NUM_NUMBERS)
        )
        own = builder.fmul(decay, p)
        own = builder.select(_not_zero(lanes, g, m, v), own, lanes.floats(0.0))
        g = builder.fadd(g, own)
        first = builder.fadd(m, builder.fmul(gain, builder.fsub(g, m)))
        square = builder.fmul(gain_square, builder.fmul(g, g))
        second = builder.fadd(builder.fmul(keep, v), square)
        kind = ir.FunctionType(FLOATS, [FLOATS])
        name = f"llvm.sqrt.v{LANES}f32"
        sqrt = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        divisor = builder.fadd(builder.fdiv(builder.call(sqrt, [second]), root), eps)
        change = builder.fdiv(builder.fmul(step_size, first), divisor)
        # With eps = 0, what never had a gradient would be 0 / 0.
        moves = builder.fcmp_unordered("!=", first, lanes.floats(0.0))
        change = builder.select(moves, change, lanes.floats(0.0))
        for value, address in zip(
            (builder.fsub(p, change), first, second),
            (addresses[0], addresses[2], addresses[3]),
            strict=True,
        ):
            lanes.store(value, address)
        with builder.if_then(has_gradient):
            lanes.store(lanes.floats(0.0), addresses[1])
    return context.get_dummy_value()


@intrinsic
def _update_lanes(typing_context, p, g, m, v, numbers):
    """`_update` for 16 elements; all arguments are addresses."""
    return types.void(*[types.intp] * 5), _generate_update


@exact
def _update(share, shares, p, g, m, v, numbers):
    """One step of p, g, m, v [N] float32; g is 0 afterwards.

    numbers: 1 - beta1, beta2, 1 - beta2, lr / (1 - beta1^t), sqrt(1 - beta2^t), eps, and what part
    of p is added to g. Where g, m and v are 0 p stays, and g is not written where it is 0 already.
    """
    p_at, g_at = np.intp(p.ctypes.data), np.intp(g.ctypes.data)
    m_at, v_at = np.intp(m.ctypes.data), np.intp(v.ctypes.data)
    numbers_at = np.intp(numbers.ctypes.data)
    blocks = len(p) // LANES
    for block in range(blocks * share // shares, blocks * (share + 1) // shares):
        at = block * LANES * 4
        _update_lanes(p_at + at, g_at + at, m_at + at, v_at + at, numbers_at)  # type: ignore[call-arg]
    if share == shares - 1:
        gain, keep, gain_square, step_size, root, eps, decay = numbers
        for i in range(blocks * LANES, len(p)):
            slope = g[i]
            if slope != ZERO or m[i] != ZERO or v[i] != ZERO:
                slope += decay * p[i]
            first = m[i] + gain * (slope - m[i])
            second = keep * v[i] + gain_square * (slope * slope)
            m[i], v[i], g[i] = first, second, ZERO
            if first != ZERO:  # as above
                p[i] -= step_size * first / (np.float32(math.sqrt(second)) / root + eps)


class FusedAdam(torch.optim.Adam):
    """`torch.optim.Adam` for float32 parameters on the CPU, by one compiled pass.

    `step` leaves every gradient zeroed but allocated, so that backward adds to the same memory, and
    `zero_grad`, to be called before backward as usual, has nothing left to do. As with torch's
    `zero_grad(set_to_none=True)`, parameters that got no gradient since then are left out of the
    next step. Raises ValueError for parameters that it cannot update.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps)
        for group in self.param_groups:
            for parameter in group["params"]:
                _check(parameter)
        self._zeroed: dict[Tensor, tuple[Tensor, int]] = {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._zeroed = {}  # after unpickling, and after `load_state_dict`

    def _is_zeroed(self, parameter: Tensor) -> bool:
        """Whether the gradient is as `step` left it."""
        gradient, version = self._zeroed.get(parameter, (None, 0))
        return gradient is parameter.grad and gradient is not None and gradient._version == version

    def zero_grad(self, set_to_none: bool = False) -> None:
        """Zero what has changed since the last step, or drop all gradients."""
        if set_to_none:
            self._zeroed.clear()
            super().zero_grad(set_to_none=True)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None and not self._is_zeroed(parameter):
                    parameter.grad.detach_().zero_()
                    self._zeroed[parameter] = (parameter.grad, parameter.grad._version)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Update all parameters that have a gradient, and zero it."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            decays = group.get(DECAYS) or (0.0,) * len(group["params"])
            for parameter, decay in zip(group["params"], decays, strict=True):
                if parameter.grad is not None and not self._is_zeroed(parameter):
                    self._update(parameter, group, decay)
        return loss

    def _update(self, parameter: Tensor, group: dict[str, Any], decay: float) -> None:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
        state["step"] += 1
        steps, (beta1, beta2) = int(state["step"].item()), group["betas"]
        gradient = parameter.grad
        assert gradient is not None
        if not gradient.is_contiguous():
            parameter.grad = gradient = gradient.contiguous()
        tensors = (parameter, gradient, state["exp_avg"], state["exp_avg_sq"])
        numbers = (
            1.0 - beta1,
            beta2,
            1.0 - beta2,
            float(group["lr"]) / (1.0 - beta1**steps),
            math.sqrt(1.0 - beta2**steps),
            group["eps"],
            decay,
        )
        flat = (tensor.detach().view(-1).numpy() for tensor in tensors)
        arguments = (*flat, np.array(numbers, np.float32))
        if parameter.numel() < THREADED_SIZE:
            _update(0, 1, *arguments)
        else:
            run_threads(_update, *arguments)
        # The kernel went behind torch's back.
        torch.autograd.graph.increment_version((parameter, gradient))
        self._zeroed[parameter] = (gradient, gradient._version)


def _check(parameter: Tensor) -> None:
    fits = parameter.dtype == torch.float32 and parameter.device.type == "cpu"
    if not (fits and parameter.is_contiguous() and isinstance(parameter, nn.Parameter)):
        raise ValueError(
            f"FusedAdam updates contiguous float32 parameters on the CPU, not {parameter.dtype} "
            f"{list(parameter.shape)} on {parameter.device}: use torch.optim.Adam"
        )
