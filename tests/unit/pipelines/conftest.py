"""One tiny trained job for all tests of what comes behind training; they must not change it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


@pytest.fixture(scope="session")
def trained_job(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A job whose `train` stage is complete."""
    workspace = tiny_job.make_capture(tmp_path_factory.mktemp("trained") / "job")
    tiny_job.run(workspace, "train")
    return workspace


@pytest.fixture
def job(trained_job: Workspace, tmp_path: Path) -> Workspace:
    """A copy of the trained job that a test may add stages to."""
    shutil.copytree(trained_job.root, tmp_path / "job")
    return Workspace(tmp_path / "job")
