"""A worker told to stop while it looks for depth; kill -9 of the next one in mid-training, of the
stage process, of Redis and of the API.

Nothing is restarted by hand. The job must still succeed, no stage may run to its end twice, and
depth and training must go on from their checkpoints.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text

from api.client.client import Client, Job
from deploy.embedded import Embedded
from deploy.supervisor import Supervisor
from tests.capture_writers import write_nerfstudio
from tests.e2e.waiting import succeeded
from tests.samples import PLAIN

pytestmark = [pytest.mark.services, pytest.mark.slow, pytest.mark.timeout(700)]

TINY: dict[str, Any] = {
    "depth": {"long_side_px": 320, "num_planes": 96},
    "train": {
        "max_steps": 480,
        "rays_per_step": 512,
        "checkpoint_seconds": 1.0,
        "data": {"long_side_px": 96},
        "model": {
            "num_proposal_samples": [32, 24],
            "num_nerf_samples": 16,
            "grid": {"log2_table_size": 14, "max_res": 128},
        },
    },
    "pointcloud": {"num_points": 2000},
    **PLAIN,
}


def stage_process_of(worker: int) -> int | None:
    """The warm child: the worker's child whose command line names it."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            command = (entry / "cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if parent == worker and b"worker.stage_process" in command:
            return int(entry.name)
    return None


def until(question: Callable[[], bool], timeout_s: float, what: str) -> None:
    deadline = time.monotonic() + timeout_s
    while not question():
        assert time.monotonic() < deadline, f"not within {timeout_s:.0f} s: {what}"
        time.sleep(0.2)


def share_of(job: Job, name: str) -> float:
    """Progress of a stage that runs, 0 where it does not."""
    (stage,) = (stage for stage in job.stages if stage.name == name)
    return stage.progress if stage.state == "running" else 0.0


def finished_runs(embedded: Embedded, job_id: str) -> Counter[str]:
    """How often each stage reported success, from the event log."""
    engine = create_engine(embedded.environment()["NERFWORKS_DATABASE_URL"])
    with engine.connect() as connection:
        rows = connection.execute(
            text("select stage from events where job_id = :job and kind = 'stage.succeeded'"),
            {"job": job_id},
        )
        return Counter(row[0] for row in rows)


def test_job_succeeds_though_every_process_is_killed(
    service: tuple[Client, Embedded, Supervisor], tmp_path: Path
) -> None:
    client, embedded, supervisor = service
    archive = tmp_path / "capture.zip"
    write_nerfstudio(archive, num=24)
    capture = client.upload(archive)
    job = client.create_job(capture.id, preset="preview", options=TINY)

    until(lambda: share_of(client.get_job(job.id), "depth") > 0.2, 180, "depth was looked for")
    stopped = supervisor.pids()["worker"]
    os.kill(stopped, signal.SIGTERM)
    until(lambda: supervisor.pids()["worker"] != stopped, 60, "another worker was started")

    until(lambda: share_of(client.get_job(job.id), "train") > 0.25, 180, "training started")
    worker = supervisor.pids()["worker"]
    orphan = stage_process_of(worker)
    assert orphan is not None
    os.kill(worker, signal.SIGKILL)
    until(lambda: not Path(f"/proc/{orphan}").exists(), 10, "the orphaned stage process ended")
    until(lambda: supervisor.pids()["worker"] != worker, 5, "the worker was started again")

    until(lambda: share_of(client.get_job(job.id), "train") > 0.5, 180, "training resumed")
    child = stage_process_of(supervisor.pids()["worker"])
    assert child is not None
    os.kill(child, signal.SIGKILL)

    for name in ("redis", "api"):
        pid = supervisor.pids()[name]
        os.kill(pid, signal.SIGKILL)
        until(lambda: supervisor.pids()[name] != pid, 5, f"{name} was started again")  # noqa: B023

    job = succeeded(client, embedded, job.id, 540)
    runs = finished_runs(embedded, job.id)
    assert set(runs.values()) == {1}, runs
    log = "\n".join(client.logs(job.id, stage="train"))
    steps = [int(step) for step in re.findall(r"going on from step (\d+)", log)]
    assert len(steps) == 2, log[-2000:]
    assert 0 < steps[0] < steps[1], "training did not resume from its checkpoints"
    log = "\n".join(client.logs(job.id, stage="depth"))
    assert log.count("going on from the checkpoint") == 1, log[-2000:]
