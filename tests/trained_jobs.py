"""Jobs that are trained already, put into a service as its workers would have left them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.registry import STAGES
from pipelines.workspace import Workspace
from storage.claims import claim_stage
from storage.db import Database
from storage.deletions import drain_deletions
from storage.jobs import StageSeed, create_job, stage_id
from storage.keys import attempt_prefix, blob_content
from storage.leases import succeed_stage
from storage.models import Job, new_id
from storage.objects import ObjectStore
from storage.records import create_capture, delete_capture
from storage.tenants import DEFAULT_TENANT
from tests.unit.pipelines.stages import tiny_job
from worker.transfer import upload_folder

SEED = 3
"""That of `tiny_job.run`, whose files are those that are wanted."""
MADE = ("ingest", "train")


def trained_job(database: Database, store: ObjectStore, folder: Path, workspace: Workspace) -> str:
    """The id of a tiny job of which nothing is left but what its stages published.

    Its capture is deleted. folder: for passing files. No worker may run yet: it would take the
    stages.
    """
    source = folder / "tiny.zip"
    source.write_bytes(b"tiny")
    capture_id = new_id()
    key = blob_content(DEFAULT_TENANT, "0" * 64, capture_id)
    store.put_file(key, source)
    with database.session_scope() as session:
        create_capture(
            session,
            capture_id=capture_id,
            filename=source.name,
            kind="nerfstudio",
            num_bytes=4,
            sha256="0" * 64,
            brought=key,
            details={},
        )
        job = create_job(
            session,
            capture_id=capture_id,
            preset="preview",
            preset_reason="test",
            options={stage.name: tiny_job.options_of(stage.name) for stage in STAGES},
            stages=[
                StageSeed(stage.name, stage.after, skipped=stage.name not in MADE)
                for stage in STAGES
            ],
            seed=SEED,
        )
    _publish(database, store, job, workspace, MADE)
    with database.session_scope() as session:
        delete_capture(session, capture_id)
    drain_deletions(database, store)
    assert not store.exists(key)
    return job.id


def _publish(
    database: Database, store: ObjectStore, job: Job, workspace: Workspace, names: Sequence[str]
) -> None:
    """What the worker that made stages did with their folders."""
    for name in names:
        with database.session_scope() as session:
            claim = claim_stage(session, stage_id(job.id, name), "first", 60.0)
        assert claim is not None
        prefix = attempt_prefix(job.object_root, name, claim.attempt, claim.token)
        upload_folder(store, workspace.stage(name), prefix, lambda: None, workers=2, step="publish")
        with database.session_scope() as session:
            manifest = workspace.manifest(name)
            succeed_stage(session, claim, manifest=manifest, output_prefix=prefix)
