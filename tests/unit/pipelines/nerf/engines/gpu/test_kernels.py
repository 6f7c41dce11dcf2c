"""Runs the checks of the Triton kernels (`check_*.py`) in a process of their own.

Triton decides when it is imported whether kernels are compiled or interpreted, for the whole
process and for good. So the checks get a process with TRITON_INTERPRET=1 from its start, and no
other test sees interpreted kernels. Where there is a GPU the same checks run compiled.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.services import missing

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[5]
CHECKS = sorted(HERE.glob("check_*.py"))
LIMIT_S = 300


def run_checks(*, interpreted: bool) -> None:
    """All checks in one process; fails with its output."""
    environment = dict(os.environ, OMP_NUM_THREADS="1")
    environment.pop("TRITON_INTERPRET", None)
    if interpreted:
        environment["TRITON_INTERPRET"] = "1"
    # numpy warns where the interpreter's hashes wrap around, as they are meant to.
    command = [sys.executable, "-W", "ignore", "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    answer = subprocess.run(
        [*command, *map(str, CHECKS)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert answer.returncode == 0, answer.stdout[-8000:] + answer.stderr[-2000:]
    assert " passed" in answer.stdout


def require_triton() -> None:
    """Fail in CI, skip elsewhere: Triton has no wheel for every platform."""
    if importlib.util.find_spec("triton") is None:
        missing("Triton")


def test_interpreted_kernels_agree_with_the_plain_definitions() -> None:
    require_triton()
    assert CHECKS
    run_checks(interpreted=True)


@pytest.mark.gpu
@pytest.mark.skipif(
    not torch.cuda.is_available(), reason="kernels on a GPU are NOT tested: no CUDA device"
)
def test_compiled_kernels_agree_with_the_plain_definitions() -> None:
    run_checks(interpreted=False)
