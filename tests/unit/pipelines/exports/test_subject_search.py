"""What was filmed is decided once, in one way, whatever is asked for, on a tiny trained model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipelines.exports.subject_files import as_dict
from pipelines.exports.subject_search import search_subject
from pipelines.manifest import RunHooks
from pipelines.nerf.options.render import RenderConfig
from pipelines.scene import gaze
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job

FAST = {"texture": "none", "refine": "none", "close_holes": 0.0}


def _made(job: Workspace, kind: str, **changes: Any) -> tuple[dict[str, Any], list[str]]:
    """The summary of an export, and what its progress said."""
    said: list[str] = []
    hooks = RunHooks(on_progress=lambda fraction, message, eta_s: said.append(message))
    return tiny_job.run_with(job, kind, hooks, **changes)["summary"], said


def _searches(said: list[str]) -> int:
    return len(
        [message for message in said if message.startswith("looking for the subject, view 1/")]
    )


def test_mesh_and_cloud_are_of_the_same_thing_however_they_are_asked_for(job: Workspace) -> None:
    """The finished meshes differ: by these the rule would find other regions, or none."""
    asked: list[tuple[str, dict[str, Any]]] = [
        ("pointcloud", {"extent": "subject"}),
        ("mesh", {"extent": "subject", "resolution": 32, **FAST}),
        ("mesh", {"extent": "auto", "max_distance": 1.2, "num_views": 6, **FAST}),
    ]
    found = []
    for kind, changes in asked:
        made, said = _made(job, kind, **changes)
        assert _searches(said) == 1, (kind, changes)
        found.append({key: made["subject"][key] for key in ("kind", "why", "measures", "region")})
    assert found[0]["kind"] == "subject", found[0]
    assert all(one == found[0] for one in found[1:]), found


def test_what_rendering_leaves_out_decides_nothing(job: Workspace, tmp_path: Path) -> None:
    """Rendered so, the probes show no surface at all."""
    ctx = StageContext(workspace=job, stage="mesh", out=tmp_path, checkpoint=tmp_path)
    model = job.stage("train") / "model.zip"
    plain = TrainedScene.load(model)
    scant = TrainedScene.load(model, RenderConfig(color_weight=0.5, skip_below=0.3))
    assert scant.bounds(2.0) is None
    wanted = as_dict(search_subject(plain, plain.probe_views(), ctx))
    assert wanted["kind"] == "subject", wanted
    assert as_dict(search_subject(scant, scant.probe_views(), ctx)) == wanted


@pytest.mark.parametrize(("kind", "changes"), [("pointcloud", {}), ("mesh", FAST)])
def test_what_is_cropped_and_what_is_kept_is_sought_once(
    job: Workspace, monkeypatch: pytest.MonkeyPatch, kind: str, changes: dict[str, Any]
) -> None:
    monkeypatch.setattr(gaze, "LEAST_ARC_DEG", 400.0)  # nobody walks round anything so far
    both = {"crop": {"shape": "auto"}, "extent": "subject"}
    made, said = _made(job, kind, **both, **changes)
    assert _searches(said) == 1
    assert made["crop"]["used"] is None
    assert made["subject"]["kind"] == "scene"
    assert made["subject"]["why"] == made["crop"]["why"]
    assert made["subject"]["region"] is not None, "what stands there is kept all the same"


def test_nothing_is_rendered_where_the_cameras_tell_it_by_themselves(
    job: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gaze, "LEAST_ARC_DEG", 400.0)
    made, said = _made(job, "mesh", **FAST)
    assert _searches(said) == 0
    assert made["subject"]["kind"] == "scene"
    assert "within" in made["subject"]["why"]
    assert not (job.stage("mesh") / "subject.glb").exists()
