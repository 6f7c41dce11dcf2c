"""Which device computes: the one place that reads an option `device`."""

from __future__ import annotations

import torch

from pipelines.nerf.errors import NerfError


def choose_device(wanted: str, option: str = "train.device") -> torch.device:
    """The device for "auto", "cpu" or "cuda". Raises NerfError where CUDA is asked for in vain.

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
    return torch.device(wanted)
