"""Native code that holds the interpreter, run as a script in a process of its own.

Whoever waits for such code could neither tell that it goes on nor be cancelled. A script gets the
paths of two .npz files: of the arrays that it reads, and of those that it writes.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.tools.process import Program

_TELL_S = 1.0


def run_apart(
    script: str,
    given: Mapping[str, Any],
    usual_s: float,
    on_progress: Callable[[float], None],
) -> dict[str, NDArray[Any]]:
    """What the script makes of some arrays.

    usual_s: about how long it takes, for what is told every second while nobody knows how far it
    is. on_progress: what it raises ends the script. Raises ToolError where it fails.
    """
    begun = told = time.monotonic()

    def wait() -> bool:
        nonlocal told
        if (now := time.monotonic()) - told >= _TELL_S:
            told = now
            on_progress((now - begun) / (now - begun + usual_s))
        return False

    with tempfile.TemporaryDirectory(prefix="apart-") as name:
        read, written = Path(name, "given.npz"), Path(name, "made.npz")
        np.savez(read, **given)
        # -P: the modules beside the script are no modules of the programs that it uses.
        command = [sys.executable, "-P", script, str(read), str(written)]
        with Program(command, is_cancelled=wait) as program:
            program.wait()
        with np.load(written) as made:
            return {key: made[key] for key in made.files}
