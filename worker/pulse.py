"""For how long an attempt has been silent."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

LOOK_S = 1.0


class Pulse:
    """For how long a stage has shown no sign of life: progress that moved, a line, a checkpoint.

    It grows only while somebody watches: a worker that was frozen, or asleep with its machine, does
    not take its own silence for the stage's.
    """

    def __init__(self) -> None:
        self._silent_s = 0.0
        self._looked_at = time.monotonic()
        self._said: tuple[Any, ...] = ()

    def beat(self) -> None:
        """There was a sign."""
        self._silent_s = 0.0

    def notice(self, message: Mapping[str, Any]) -> bool:
        """A message of the stage process came. Whether it is a sign: progress said before is not.

        Seconds left that run down are none either.
        """
        if message["type"] == "progress":
            said = (message["fraction"], message["message"])
            if said == self._said:
                return False
            self._said = said
        self.beat()
        return True

    def silent_s(self, moment: float | None = None) -> float:
        """Seconds without a sign so far. To be asked often."""
        moment = time.monotonic() if moment is None else moment
        self._silent_s += min(moment - self._looked_at, LOOK_S)
        self._looked_at = moment
        return self._silent_s
