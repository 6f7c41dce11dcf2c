"""What stages make of the library's errors."""

from __future__ import annotations

import pytest

from pipelines.errors import TrainingError
from pipelines.nerf.errors import NerfError
from pipelines.scene.trained_scene import nerf_errors_as


@pytest.mark.parametrize("retryable", [False, True])
def test_an_error_of_the_library_says_the_same_as_one_of_a_stage(retryable: bool) -> None:
    with pytest.raises(TrainingError) as caught, nerf_errors_as(TrainingError):
        raise NerfError("gpu_lost", "The GPU is gone.", "Look for it.", retryable=retryable)
    assert caught.value.as_dict() == {
        "code": "gpu_lost",
        "message": "The GPU is gone.",
        "hint": "Look for it.",
        "retryable": retryable,
        "details": {},
    }
