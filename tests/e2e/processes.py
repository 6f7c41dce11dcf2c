"""Looks at the machine's processes, through /proc."""

from __future__ import annotations

import contextlib
from pathlib import Path


def processes_mentioning(text: str) -> list[str]:
    """Command lines of processes whose command line or environment holds `text`, without ours.

    A process of the embedded service carries its home in its environment.
    """
    found = []
    own = {"self", "thread-self"}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or entry.name in own:
            continue
        try:
            command = (entry / "cmdline").read_bytes()
            environment = b""
            with contextlib.suppress(PermissionError):  # the service closes its own to its user
                environment = (entry / "environ").read_bytes()
        except (FileNotFoundError, ProcessLookupError, PermissionError):
            continue
        is_test = b"pytest" in command or b"deploy.local" in command or b"deploy.demo" in command
        if not is_test and text.encode() in command + b"\0" + environment and command:
            found.append(command.replace(b"\0", b" ").decode("utf-8", "replace"))
    return found
