"""Which device an option means, on this machine without a GPU."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.devices import GPU_EXPECTED, choose_device
from pipelines.nerf.errors import NerfError

without_gpu = pytest.mark.skipif(
    torch.cuda.is_available(), reason="no GPU is NOT tested: there is one"
)


@without_gpu
def test_without_a_gpu_auto_means_the_processor_and_cuda_is_refused() -> None:
    assert choose_device("auto") == choose_device("cpu") == torch.device("cpu")
    with pytest.raises(NerfError, match=r"depth\.device is 'cuda'"):
        choose_device("cuda", "depth.device")


@without_gpu
def test_where_a_gpu_was_seen_to_work_auto_never_means_the_processor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(GPU_EXPECTED, "1")
    with pytest.raises(NerfError) as raised:
        choose_device("auto")
    assert (raised.value.code, raised.value.retryable) == ("gpu_lost", True)
    assert choose_device("cpu") == torch.device("cpu")
