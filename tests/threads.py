"""So many threads for a test, however many all tests are given (the Makefile has why)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Torch has so many within, and so have our kernels."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """For the tests of kernels: with one thread, a kernel's work is not divided."""
    with torch_threads(2):
        yield
