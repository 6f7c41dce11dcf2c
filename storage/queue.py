"""The names that the bell and the workers share: queues, and the one kind of message."""

from __future__ import annotations

QUEUE_CPU = "cpu"
QUEUE_GPU = "gpu"
QUEUE_LIGHT = "light"
QUEUES = (QUEUE_CPU, QUEUE_GPU, QUEUE_LIGHT)
TASK_RUN_STAGE = "nerfworks.run_stage"


def queue_for(needs_gpu: bool, gpu_is_live: bool) -> str:
    """CPU workers serve GPU stages where no GPU worker is."""
    return QUEUE_GPU if needs_gpu and gpu_is_live else QUEUE_CPU
