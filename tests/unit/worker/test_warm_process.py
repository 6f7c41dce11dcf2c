"""A stage process serves one job after the other without loading anything twice."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.settings import StorageSettings
from tests.unit.pipelines.stages.tiny_job import make_capture, options_of
from worker.containment.planning import make_plan
from worker.process import StageProcess
from worker.settings import WorkerSettings

REGISTRY = "tests.unit.worker.watched_stages"


@pytest.fixture
def process(tmp_path: Path) -> Iterator[StageProcess]:
    # The test's captures lie where jobs would: a stage process reaches nothing else.
    settings = WorkerSettings(stage_writable=str(tmp_path))
    storage = StorageSettings(home=tmp_path / "home")
    made = StageProcess(REGISTRY, make_plan(storage, settings, os.environ, has_gpu=False))
    yield made
    made.kill()


def train(process: StageProcess, root: Path) -> dict[str, Any]:
    """Train on a tiny capture of its own in the process; the manifest."""
    lines: list[str] = []
    workspace = make_capture(root, num_images=8)
    options = options_of("train", max_steps=3, rays_per_step=128)
    process.start_run(
        root.name, lines.append, stage="train", options=options, root=str(workspace.root), seed=0,
        threads=2, token="a-token", cpu_s=600.0, memory="full",
        temporary=str(workspace.temporary("train")),
    )  # fmt: skip
    while True:
        message = process.messages.get(timeout=300)
        assert message["type"] not in ("failed", "exit"), "\n".join(lines)
        if message["type"] == "done":
            manifest: dict[str, Any] = message["manifest"]
            return manifest


def test_the_second_job_imports_and_compiles_nothing(process: StageProcess, tmp_path: Path) -> None:
    first = train(process, tmp_path / "first")
    second = train(process, tmp_path / "second")
    assert "torch" in first["summary"]["new_modules"]
    assert second["summary"]["pid"] == first["summary"]["pid"] == process.pid
    assert second["summary"]["new_modules"] == []
    assert second["summary"]["kernels"] == first["summary"]["kernels"] > 0
    assert second["timings"]["compile_s"] == 0.0
