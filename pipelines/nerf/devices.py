"""Which device computes: the one place that reads an option `device`."""

from __future__ import annotations

import os

import torch

from pipelines.nerf.errors import NerfError

GPU_EXPECTED = "NERFWORKS_GPU_EXPECTED"
"""Set where a GPU was seen to work: without it "auto" must not come to mean the CPU unnoticed."""


def choose_device(wanted: str, option: str = "train.device") -> torch.device:
    """The device for "auto", "cpu" or "cuda". Raises NerfError `bad_config` where CUDA is asked for
    in vain, `gpu_lost` where "auto" finds no GPU any more.

    option: that asks, for the error.
    """
    if wanted == "cuda" and not torch.cuda.is_available():
        raise NerfError(
            "bad_config",
            f"The option {option} is 'cuda', and this machine has no usable GPU.",
            f"Set {option} to auto or cpu.",
        )
    if wanted == "auto":
        wanted = "cuda" if torch.cuda.is_available() else "cpu"
        if wanted == "cpu" and os.environ.get(GPU_EXPECTED):
            raise NerfError(
                "gpu_lost",
                "This machine's GPU worked before and does not answer any more.",
                "Look into the driver's log; a worker that is started again goes without the GPU.",
                retryable=True,
            )
    return torch.device(wanted)
