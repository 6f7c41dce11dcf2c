"""An export that is made later, elsewhere, from what the job's stages published alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.exports.catalogue import KINDS, get_export
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_same_bytes_as_at_once(job: Workspace, tmp_path: Path, kind: str) -> None:
    """Its folder holds nothing but the stages that the export says it reads: no capture."""
    if kind == "meshvideo":
        tiny_job.run(job, "mesh", refine="none", texture="none")
    at_once = tiny_job.run(job, kind)
    later = Workspace(tmp_path / "another machine")
    for name in (*get_export(kind).reads, "train"):
        if job.is_complete(name):
            shutil.copytree(job.stage(name), later.stage(name))
    again = tiny_job.run(later, kind)
    assert again["files"] == at_once["files"]
    assert again["fingerprint"] == at_once["fingerprint"]
    assert at_once["files"]
