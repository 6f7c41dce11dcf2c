"""`from nerfworks import Client`: the typed client; and the entry of the `nerfworks` command."""

from __future__ import annotations

import sys

from api.client import (
    ApiProblem,
    Artifact,
    Capture,
    ChecksumMismatch,
    Client,
    ConnectionFailed,
    Job,
    JobFailed,
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
    "Job",
    "JobFailed",
    "NerfworksError",
    "Stage",
    "WaitTimedOut",
    "main",
]


def main() -> int:
    """The `nerfworks` command."""
    from api.cli import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
