"""What a request for an export means, beside what lies under it: a job's own options, a preset's.

Some options say one thing in two ways, such as how long a film is; others belong to one shape of a
crop, or one path, alone. Here is what a request with one of them takes back of what lies under it,
what it implies, and where it contradicts itself. Options of a request that are as they lie under it
contradict nothing: who sends all of a job's options again, with one changed, means that one. Light:
the API reads it.

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

_NUMBERS = {
    "box": ("center", "size", "rotation_deg"),
    "sphere": ("center", "radius"),
    "auto": (),
}
"""What says where a crop of each shape is, and how large."""
_PATHS = ("orbit", "spiral", "keyframes", "camera_path")
"""Paths with options of their name."""


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


def with_its_shape(base: Options, given: Options) -> Options:
    """The request with the shape of its crop, where its numbers are of one shape alone.

    base, given: of the crop. Raises ContradictionError where they are of no shape, or of another
    than the one that counts; what lies in a crop of shape `none` is of no shape.
    """
    numbers = [name for name in ("center", "size", "rotation_deg", "radius") if name in given]
    if "shape" not in given:
        own = base.get("shape", "none")
        shapes = {
            shape for shape, of in _NUMBERS.items() if shape != "auto" and {*numbers} <= {*of}
        }
        if not numbers or own in shapes:
            return given
        if "size" in given and "box" in shapes:
            return {**given, "shape": "box"}
        if "radius" in given and "sphere" in shapes:
            return {**given, "shape": "sphere"}
        raise ContradictionError(
            "crop.shape",
            f"{' and '.join(numbers)} alone say not what is kept: add shape, which is box with "
            "center, size and rotation_deg, or sphere with center and radius",
        )
    of_shape = _NUMBERS.get(str(given["shape"]), tuple(numbers))
    strange = [name for name in numbers if name not in of_shape and is_new(name, base, given)]
    if strange:
        has = f"has {', '.join(of_shape)}" if of_shape else "is found by itself"
        raise ContradictionError(
            f"crop.{strange[0]}",
            f"a crop of shape {given['shape']} {has}, and no {' or '.join(strange)}: leave that "
            "out, or change shape",
        )
    return given


def with_its_path(base: Options, given: Options) -> Options:
    """The request with its path, where it has the options of one path alone.

    Raises ContradictionError where it has those of several, or of another path than its own.
    """
    named = [name for name in _PATHS if given.get(name)]
    if "path" in given:
        path = given["path"]
        strange = [name for name in named if name != path and is_new(name, base, given)]
        if strange:
            raise ContradictionError(
                strange[0],
                f"{strange[0]} is of the path {strange[0]}, and path is {path}: leave one of them "
                "out",
            )
        return given
    if len(named) > 1:
        raise ContradictionError(
            named[0], f"{' and '.join(named)} are of different paths: add path, or leave one out"
        )
    return {**given, "path": named[0]} if named else given


def is_new(name: str, base: Options, given: Options) -> bool:
    """Whether the request has an option otherwise than it lies under it."""
    wanted, present = given[name], base.get(name)
    if isinstance(wanted, dict) and isinstance(present, dict):
        return any(is_new(inner, present, wanted) for inner in wanted)
    return bool(wanted != present)
