"""Vector code for kernels: 16 float32 samples at once, written as LLVM instructions.

LLVM turns it into AVX-512, AVX2 or NEON for the machine at hand. `Lanes` is what the intrinsics of
the other files are written with; `exp_lanes` and `expm1_lanes` are the exponentials, whose scalar
forms in the C library cost more than all else that a density goes through.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from pipelines.nerf.engines.cpu.parts.runtime import exact

LANES = 16
FLOAT, INT32, INT64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT32, LANES)
SUM_FLAGS = ("contract", "nsz", "reassoc")

# exp(x) for x below is 0 and above infinity in float32.
EXP_LOWEST, EXP_HIGHEST = -105.0, 90.0
EXPM1_HIGHEST = 88.0  # where 2^n is finite; it is meant for negative x
# ln 2 in two parts, the first with so few bits that its product with an exponent is exact.
LN2_HIGH, LN2_LOW = 0.693359375, -2.12194440e-4
# Adding it to a float32 leaves the nearest integer in the lowest bits.
ROUNDER = 1.5 * 2.0**23


def _exp_coefficients(degree: int = 7) -> list[float]:
    """c_k of exp(r) - 1 = r + r^2 (c_2 + c_3 r + ...) on |r| <= ln(2) / 2, highest first.

    An interpolation at Chebyshev nodes; degree 7 leaves an error below 1e-8 of r.
    """
    count = degree - 1
    nodes = 0.35 * np.cos((2.0 * np.arange(count) + 1.0) * math.pi / (2.0 * count))
    rest = [sum(r**k / math.factorial(k + 2) for k in range(20)) for r in nodes]
    return [float(c) for c in np.polyfit(nodes, rest, count - 1)]


class Lanes:
    """An LLVM builder with the few vector operations that kernels need.

    Addresses are integers, in bytes. Names are those of LLVM where it has one.
    """

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def floats(self, value: float) -> Any:
        """A constant in all lanes."""
        return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)

    def ints(self, value: int) -> Any:
        """A constant in all lanes, int32."""
        return ir.Constant(INTS, [value] * LANES)

    def at(self, address: Any, num_bytes: int) -> Any:
        """The address so many bytes further."""
        return self.builder.add(address, ir.Constant(address.type, num_bytes))

    def load(self, address: Any, kind: Any = FLOATS) -> Any:
        """A value of that kind at any address."""
        return self.builder.load(self.builder.inttoptr(address, kind.as_pointer()), align=4)

    def store(self, value: Any, address: Any) -> None:
        """Write a value to any address."""
        self.builder.store(value, self.builder.inttoptr(address, value.type.as_pointer()), align=4)

    def splat(self, value: Any) -> Any:
        """One number in all lanes."""
        kind = ir.VectorType(value.type, LANES)
        undefined = ir.Constant(kind, ir.Undefined)
        single = self.builder.insert_element(undefined, value, ir.Constant(INT32, 0))
        return self.builder.shuffle_vector(single, undefined, self.ints(0))

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=SUM_FLAGS)

    def mul(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=SUM_FLAGS)

    def raise_to(self, value: Any, low: Any) -> Any:
        """max(value, low); a NaN stays one."""
        return self.builder.select(self.builder.fcmp_ordered("<", value, low), low, value)

    def lower_to(self, value: Any, high: Any) -> Any:
        """min(value, high); a NaN stays one."""
        return self.builder.select(self.builder.fcmp_ordered(">", value, high), high, value)

    def without_nan(self, value: Any) -> Any:
        """0 where the value is not a number."""
        number = self.builder.fcmp_ordered("ord", value, value)
        return self.builder.select(number, value, self.floats(0.0))


def _power_of_two(lanes: Lanes, exponent: Any) -> Any:
    """2^n for int32 n in [-126, 127]."""
    build = lanes.builder
    biased = build.shl(build.add(exponent, lanes.ints(127)), lanes.ints(23))
    return build.bitcast(biased, FLOATS)


def _exponential(lanes: Lanes, x: Any, minus_one: bool) -> Any:
    """exp(x), or exp(x) - 1 without cancellation: x = n ln 2 + r, exp(x) = 2^n (1 + expm1(r))."""
    build = lanes.builder
    highest = EXPM1_HIGHEST if minus_one else EXP_HIGHEST
    x = lanes.lower_to(lanes.raise_to(x, lanes.floats(EXP_LOWEST)), lanes.floats(highest))
    # Reordered, the rounding would be undone: hence `exact` below, as numba sets the flags of a
    # whole function.
    shifted = build.fadd(build.fmul(x, lanes.floats(1.0 / math.log(2.0))), lanes.floats(ROUNDER))
    whole = build.fsub(shifted, lanes.floats(ROUNDER))
    exponent = build.sub(build.bitcast(shifted, INTS), build.bitcast(lanes.floats(ROUNDER), INTS))
    rest = build.fsub(x, build.fmul(whole, lanes.floats(LN2_HIGH)))
    rest = build.fsub(rest, build.fmul(whole, lanes.floats(LN2_LOW)))
    first, *others = _exp_coefficients()
    series = lanes.floats(first)
    for coefficient in others:
        series = lanes.add(lanes.mul(series, rest), lanes.floats(coefficient))
    beyond = lanes.add(rest, lanes.mul(lanes.mul(rest, rest), series))  # expm1(r)
    # In two halves, because 2^128 and 2^-150 are no float32 but their products with 1 + .. may be.
    half = build.ashr(exponent, lanes.ints(1))
    low, high = _power_of_two(lanes, half), _power_of_two(lanes, build.sub(exponent, half))
    one = lanes.floats(1.0)
    if minus_one:
        power = build.fmul(low, high)
        return build.fadd(build.fmul(power, beyond), build.fsub(power, one))
    return build.fmul(build.fmul(build.fadd(one, beyond), low), high)


@intrinsic
def exp_lanes(typing_context, source, target):
    """target[:16] = exp(source[:16]); addresses of float32. NaN stays NaN."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = Lanes(builder)
        lanes.store(_exponential(lanes, lanes.load(arguments[0]), False), arguments[1])
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), generate


@intrinsic
def expm1_lanes(typing_context, source, target):
    """target[:16] = exp(source[:16]) - 1; addresses of float32. NaN stays NaN."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = Lanes(builder)
        lanes.store(_exponential(lanes, lanes.load(arguments[0]), True), arguments[1])
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), generate


@exact
def exp_all(source, count, target):
    """target = exp(source) for the first `count`, rounded up to 16, float32 numbers of a row."""
    source_at, target_at = np.intp(source.ctypes.data), np.intp(target.ctypes.data)
    for begin in range(0, count, LANES):
        exp_lanes(source_at + begin * 4, target_at + begin * 4)  # type: ignore[call-arg]


@exact
def expm1_all(source, count, target):
    """target = exp(source) - 1 for source of at most 88, otherwise as `exp_all`."""
    source_at, target_at = np.intp(source.ctypes.data), np.intp(target.ctypes.data)
    for begin in range(0, count, LANES):
        expm1_lanes(source_at + begin * 4, target_at + begin * 4)  # type: ignore[call-arg]
