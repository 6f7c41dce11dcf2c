"""`report.json` of a job that failed: written by the worker of the stage that ended it.

Beside it goes the capture report, where the stage's process has left one (`Stage.explains`).

It is published like the files of an attempt that succeeded, below the attempt's own prefix, and
recorded with the failure. Where that is not possible the job fails without one: the error counts.
A stage that is lost together with its worker, over and over, leaves none.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from pipelines.manifest import list_files
from pipelines.stage import REPORT
from pipelines.stages.report import keep_capture_report, write_failed_report
from pipelines.workspace import Workspace
from storage.claims import Claim
from storage.db import Database
from storage.errors import StorageError
from storage.leases import FailureReport
from storage.objects import ObjectStore
from storage.queries import stage_work
from worker.transfer import upload_folder

_log = logging.getLogger("nerfworks.worker")


def publish_failure(
    database: Database,
    store: ObjectStore,
    claim: Claim,
    work_dir: Path,
    error: Mapping[str, Any],
    prefix: str,
) -> FailureReport | None:
    """Write the report of a job that this claim's stage may end, and upload it.

    error: `{code, message, hint, ...}`. prefix: of the attempt. None where it could not be stored,
    and for an export: the report is about a job, and an export's error says all of it.
    """
    workspace = Workspace(work_dir / claim.job_id)
    folder = workspace.failed(claim.name) / "job"
    try:
        with database.read_scope() as session:
            work = stage_work(session, claim)
        if work.is_export:
            return None
        manifests = {name: found.manifest for name, found in work.inputs.items()}
        write_failed_report(folder / REPORT, workspace, manifests, claim.name, error)
        keep_capture_report(workspace, claim.name, folder)
        upload_folder(store, folder, prefix, lambda: None, workers=1, step="report")
        return FailureReport(prefix, list_files(folder))
    except (StorageError, SQLAlchemyError, OSError, ValueError, KeyError, TypeError) as problem:
        _log.warning("%s: no report of the failure: %s", claim.stage_id, problem)
        return None
