"""A kernel that doubles numbers: the least that tells whether Triton can compile on a machine."""

# As in `hash_kernels`: triton infers the types of kernels.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import torch
import triton
import triton.language as tl

_BLOCK = 1024


@triton.jit
def _double(numbers, count, block: tl.constexpr):
    """numbers [count] float32, in place; `block` of them a program."""
    place = tl.program_id(0) * block + tl.arange(0, block)
    known = place < count
    tl.store(numbers + place, 2.0 * tl.load(numbers + place, mask=known), mask=known)


def doubled(count: int, device: str = "cuda") -> float:
    """The sum of `count` ones that a kernel has doubled."""
    numbers = torch.ones(count, device=device)
    _double[(triton.cdiv(count, _BLOCK),)](numbers, count, block=_BLOCK)
    return float(numbers.sum())
