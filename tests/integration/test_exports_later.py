"""Real exports through a real worker, months later: the capture is deleted, the machine another."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipelines.nerf.engines.cpu.parts.kernel_cache import CACHE_FOLDER
from pipelines.registry import get_stage
from storage.exports import create_export, open_for_export
from storage.jobs import ready_stage_ids
from tests.integration.engine import Engine
from tests.services import RedisServer, S3Endpoint
from tests.trained_jobs import trained_job
from tests.unit.pipelines.stages import tiny_job

pytestmark = [pytest.mark.services, pytest.mark.timeout(600)]

WANTED: dict[str, dict[str, Any]] = {
    # Before the mesh: the job had none, so its cloud does not lie on one.
    "pointcloud": {"extent": "subject", "formats": ["ply", "xyz"]},
    "mesh": {"crop": {"shape": "auto"}},
    "cameras": {},
}


@pytest.fixture
def engine(
    tmp_path: Path, redis_server: RedisServer, postgres_url: str, s3_endpoint: S3Endpoint
) -> Iterator[Engine]:
    """On PostgreSQL and S3, with the stages of people's jobs, and kernels that are compiled."""
    parts = {
        **s3_endpoint.environment(),
        "NERFWORKS_DATABASE_URL": postgres_url,
        "NERFWORKS_REGISTRY": "pipelines.registry",
        "NUMBA_CACHE_DIR": str(CACHE_FOLDER.parent),
        "NERFWORKS_WORKER_STAGE_WRITABLE": str(CACHE_FOLDER.parent),
    }
    made = Engine(tmp_path, redis_server.url, **parts)
    yield made
    made.close()


def _ask(engine: Engine, job_id: str, kind: str, changes: dict[str, Any]) -> str:
    options = tiny_job.options_of(kind, **changes)
    with engine.database.session_scope() as session:
        made = create_export(session, open_for_export(session, job_id), kind, options)
        ready = ready_stage_ids(made)
    engine.bell.ring(ready)
    return made.id


def test_what_is_asked_for_later_is_what_the_job_would_have_made(
    engine: Engine, tmp_path: Path
) -> None:
    workspace = tiny_job.make_capture(tmp_path / "first machine")
    tiny_job.run(workspace, "train")
    job_id = trained_job(engine.database, engine.store, engine.folder, workspace)
    engine.start_worker()
    asked = {kind: _ask(engine, job_id, kind, changes) for kind, changes in WANTED.items()}
    elsewhere = {"crop": {"shape": "sphere", "center": [0.0, 0.0, 300.0], "radius": 1.0}}
    nowhere = _ask(engine, job_id, "mesh", elsewhere)
    for kind, changes in WANTED.items():
        tiny_job.run(workspace, kind, **changes)
        at_once = workspace.manifest(kind)
        over = engine.wait_for(asked[kind], "succeeded", "failed", timeout_s=300)
        assert over.state == "succeeded", over.error
        row = engine.stage(asked[kind], kind)
        assert row.manifest is not None
        assert row.output_prefix is not None
        assert row.manifest["files"] == at_once["files"], kind
        assert row.manifest["fingerprint"] == at_once["fingerprint"]
        assert row.summary == at_once["summary"]
        stored = {
            key.removeprefix(row.output_prefix) for key in engine.store.list(over.object_root)
        }
        names = {file["path"] for file in at_once["files"]}
        assert stored == names | {"manifest.json"}
        assert names & {artifact.path for artifact in get_stage(kind).artifacts}

    failed = engine.wait_for(nowhere, "succeeded", "failed", timeout_s=60)
    assert failed.error is not None
    assert failed.error["code"] == "export.empty"
    assert engine.stage(nowhere, "mesh").output_prefix is None
    assert list(engine.store.list(failed.object_root)) == [], "nothing half-written is listed"
