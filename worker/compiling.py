"""Compiles the kernels of the presets while the worker starts and jobs are in their first stages.

In processes of their own with the least priority, one for each part of a job: they use what the
stages leave. A stage that needs kernels which are not there yet waits for them, or takes their
compilation over where they get no processor time (`pipelines.nerf.compiling`).
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys

from pipelines.options import PRESETS, resolve_options, stage_options, train_config
from worker.process import scrubbed_environment

_PARTS = ("stereo", "training", "rendering")


class KernelCompiler:
    """Started once; ends by itself when all is compiled, and with the worker."""

    def __init__(self) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start to compile what is not compiled yet."""
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
                    *(sys.executable, "-m", "pipelines.nerf.compiling", part),
                    *("--background", "--parent", str(os.getpid())),
                ],
                stdin=subprocess.PIPE,
                env=scrubbed_environment(os.environ),
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
