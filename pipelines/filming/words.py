"""Numbers and lists as people write them."""

from __future__ import annotations

from collections.abc import Sequence

_MOST = 3


def clock(seconds: float) -> str:
    """12.4 -> "0:12"."""
    whole = int(seconds)
    return f"{whole // 60}:{whole % 60:02d}"


def share(part: float) -> str:
    """0.254 -> "25 %"."""
    return f"{100 * part:.0f} %"


def joined(places: Sequence[str], more: str) -> str:
    """["a", "b", "c"] -> "a, b and c"; what is too many is counted: "a, b, c and 4 others"."""
    shown = list(places[:_MOST])
    left = len(places) - len(shown)
    if left > 0:
        shown.append(f"{left} {more}")
    if len(shown) < 2:
        return "".join(shown)
    return ", ".join(shown[:-1]) + " and " + shown[-1]


def listed(names: Sequence[str]) -> str:
    """Neighbouring photos: "a", or "a to d"."""
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
