"""Every object key, and every prefix.

    captures/CAPTURE/content                     the uploaded bytes
    jobs/JOB/STAGE/ATTEMPT-TOKEN/...             what one attempt of a stage published
    jobs/JOB/STAGE/checkpoint/TOKEN-NUMBER/...   the latest checkpoint of a running stage

The token is the fencing token of the claim, so that two attempts never write to one place.
"""

from __future__ import annotations


def capture_prefix(capture_id: str) -> str:
    """All bytes of a capture."""
    return f"captures/{capture_id}/"


def capture_content(capture_id: str) -> str:
    """The uploaded bytes."""
    return f"{capture_prefix(capture_id)}content"


def job_prefix(job_id: str) -> str:
    """All bytes of a job."""
    return f"jobs/{job_id}/"


def stage_prefix(job_id: str, stage: str) -> str:
    """All bytes of one stage of a job, of every attempt."""
    return f"{job_prefix(job_id)}{stage}/"


def attempt_prefix(job_id: str, stage: str, attempt: int, token: int) -> str:
    """What one attempt publishes."""
    return f"{stage_prefix(job_id, stage)}{attempt}-{token}/"


def checkpoint_prefix(job_id: str, stage: str, token: int, number: int) -> str:
    """One checkpoint: the claim's token and its number within the claim."""
    return f"{stage_prefix(job_id, stage)}checkpoint/{token}-{number}/"


def token_of(key: str) -> int | None:
    """The token of the claim that wrote this object of a stage; None for other keys."""
    parts = key.split("/")
    if len(parts) < 5 or parts[0] != "jobs":
        return None
    first, _, second = (parts[4] if parts[3] == "checkpoint" else parts[3]).partition("-")
    token = first if parts[3] == "checkpoint" else second
    return int(token) if token.isdecimal() else None


def folder_of(key: str) -> str | None:
    """The prefix that a record would name for this object; None for a key of no such form."""
    parts = key.split("/")
    if parts[0] == "captures" and len(parts) > 2:
        return "/".join(parts[:2]) + "/"
    if parts[0] != "jobs" or token_of(key) is None:
        return None
    length = 5 if parts[3] == "checkpoint" else 4
    return "/".join(parts[:length]) + "/" if len(parts) > length else None
