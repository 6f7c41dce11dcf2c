"""Runs the checks of the Triton kernels (`check_*.py`) in a process of their own.

Triton decides when it is imported whether kernels are compiled or interpreted, for the whole
process and for good. So the checks get a process with TRITON_INTERPRET=1 from its start, and no
other test sees interpreted kernels. Where there is a GPU the same checks run compiled.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.services import missing

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[4]
CHECKS = sorted(HERE.glob("check_*.py"))
LIMIT_S = 300


SHARED_BYTES = 99 * 1024
"""Shared memory that one block may have on sm_86 and sm_89, the least from Ampere on. Source: CUDA
C++ programming guide, "Technical specifications per compute capability"."""


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


def test_kernels_compile_for_gpus_and_fit_their_shared_memory(tmp_path: Path) -> None:
    require_triton()
    environment = dict(os.environ, OMP_NUM_THREADS="1", TRITON_CACHE_DIR=str(tmp_path))
    environment.pop("TRITON_INTERPRET", None)
    module = "tests.unit.pipelines.nerf.gpu.compile_kernels"
    answer = subprocess.run(
        [sys.executable, "-m", module, "86"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert answer.returncode == 0, answer.stderr[-4000:]
    made = [json.loads(line) for line in answer.stdout.splitlines()]
    assert len(made) == 10
    assert all(item["shared_bytes"] <= SHARED_BYTES for item in made)
    # Eight corners of two features by one load each, beside three numbers of the level.
    paired = next(item for item in made if item["kernel"] == "_forward_kernel")
    assert paired["ptx_loads_of_64_bits"] >= 8 + 3


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_compiled_kernels_agree_with_the_plain_definitions() -> None:
    run_checks(interpreted=False)
