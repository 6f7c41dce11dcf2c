"""The draft where there is nothing to draft from."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.errors import ExportError
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


@pytest.fixture
def without_maps(tmp_path: Path) -> Workspace:
    """A capture that no depth maps were made of."""
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=8)
    tiny_job.run(workspace, "depth", source="off")
    return workspace


def test_a_job_goes_on_without_a_draft(without_maps: Workspace) -> None:
    summary = tiny_job.run(without_maps, "draft")["summary"]
    assert summary == {"num_faces": 0, "why": "there are no depth maps"}
    assert not (without_maps.stage("draft") / "draft.glb").exists()


def test_a_draft_that_is_required_fails_the_job(without_maps: Workspace) -> None:
    with pytest.raises(ExportError, match="there are no depth maps") as caught:
        tiny_job.run(without_maps, "draft", required=True)
    assert caught.value.code == "empty_mesh"
    assert "preview" in caught.value.hint
