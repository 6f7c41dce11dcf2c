"""The progress of the poses: counts within a step, as a part of the stage's, with time left."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from pipelines.stage import StageContext
from pipelines.tools.colmap import Watch

Span = tuple[float, float]
_LONG_ITEM_S, _SILENT_AFTER_S = 10.0, 60.0
"""After which one item counts as half done while its end is not known, and as no more done."""


@dataclass
class ProgressScale:
    """Turns counts within a step into the stage's progress, never backwards, with time left."""

    ctx: StageContext
    fraction: float = 0.0
    goal: float = 1.0
    anchor: tuple[float, float] = field(default_factory=lambda: (time.monotonic(), 0.0))
    expected_end: float | None = None

    def aim(self, start: float, goal: float) -> None:
        """From now on, time left is counted to `goal`, at the speed since now."""
        self.fraction = max(self.fraction, start)
        self.anchor = (time.monotonic(), self.fraction)
        self.goal = goal
        self.expected_end = None

    def watch(self, span: Span, total: int, message: str) -> Watch:
        """A watch that maps 0..total onto `span`.

        While one item takes long, it goes on by a part of that one, always more and never all;
        after a minute it stands still, so that who looks for stages that hang sees it.
        """
        start, end = span
        last, since = -1, 0.0

        def report(done: int) -> None:
            nonlocal last, since
            done = min(done, total)
            now = time.monotonic()
            is_next = done != last
            if is_next:
                last, since = done, now
            waited = min(now - since, _SILENT_AFTER_S)
            part = waited / (waited + _LONG_ITEM_S)
            fraction = start + (end - start) * min(done + part, total) / max(total, 1)
            if fraction > self.fraction:
                self.fraction = fraction
                if is_next:  # a part of one is a guess, which says nothing of the pace
                    began, first = self.anchor
                    pace = (now - began) / (fraction - first)
                    self.expected_end = now + pace * max(self.goal - fraction, 0.0)
            left = None if self.expected_end is None else max(self.expected_end - now, 0.0)
            self.ctx.progress(self.fraction, f"{message} {done} of {total}", left)

        return report
