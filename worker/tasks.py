"""The one Celery task: takes an id only and hands over to the worker's runtime."""

from __future__ import annotations

from typing import Any

from celery import shared_task

from storage.queue import TASK_RUN_STAGE
from worker.runtime import current_runtime


@shared_task(name=TASK_RUN_STAGE)  # type: ignore[untyped-decorator]
def run_stage(stage_id: str) -> Any:
    """Run a stage, if it can be claimed, and then whatever else waits for a worker like this."""
    current_runtime().serve(stage_id)
