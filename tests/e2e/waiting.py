"""Waits for a job, and says all that is known of one that did not succeed."""

from __future__ import annotations

from api.client.client import Client, Job, WaitTimedOut
from deploy.embedded import Embedded
from deploy.supervisor import tail

_LINES = 40


def succeeded(client: Client, embedded: Embedded, job_id: str, timeout_s: float) -> Job:
    """The job at its end. A failure names its stages, their times and the ends of all logs."""
    try:
        job = client.wait(job_id, timeout=timeout_s)
    except WaitTimedOut:
        job = client.get_job(job_id)
    if job.state != "succeeded":
        raise AssertionError(_story(embedded, job))
    return job


def _story(embedded: Embedded, job: Job) -> str:
    lines = [f"job {job.id} is {job.state}: {job.error}"]
    for stage in job.stages:
        at = f"{stage.progress:.0%}, attempt {stage.attempt}"
        lines.append(
            f"  {stage.name}: {stage.state} at {at}, {stage.started_at} to {stage.finished_at}"
        )
    for log in sorted((embedded.home / "logs").glob("*.log")):
        lines += [f"--- {log.name}", tail(log, _LINES)]
    return "\n".join(lines)
