"""The names that the bell and the workers share: queues, and the one kind of message."""

from __future__ import annotations

QUEUE_CPU = "cpu"
QUEUE_GPU = "gpu"
QUEUE_LIGHT = "light"
QUEUES = (QUEUE_CPU, QUEUE_GPU, QUEUE_LIGHT)
RESOURCE_CPU = "cpu"
RESOURCE_GPU = "gpu"
RESOURCES = (RESOURCE_CPU, RESOURCE_GPU)
TASK_RUN_STAGE = "nerfworks.run_stage"


def resource_of(needs_gpu: bool) -> str:
    """The resource that a stage runs on."""
    return RESOURCE_GPU if needs_gpu else RESOURCE_CPU


def queue_for(resource: str, gpu_is_live: bool) -> str:
    """CPU workers serve GPU stages where no GPU worker is."""
    return QUEUE_GPU if resource == RESOURCE_GPU and gpu_is_live else QUEUE_CPU
