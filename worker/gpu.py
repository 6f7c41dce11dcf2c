"""Whether stages can compute on this machine's GPU: tried before a worker says that it has one.

A GPU that is there may be out of a stage's reach all the same: a driver too old for PyTorch, a
PyTorch without code for the GPU, a device file that nobody made, something that containment closes.
Stages would then compute on the processor, for hours where minutes were meant, and nothing would
say so. So a process as contained as a stage's tries it (`worker.gpu_trial`), and a worker that
cannot use its GPU says why and goes without.
"""

from __future__ import annotations

import importlib.metadata
import logging
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from storage.settings import StorageSettings
from worker.containment.plan import Plan
from worker.containment.planning import make_plan
from worker.settings import WorkerSettings

_log = logging.getLogger("nerfworks.worker")
_TRIAL_S = 180.0
"""PyTorch's libraries have gigabytes, which a cold disk reads slowly."""


def detect_gpu() -> bool:
    """Whether this machine has an NVIDIA device that our torch could use. Imports no torch."""
    if os.environ.get("CUDA_VISIBLE_DEVICES", "0").strip() in ("", "-1"):
        return False
    try:
        if importlib.metadata.version("torch").endswith("+cpu"):
            return False
    except importlib.metadata.PackageNotFoundError:
        return False
    if any(Path("/dev").glob("nvidia[0-9]*")):
        return True
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return listed.returncode == 0 and b"GPU" in listed.stdout


def trial_problem(plan: Plan) -> str | None:
    """Why a process with this plan cannot compute on the GPU, in a line; None where it can."""
    command = ["-m", "worker.containment", "--plan", plan.to_json(), "worker.gpu_trial"]
    trial = subprocess.Popen(
        [sys.executable, *command],
        env=dict(plan.environment),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        said, errors = trial.communicate(timeout=_TRIAL_S)
    except subprocess.TimeoutExpired:
        trial.kill()  # not waited for: a process that hangs in the driver does not end even so
        return f"it did not answer within {_TRIAL_S:.0f} s"
    if trial.returncode == 0:
        return None
    lines = (said.strip() or errors.strip()).splitlines()
    return lines[-1] if lines else f"a process that tried it ended with status {trial.returncode}"


def find_gpu(storage: StorageSettings, settings: WorkerSettings) -> bool:
    """Whether this machine has a GPU that stages can use. Says in the log why where it has one that
    they cannot."""
    if not detect_gpu():
        return False
    plan = make_plan(storage, settings, os.environ, has_gpu=True)
    if trial_problem(plan) is None:
        return True
    outside = trial_problem(replace(plan, mode="off"))
    if outside is not None:
        _log.error("This machine's GPU is not used: %s", outside)
        return False
    # Outside, the driver also made devices that were missing, which another plan has.
    problem = trial_problem(make_plan(storage, settings, os.environ, has_gpu=True))
    if problem is None:
        return True
    _log.error(
        "This machine's GPU is not used, since it works for everybody but contained stages: %s. "
        "NERFWORKS_WORKER_CONTAIN=off runs stages uncontained, with the GPU.",
        problem,
    )
    return False
