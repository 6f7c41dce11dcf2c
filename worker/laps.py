"""How long the parts of an attempt took."""

from __future__ import annotations

import time


class Laps:
    """Seconds of the parts of an attempt, one after the other. They end in the row's manifest.

    fetch_s: bring the inputs. start_s: until the stage process has begun. run_s: the stage there,
    with hashing and publishing its folder. store_s: bring the results to the object store.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._ended = time.monotonic()

    def end(self, name: str) -> None:
        """The part that ran since the last call, or since the start, was this one."""
        moment = time.monotonic()
        self.seconds[name] = round(moment - self._ended, 3)
        self._ended = moment
