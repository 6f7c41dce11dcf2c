"""Compiles the kernels of the presets while the worker starts and jobs are in their first stages.

In processes of their own with the least priority, one for each part of a job: they use what the
stages leave. A stage that needs kernels which are not there yet waits for them, or takes their
compilation over where they get no processor time (`pipelines.nerf.compiling`).
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

from pipelines.options import resolve_options, stage_options, train_config
from pipelines.presets import PRESETS
from worker.containment.plan import Plan

_PARTS = ("stereo", "training", "rendering")
_PACKAGES = ("pipelines", "storage", "worker")


def compile_sources(root: Path) -> subprocess.Popen[bytes] | None:
    """Have our own modules compiled where they are not: a contained process cannot keep what it
    compiles, and would do it again at each start. None where there is nothing to do."""
    sources = [path for name in _PACKAGES for path in (root / name).rglob("*.py")]
    if all(_is_compiled(path) for path in sources):
        return None
    folders = [str(root / name) for name in _PACKAGES]
    return subprocess.Popen(
        [sys.executable, "-m", "compileall", "-q", *folders],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _is_compiled(source: Path) -> bool:
    try:
        compiled = os.stat(importlib.util.cache_from_source(str(source)))
        return compiled.st_mtime >= source.stat().st_mtime
    except OSError:
        return False


class KernelCompiler:
    """Started once; ends by itself when all is compiled, and with the worker."""

    def __init__(self, plan: Plan) -> None:
        """plan: what the processes may touch."""
        self._plan = plan
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start to compile kernels that are not compiled yet."""
        configs = [
            dataclasses.asdict(
                train_config(stage_options("train", resolve_options(name, {})["train"]))
            )
            for name, preset in PRESETS.items()
            if "train" not in preset.without
        ]
        for part in _PARTS:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "worker.containment", "--plan", self._plan.to_json()),
                    *("pipelines.nerf.compiling", part),
                    *("--background", "--parent", str(os.getpid())),
                ],
                stdin=subprocess.PIPE,
                env=dict(self._plan.environment),
            )
            self._processes.append(process)
            assert process.stdin is not None
            with process.stdin:
                process.stdin.write(json.dumps(configs).encode())

    def stop(self) -> None:
        """End what still compiles."""
        for process in self._processes:
            process.kill()
            process.wait()
