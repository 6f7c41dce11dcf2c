"""What is asked of one view or photo after another, asked of some at a time."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from pipelines.nerf.ahead import each_ahead

_View = TypeVar("_View")
_Answer = TypeVar("_Answer")

_MOST_THREADS = 4
"""Each may have threads of its own, as of a ray caster, and holds a view."""


def each_view(
    ask: Callable[[_View], _Answer], views: Iterable[_View]
) -> Generator[_Answer, None, None]:
    """The answers in the order of the views, on as many threads as torch has, or a few.

    Results are those of one thread. `ask` runs on several at a time, and may raise.
    """
    return each_ahead(ask, views, _MOST_THREADS)
