"""Every object key, and every prefix.

    tenants/TENANT/blobs/SHA256-NONCE/content                   uploaded bytes
    tenants/TENANT/jobs/JOB/STAGE/ATTEMPT-TOKEN/...             what one attempt published
    tenants/TENANT/jobs/JOB/STAGE/checkpoint/TOKEN-NUMBER/...   a running stage's latest checkpoint

The token is the fencing token of the claim, so that two attempts never write to one place. The
nonce lets no place be used twice: bytes that come again while the old ones are still being deleted
lie elsewhere.

Before there were tenants, keys were `captures/CAPTURE/content` and `jobs/JOB/...`. What was
recorded so stays where it lies: records hold whole keys and prefixes, and a job holds its root,
`.../jobs/JOB/`, below which everything of it is written.
"""

from __future__ import annotations

from dataclasses import dataclass

ROOTS = ("captures/", "jobs/", "tenants/")
"""Below these lies all that is ours."""


@dataclass(frozen=True)
class Place:
    """Where an object lies. folder: the prefix that a record would name for it.

    root, stage, token: of an object that a stage wrote: its job's root, and the claim's token.
    """

    folder: str
    root: str | None = None
    stage: str | None = None
    token: int | None = None


def blob_content(tenant_id: str, sha256: str, nonce: str) -> str:
    """Uploaded bytes. nonce: chance."""
    return f"tenants/{tenant_id}/blobs/{sha256}-{nonce}/content"


def job_root(tenant_id: str, job_id: str) -> str:
    """All bytes of a job."""
    return f"tenants/{tenant_id}/jobs/{job_id}/"


def stage_prefix(root: str, stage: str) -> str:
    """All bytes of one stage of a job, of every attempt. root: of the job. Raises ValueError."""
    if not root.endswith("/"):
        raise ValueError(f"the root of a job ends in a slash: {root!r}")
    return f"{root}{stage}/"


def attempt_prefix(root: str, stage: str, attempt: int, token: int) -> str:
    """What one attempt publishes."""
    return f"{stage_prefix(root, stage)}{attempt}-{token}/"


def checkpoint_prefix(root: str, stage: str, token: int, number: int) -> str:
    """One checkpoint: the claim's token and its number within the claim."""
    return f"{stage_prefix(root, stage)}checkpoint/{token}-{number}/"


def place_of(key: str) -> Place | None:
    """Where this object lies; None for a key of no such form."""
    parts = key.split("/")
    start = 2 if parts[0] == "tenants" else 0
    kind, inner = (parts[start : start + 1] or [""])[0], parts[start + 1 :]
    if kind == ("blobs" if start else "captures") and len(inner) > 1:
        return Place("/".join(parts[: start + 2]) + "/")
    if kind != "jobs" or len(inner) < 3:
        return None
    is_checkpoint = inner[2] == "checkpoint"
    length = 4 if is_checkpoint else 3
    if len(inner) <= length:
        return None
    first, _, second = inner[length - 1].partition("-")
    token = first if is_checkpoint else second
    if not token.isdecimal():
        return None
    root, folder = parts[: start + 2], parts[: start + 1 + length]
    return Place("/".join(folder) + "/", "/".join(root) + "/", inner[1], int(token))


def token_of(key: str) -> int | None:
    """The token of the claim that wrote this object of a stage; None for other keys."""
    place = place_of(key)
    return None if place is None else place.token


def folder_of(key: str) -> str | None:
    """The prefix that a record would name for this object; None for a key of no such form."""
    place = place_of(key)
    return None if place is None else place.folder
