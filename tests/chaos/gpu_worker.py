"""`python -m worker`, which says that it has a GPU; its stages are told of none."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

from worker.__main__ import main
from worker.containment.plan import Plan
from worker.containment.planning import make_plan


def plan_without_gpu(*places: Any, has_gpu: bool) -> Plan:
    """As `make_plan`."""
    del has_gpu
    return make_plan(*places, has_gpu=False)


if __name__ == "__main__":
    with (
        patch("worker.__main__.find_gpu", lambda *_: True),
        patch("worker.runtime.make_plan", plan_without_gpu),
    ):
        main()
