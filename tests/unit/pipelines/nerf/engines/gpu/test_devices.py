"""Training steps on a device without values: nothing of the CPU is mixed in, nothing is asked.

Run in a process of their own, since a device's name is PyTorch's for good. A step that passes has
what a CUDA graph asks of it, apart from what CUDA itself may say.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.unit.pipelines.nerf.engines.gpu import pretend_step

ROOT = Path(__file__).resolve().parents[6]
LIMIT_S = 200


def printed(*arguments: str) -> list[str]:
    """Lines of `pretend_step`."""
    answer = subprocess.run(
        [sys.executable, "-m", pretend_step.__name__, *arguments],
        cwd=ROOT,
        env=dict(os.environ, OMP_NUM_THREADS="1"),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert answer.returncode == 0, answer.stderr[-3000:]
    return answer.stdout.splitlines()


def test_all_kinds_of_steps_stay_on_their_device_and_ask_it_nothing() -> None:
    assert len(printed()) == len(pretend_step.CASES)
    kinds = {(kind.update_proposals, kind.annealing) for kind, *_ in pretend_step.CASES}
    assert len(kinds) == 4


def test_what_would_wait_for_a_gpu_or_mix_devices_is_noticed() -> None:
    lines = printed("--broken")
    assert len(lines) == 7
    assert not [line for line in lines if "went through" in line]
