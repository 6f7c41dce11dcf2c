"""Whether stages can compute on this machine's GPU: tried before a worker says that it has one.

A GPU that is there may be out of a stage's reach all the same: a driver too old for PyTorch, a
PyTorch without code for the GPU, a device file that nobody made, something that containment closes.
Stages would then compute on the processor, for hours where minutes were meant, and nothing would
say so. So a process as contained as a stage's tries it (`worker.gpu_trial`), and a worker that
cannot use its GPU says why and goes without. Kernels of our own are tried too: without them a GPU
is used, at a tenth of its speed.
"""

from __future__ import annotations

import importlib.metadata
import logging
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from storage.settings import StorageSettings
from worker.containment.plan import Plan
from worker.containment.planning import make_plan
from worker.gpu_trial import CANNOT_COMPILE
from worker.settings import WorkerSettings

_log = logging.getLogger("nerfworks.worker")
_TRIAL_S = 180.0
"""PyTorch's libraries have gigabytes, which a cold disk reads slowly."""
_TOLD_LINES = 6
"""Of what a compiler says."""


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


@dataclass(frozen=True)
class Trial:
    """What a process found that tried the GPU. problem: why it cannot compute there, in a line.
    kernels: why it can, and cannot compile kernels of our own."""

    problem: str | None = None
    kernels: str | None = None


def try_gpu(plan: Plan) -> Trial:
    """Have a process with this plan compute on the GPU."""
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
        return Trial(f"it did not answer within {_TRIAL_S:.0f} s")
    if trial.returncode == 0:
        return Trial()
    if trial.returncode == CANNOT_COMPILE:
        compiler = errors.strip().splitlines()[:_TOLD_LINES]
        return Trial(kernels=" | ".join([said.strip(), *compiler]))
    lines = (said.strip() or errors.strip()).splitlines()
    return Trial(
        lines[-1] if lines else f"a process that tried it ended with status {trial.returncode}"
    )


def find_gpu(storage: StorageSettings, settings: WorkerSettings) -> bool:
    """Whether this machine has a GPU that stages can use. Says in the log why where it has one that
    they cannot, or can use slowly alone."""
    if not detect_gpu():
        return False
    plan = make_plan(storage, settings, os.environ, has_gpu=True)
    trial = try_gpu(plan)
    if trial.problem is None and trial.kernels is None:
        return True
    outside = try_gpu(replace(plan, mode="off"))
    if outside.problem is not None:
        _log.error("This machine's GPU is not used: %s", outside.problem)
        return False
    # Outside, the driver also made devices that were missing, which another plan has.
    trial = try_gpu(make_plan(storage, settings, os.environ, has_gpu=True))
    if trial.problem is not None:
        _log.error(
            "This machine's GPU is not used, since it works for everybody but contained stages: "
            "%s. NERFWORKS_WORKER_CONTAIN=off runs stages uncontained, with the GPU.",
            trial.problem,
        )
        return False
    if trial.kernels is not None:
        _log.error(
            "Stages use this machine's GPU some ten times slower than they could, since they "
            "cannot compile kernels for it: %s. %s",
            trial.kernels,
            "It needs a C compiler (gcc, or what CC names) and the headers of this Python."
            if outside.kernels is not None
            else "It works for everybody but contained stages: name the folders of the C compiler "
            "in NERFWORKS_WORKER_STAGE_READABLE, or run stages uncontained with "
            "NERFWORKS_WORKER_CONTAIN=off.",
        )
    return True
