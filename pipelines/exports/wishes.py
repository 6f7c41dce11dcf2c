"""What a request for an export means, beside what lies under it: a job's own options, a preset's.

Some options say one thing in two ways, such as how long a film is. Here is what a request that
takes one of these ways takes back of what lies under it, and where it contradicts itself. Options
of a request that are as they lie under it contradict nothing: who sends all of a job's options
again, with one changed, means that one. Light: the API reads it.

base: options that lie under a request, complete or none. given: the request, not checked yet: it
may be anything that JSON can be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pipelines.option_models import ContradictionError

Options = dict[str, Any]


@dataclass(frozen=True)
class Choice:
    """One thing that can be said in several ways.

    ways: of each the options that belong together, null where it is said otherwise. otherwise:
    options that count where none of those is given.
    """

    ways: tuple[tuple[str, ...], ...]
    otherwise: tuple[str, ...]


LENGTH = Choice((("num_frames",), ("seconds",)), ("turn_deg_per_s", "min_seconds", "max_seconds"))
SIZE = Choice((("width_px", "height_px"),), ("long_side_px",))


def chosen(choice: Choice, base: Options, given: Options) -> Options:
    """The base without the ways that the request does not take, if it takes one.

    Raises ContradictionError, naming them, where it takes two.
    """
    ways = [way for way in choice.ways if any(given.get(name) is not None for name in way)]
    named = [name for way in ways for name in way if given.get(name) is not None]
    others = [
        name
        for name in choice.otherwise
        if name in given and (not ways or is_new(name, base, given))
    ]
    if len(ways) + bool(others) > 1:
        raise ContradictionError(
            named[0],
            f"{' and '.join([*named, *others])} say one thing in different ways: leave all but one "
            "of these ways out",
        )
    if not ways and not others:
        return base
    return {**base, **{name: None for way in choice.ways if way not in ways for name in way}}


def without_what_is_overridden(base: Options, given: Options, usual_extent: str) -> Options:
    """The base without its crop where the request has an extent and no crop, and without the
    extent `subject` where it has a crop and no extent.

    usual_extent: in place of the one that is dropped. Raises ContradictionError where the request
    has both.
    """
    own, crop, extent = base.get("crop", {}), given.get("crop"), given.get("extent")
    if crop is None:
        return base if extent is None else {**base, "crop": {**own, "shape": "none"}}
    has_crop = isinstance(crop, dict) and crop and {**own, **crop}.get("shape", "none") != "none"
    if not has_crop:
        return base
    if extent == "subject" and (is_new("crop", base, given) or is_new("extent", base, given)):
        raise ContradictionError(
            "extent",
            "extent=subject and crop say in two ways what is kept: leave one of them out",
        )
    if extent is None and base.get("extent") == "subject":
        return {**base, "extent": usual_extent}
    return base


def is_new(name: str, base: Options, given: Options) -> bool:
    """Whether the request has an option otherwise than it lies under it."""
    wanted, present = given[name], base.get(name)
    if isinstance(wanted, dict) and isinstance(present, dict):
        return any(is_new(inner, present, wanted) for inner in wanted)
    return bool(wanted != present)
