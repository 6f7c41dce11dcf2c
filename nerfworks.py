"""`from nerfworks import Client`: the typed client; and the entry of the `nerfworks` command."""

from __future__ import annotations

import sys

from api.client.client import (
    ApiProblem,
    Artifact,
    Capture,
    ChecksumMismatch,
    Client,
    ConnectionFailed,
    FilesInTheWay,
    Job,
    JobFailed,
    JobPlan,
    NerfworksError,
    Stage,
    WaitTimedOut,
)

__all__ = [
    "ApiProblem",
    "Artifact",
    "Capture",
    "ChecksumMismatch",
    "Client",
    "ConnectionFailed",
    "FilesInTheWay",
    "Job",
    "JobFailed",
    "JobPlan",
    "NerfworksError",
    "Stage",
    "WaitTimedOut",
    "main",
]


def _up(arguments: list[str]) -> int:
    from deploy import local

    return local.main(arguments)


def main() -> int:
    """The `nerfworks` command."""
    from api.client.cli import main as run

    return run(up=_up)


if __name__ == "__main__":
    sys.exit(main())
