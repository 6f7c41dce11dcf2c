"""Which crop an export has, and what its report says of it.

What is found by itself (`shape=auto`) is brought into the numbers of a box that is given by hand,
in the frame that is asked for, and goes on as one: who takes these numbers from the report and asks
with them gets the same export, and may change them first.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.crop import Crop, crop_of
from pipelines.exports.options import CropShapeOptions
from pipelines.exports.placement import Placement
from pipelines.exports.subject import Decision

Floats = NDArray[np.float64]

_DIGITS = 6
"""Of the longest side, that lengths are told with."""
_ANGLE_DIGITS = 4
_LOCKED = 1e-9
_OF_SHAPE = {"box": ("center", "size", "rotation_deg"), "sphere": ("center", "radius")}


def chosen_crop(
    asked: CropShapeOptions,
    place: Placement,
    search: Callable[[], Decision],
    logger: logging.Logger,
) -> tuple[Crop | None, dict[str, Any] | None]:
    """The crop in the world, None for all of the scene, and what is told of it.

    place: the frame that the export is asked for in. search: called where the crop is to be found.
    What is told: asked, the shape that the request names; used, what a request with a crop of that
    kind says, or null where nothing was found; why and measures, the rule's. Null where no crop is
    asked for.
    """
    if asked.shape == "none":
        return None, None
    used: CropShapeOptions | None = asked
    told: dict[str, Any] = {"asked": asked.shape, "used": None, "why": None, "measures": None}
    if asked.shape == "auto":
        decision = search()
        used = box_of(decision, place)
        told |= {"why": decision.why, "measures": decision.measures}
        if used is None:
            logger.warning("No subject was found, so nothing is cropped: %s", decision.why)
    if used is None:
        return None, told
    values = used.model_dump(mode="json")
    told["used"] = {"shape": used.shape, **{key: values[key] for key in _OF_SHAPE[used.shape]}}
    return place.crop(crop_of(used)), told


def box_of(decision: Decision, place: Placement) -> CropShapeOptions | None:
    """The region of a thing that was walked round as a crop of a frame; None where there is none.

    Its numbers are rounded to a millionth of its longest side.
    """
    if decision.kind != "subject" or decision.thing is None:
        return None
    region = decision.thing.region
    size = 2.0 * region.half * place.scale
    digits = _DIGITS - math.floor(math.log10(float(size.max())))
    center = place.points(region.center[None])[0]
    # Rows are directions: the axes of the box are the columns of its matrix.
    turns = angles_of(place.directions(region.axes.T).T)
    return CropShapeOptions(
        shape="box",
        center=_rounded(center, digits),
        size=_rounded(size, digits),
        rotation_deg=_rounded(turns, _ANGLE_DIGITS),
    )


def angles_of(axes: Floats) -> Floats:
    """[3] degrees in [-180, 180] about x, then y, then z, that turn a box to axes: a rotation.

    axes = R_z R_y R_x. Where y is a quarter turn, x and z turn about one line: x is 0 there.
    """
    level = math.hypot(axes[0, 0], axes[1, 0])
    pitch = math.atan2(-axes[2, 0], level)
    if level < _LOCKED:
        turns = (0.0, pitch, math.atan2(-axes[0, 1], axes[1, 1]))
    else:
        roll = math.atan2(axes[2, 1], axes[2, 2])
        turns = (roll, pitch, math.atan2(axes[1, 0], axes[0, 0]))
    angles: Floats = np.degrees(np.asarray(turns))
    return angles


def _rounded(values: Floats, digits: int) -> tuple[float, float, float]:
    # Adding 0.0 leaves no -0.0, which reads like a mistake.
    first, second, third = (round(float(value), digits) + 0.0 for value in values)
    return first, second, third
