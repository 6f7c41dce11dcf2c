"""An export asked for over HTTP of a job that was trained before and whose capture is gone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from api.client.models import ApiProblem
from deploy.embedded import Embedded
from pipelines.exports.formats.glb import read_mesh
from pipelines.exports.mesh import TexturedMesh
from storage.db import Database
from storage.open_objects import open_object_store
from storage.schema import upgrade
from storage.settings import StorageSettings
from tests.e2e.conftest import running
from tests.e2e.waiting import succeeded
from tests.gltf_validator import problems_of
from tests.trained_jobs import trained_job
from tests.unit.pipelines.stages import tiny_job

pytestmark = [pytest.mark.services, pytest.mark.timeout(600)]

CENTER, SIZE = (0.1, 0.0, 0.4), (2.4, 2.2, 1.6)
ASKED = {
    "formats": ["glb", "obj"],
    "texture": "photos",
    "triangles": 500,
    "crop": {"shape": "box", "center": CENTER, "size": SIZE},
}


def test_a_mesh_is_cropped_reduced_painted_and_valid_when_it_comes_down(
    tmp_path: Path, cache: Path
) -> None:
    workspace = tiny_job.make_capture(tmp_path / "made before")
    tiny_job.run(workspace, "train")
    trained: list[str] = []

    def before(embedded: Embedded) -> None:
        settings = StorageSettings(home=embedded.home)
        upgrade(settings.resolved_database_url)
        database = Database(settings.resolved_database_url)
        trained.append(trained_job(database, open_object_store(settings), tmp_path, workspace))
        database.dispose()

    with running(tmp_path / "home", cache, before) as (client, embedded, _):
        job_id = trained[0]
        with pytest.raises(ApiProblem) as refused:
            client.export(job_id, "mesh", ASKED | {"triangles": -1})
        assert refused.value.status == 422
        assert "triangles" in str(refused.value.errors)
        assert list(client.exports(job_id)) == []
        asked = client.export(job_id, "mesh", ASKED, idempotency_key="once")
        assert client.export(job_id, "mesh", ASKED, idempotency_key="once").id == asked.id
        over = succeeded(client, embedded, asked.id, 300)
        assert [export.id for export in client.exports(job_id)] == [asked.id]
        assert {artifact.name for artifact in client.artifacts(asked.id)} >= {
            "mesh.glb",
            "mesh.obj.zip",
        }
        client.download(asked.id, tmp_path / "out")

    path = tmp_path / "out" / "mesh.glb"
    assert problems_of(path) == []
    mesh = read_mesh(path)
    assert isinstance(mesh, TexturedMesh)
    told = over.export
    assert told is not None
    assert told.result is not None
    assert 50 < len(mesh.faces) == told.result["num_faces"] <= 505
    assert max(mesh.texture.shape) == told.result["texture_px"]
    away = np.abs(mesh.vertices - np.asarray(CENTER))
    assert (away <= np.asarray(SIZE) / 2.0 + 1e-3).all()
    assert told.result["crop"]["used"]["size"] == list(SIZE)
    assert told.result["frame"]["name"] == "gravity"
