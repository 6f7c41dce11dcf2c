"""The job engine with real workers, driven through `storage` as the API drives it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sqlalchemy import update

from storage.bell import Bell
from storage.db import Database, now
from storage.jobs import StageSeed, create_job, ready_stage_ids, request_cancel, stage_id
from storage.keys import blob_content
from storage.models import Job, StageRow, StageRun, new_id
from storage.objects import ObjectStore
from storage.open_objects import open_object_store
from storage.queries import get_job
from storage.records import create_capture, read_logs
from storage.runs import list_runs
from storage.schema import upgrade
from storage.settings import StorageSettings
from storage.tenants import DEFAULT_TENANT
from tests.integration.toy_stages import STAGES

ROOT = Path(__file__).resolve().parents[2]


class Engine:
    """A service without its API. Times are shortened through the environment."""

    def __init__(self, folder: Path, redis_url: str, **environment: str) -> None:
        self.folder = folder
        self.environment = {
            "NERFWORKS_HOME": str(folder / "home"),
            "NERFWORKS_REDIS_URL": redis_url,
            "NERFWORKS_REGISTRY": "tests.integration.toy_stages",
            "NERFWORKS_SECRET_KEY": "a test",
            "NERFWORKS_WORKER_TICK_S": "0.5",
            "NERFWORKS_WORKER_DIRECT_AFTER_S": "5",
            "NERFWORKS_WORKER_CLEAN_S": "1",
            "AWS_SESSION_TOKEN_FOR_TEST": "must not be seen",
            "OMP_NUM_THREADS": "1",
            **environment,
        }
        kept = {
            name.removeprefix("NERFWORKS_").lower(): value
            for name, value in self.environment.items()
        }
        self.settings = StorageSettings(
            **{name: value for name, value in kept.items() if name in StorageSettings.model_fields}  # type: ignore[arg-type]
        )
        upgrade(self.settings.resolved_database_url)
        self.database = Database(self.settings.resolved_database_url)
        self.store: ObjectStore = open_object_store(self.settings)
        self.bell = Bell(redis_url, self.database)
        # Stages are contained: in the home they write to their job's folder and to caches alone.
        self.witness = folder / "home" / "cache" / "witness.txt"
        self.witness.parent.mkdir(parents=True, exist_ok=True)
        self.witness.touch()
        (folder / "worker.log").touch()
        self.workers: list[subprocess.Popen[bytes]] = []

    def start_worker(self, worker_id: str = "w1", *more: str) -> subprocess.Popen[bytes]:
        """Start a worker process; its log goes to `worker.log`."""
        with (self.folder / "worker.log").open("ab") as log:
            worker = subprocess.Popen(
                [sys.executable, "-m", "worker", "--id", worker_id, *more],
                cwd=ROOT,
                env={**os.environ, **self.environment},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.workers.append(worker)
        return worker

    def close(self) -> None:
        """End everything, at once: that a worker ends by itself is for tests to see."""
        alive = [worker for worker in self.workers if worker.poll() is None]
        processes = with_descendants(*(worker.pid for worker in alive))
        for pid in processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for worker in alive:
            worker.wait()
        deadline = time.monotonic() + 25
        while any(is_running(pid) for pid in processes) and time.monotonic() < deadline:
            time.sleep(0.02)
        self.bell.close()
        self.database.dispose()

    def submit(self, plan: dict[str, Any], *, skip: tuple[str, ...] = (), ring: bool = True) -> str:
        """Store a plan as a capture, create a job on it, ring."""
        content = json.dumps({"witness": str(self.witness), **plan}).encode()
        source = self.folder / "capture.json"
        source.write_bytes(content)
        capture_id = new_id()
        sha256 = hashlib.sha256(content).hexdigest()
        key = blob_content(DEFAULT_TENANT, sha256, capture_id)
        self.store.put_file(key, source)
        with self.database.session_scope() as session:
            create_capture(
                session,
                capture_id=capture_id,
                filename="plan.json",
                kind="video",
                num_bytes=len(content),
                sha256=sha256,
                brought=key,
                details={},
            )
            job = create_job(
                session,
                capture_id=capture_id,
                preset="preview",
                preset_reason="test",
                options={stage.name: {} for stage in STAGES},
                stages=[
                    StageSeed(stage.name, stage.after, stage.needs_gpu, stage.name in skip)
                    for stage in STAGES
                ],
            )
            ready = ready_stage_ids(job)
        if ring:
            self.bell.ring(ready)
        return job.id

    def cut_pause(self, job_id: str, name: str) -> None:
        """Have a stage that is to be tried again after a pause tried at once."""
        self.wait(lambda: self.stage(job_id, name).not_before)
        with self.database.session_scope() as session:
            until = StageRow.not_before
            waits = (StageRow.job_id == job_id, StageRow.name == name, until.is_not(None))
            session.execute(update(StageRow).where(*waits).values(not_before=now(session)))
        self.bell.ring([stage_id(job_id, name)])

    def cancel(self, job_id: str) -> None:
        """Ask a job to stop."""
        with self.database.session_scope() as session:
            request_cancel(session, job_id)

    def job(self, job_id: str) -> Job:
        """The job with its stages."""
        with self.database.read_scope() as session:
            return get_job(session, job_id, manifests=True)

    def stage(self, job_id: str, name: str) -> StageRow:
        """One stage of a job."""
        return next(row for row in self.job(job_id).stages if row.name == name)

    def runs(self, job_id: str, name: str) -> list[StageRun]:
        """The claims of one stage, in order."""
        with self.database.read_scope() as session:
            return [run for run in list_runs(session, job_id) if run.stage == name]

    def outcomes(self, job_id: str, name: str) -> list[str | None]:
        """How the claims of one stage ended, in order."""
        return [run.outcome for run in self.runs(job_id, name)]

    def log(self, job_id: str, stage: str | None = None) -> list[str]:
        """The job's log lines."""
        with self.database.read_scope() as session:
            return read_logs(session, job_id, stage=stage, limit=100_000).lines

    def notes(self, pattern: str) -> list[str]:
        """What stages wrote down that starts with a pattern."""
        lines = self.witness.read_text().splitlines()
        return [line for line in lines if line.startswith(pattern)]

    def wait(self, what: Callable[[], object], timeout_s: float = 40.0) -> None:
        """Wait until something is so."""
        deadline = time.monotonic() + timeout_s
        while not what():
            if time.monotonic() > deadline:
                log = (self.folder / "worker.log").read_text()[-6000:]
                raise AssertionError(
                    f"not so after {timeout_s} s\n{self.witness.read_text()}\n{log}"
                )
            time.sleep(0.1)

    def wait_for(self, job_id: str, *states: str, timeout_s: float = 40.0) -> Job:
        """Wait until a job is in one of some states."""
        self.wait(lambda: self.job(job_id).state in states, timeout_s)
        return self.job(job_id)


def with_descendants(*pids: int) -> list[int]:
    """These processes and all that they started, the eldest first."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(fields[1])
    found = list(pids)
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def is_running(pid: int) -> bool:
    """Whether a process exists and is not a zombie."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
