"""The kernel that a worker tries; run by `test_kernels`, compiled or interpreted."""

from __future__ import annotations

import os

import pytest

from pipelines.nerf.engines.gpu.parts.trial_kernel import doubled

DEVICE = "cpu" if os.environ.get("TRITON_INTERPRET") == "1" else "cuda"


@pytest.mark.parametrize("count", [1, 1000, 1024, 2050])
def test_every_number_is_doubled(count: int) -> None:
    assert doubled(count, DEVICE) == 2.0 * count
