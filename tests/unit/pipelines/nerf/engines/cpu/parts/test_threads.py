"""Two pools of threads live in a training process, torch's and ours: they never run at once, and
none comes from a library that a bare machine lacks. In processes of their own, to see what loads.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="threads are NOT tested: it looks into /proc"
)

_LIBRARIES = """
import json, os, re, sys
import numba
from pipelines.nerf import compiling as warm, made_jobs
from pipelines.options import resolve_options, stage_options, train_config
import pipelines.stages.train

config = train_config(stage_options("train", resolve_options("preview", {})["train"]))
for part in warm.PARTS:
    made_jobs.run_part(part, config)
try:
    layer = numba.threading_layer()
except ValueError:
    layer = None
paths = {line.split()[-1] for line in open("/proc/self/maps") if ".so" in line}
pools = [path for path in paths if re.search(r"gomp|iomp|libomp|tbb|workqueue|omppool", path)]
askers = [
    path
    for path in paths
    if "/torch/" not in path
    and os.path.exists(path)
    and any(name in open(path, "rb").read() for name in (b"libgomp.so", b"libomp.so", b"libiomp5"))
]
heavy = [name for name in ("sklearn", "open3d", "pycolmap") if name in sys.modules]
print(json.dumps({"layer": layer, "pools": pools, "askers": askers, "heavy": heavy}))
"""

_POOLS = """
import json, os, threading, time
import numpy as np
import torch
from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads

torch.set_num_threads(2)
torch.rand(2_000_000).exp().sum()  # starts torch's pool
main = threading.get_native_id()


def used():
    found = {}
    for task in os.listdir("/proc/self/task"):
        fields = open(f"/proc/self/task/{task}/stat").read().rpartition(")")[2].split()
        found[int(task)] = int(fields[11]) + int(fields[12])
    return found


@compiled
def spin(share, shares, out):
    total = 0.0
    for index in range(300_000_000):
        total += 1.0 / (index + share + 1)
    out[share] = total


out = np.zeros(16)
run_threads(spin, out)  # compiles
time.sleep(0.2)
before = used()
run_threads(spin, out)
after = used()
others = {task: after[task] - before[task] for task in before if task != main}
print(json.dumps({"others": others, "main": after[main] - before[main]}))
"""


def run(program: str, folder: Path, **environment: str) -> dict[str, Any]:
    """What a program prints as JSON. It is a file, so that its kernels can be cached."""
    script = folder / "program.py"
    script.write_text(program)
    root = str(Path(__file__).resolve().parents[7])
    finished = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "2", **environment},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert finished.returncode == 0, finished.stderr
    found: dict[str, Any] = json.loads(finished.stdout.splitlines()[-1])
    return found


def test_training_and_rendering_need_no_system_library_of_threads(tmp_path: Path) -> None:
    """A bare Debian has no libgomp: the only one is that of torch's wheel, and nothing of the other
    wheels that a training process loads asks for one by name."""
    found = run(_LIBRARIES, tmp_path)
    assert found["layer"] is None, "numba started a threading layer"
    assert found["heavy"] == [], "these bring or want threads of their own"
    assert found["askers"] == []
    assert len(found["pools"]) == 1, found["pools"]
    assert "torch" in Path(found["pools"][0]).parts, found["pools"]


def test_torchs_threads_sleep_while_a_kernel_runs(tmp_path: Path) -> None:
    found = run(_POOLS, tmp_path, OMP_WAIT_POLICY="passive", NUMBA_CACHE_DIR=str(tmp_path))
    assert found["others"], "torch has no pool: nothing was tested"
    assert set(found["others"].values()) == {0}, found
    assert found["main"] > 5, "the kernel was too short to tell"
