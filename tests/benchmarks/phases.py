"""Where the time of a loop goes: wall and CPU seconds by phase, by watching functions it calls.

The training loop itself is measured as it is; nothing of it is repeated here. A phase within
another is taken out of it, so phases add up.
"""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from torch.optim.optimizer import (
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

Target = tuple[Any, str, str]
"""(class or module, name of its function, phase)."""


class PhaseClock:
    """Seconds by phase.

    wait: called at each border of a phase; for a GPU, which else would still be at the last one.
    now: (wall, CPU) seconds; CPU counts all threads.
    """

    def __init__(
        self,
        wait: Callable[[], None] = lambda: None,
        now: Callable[[], tuple[float, float]] = lambda: (time.perf_counter(), time.process_time()),
    ) -> None:
        self._wait = wait
        self._now = now
        self._open: list[str] = []
        self._since = (0.0, 0.0)
        self.wall_s: dict[str, float] = defaultdict(float)
        self.cpu_s: dict[str, float] = defaultdict(float)

    def begin(self, phase: str) -> None:
        """Time goes to `phase` until its `end`."""
        self._settle()
        self._open.append(phase)

    def end(self) -> None:
        """The phase that began last is over; what it lay in goes on."""
        self._settle()
        self._open.pop()

    def reset(self) -> None:
        """Forget what was measured; phases that are open stay so."""
        self._settle()
        self.wall_s.clear()
        self.cpu_s.clear()

    def _settle(self) -> None:
        self._wait()
        wall, cpu = self._now()
        if self._open:
            self.wall_s[self._open[-1]] += wall - self._since[0]
            self.cpu_s[self._open[-1]] += cpu - self._since[1]
        self._since = (wall, cpu)


@contextmanager
def watching(clock: PhaseClock, targets: Sequence[Target], optimizer: str) -> Iterator[None]:
    """Within the block every call of the targets, and every step of an optimiser, is timed.

    Afterwards the functions are those from before. optimizer: the phase of optimisers' steps.
    Raises AttributeError for a function that does not exist.
    """
    with ExitStack() as undo:
        for owner, name, phase in targets:
            original = owner.__dict__[name] if name in vars(owner) else getattr(owner, name)
            setattr(owner, name, _timed(getattr(owner, name), clock, phase))
            undo.callback(setattr, owner, name, original)
        before = register_optimizer_step_pre_hook(lambda *_: clock.begin(optimizer))
        undo.callback(before.remove)
        after = register_optimizer_step_post_hook(lambda *_: clock.end())
        undo.callback(after.remove)
        yield


def _timed(function: Callable[..., Any], clock: PhaseClock, phase: str) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*arguments: Any, **named: Any) -> Any:
        clock.begin(phase)
        try:
            return function(*arguments, **named)
        finally:
            clock.end()

    return timed
