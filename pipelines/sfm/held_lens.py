"""Mapping by a lens that is held, where one that is fitted runs away.

What is flat and far says next to nothing of focal length and distortion: both grow, or shrink,
until COLMAP takes the images out again. Models by a lens without distortion hold them all; where
even its focal length runs away, by one of the focal length that mapping starts from.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.agreement import Matches, agreement_of_model
from pipelines.sfm.intrinsics import MOST_BENT
from pipelines.sfm.mending import Mapping
from pipelines.tools.colmap_results import SparseModel
from pipelines.tools.colmap_settings import MapperSettings

_SHORTEST, _LONGEST = 0.1, 10.0
"""Focal lengths, in long sides, beyond which COLMAP takes images out of a model."""


def held_where_it_ran_away(
    mapping: Mapping,
    settings: MapperSettings,
    mapped_by: Callable[[MapperSettings], Mapping],
    seen: Callable[[], Matches],
    logger: logging.Logger,
) -> tuple[Mapping, MapperSettings]:
    """The mapping, and by which settings: without distortion, or by a known focal length, where the
    lens ran away by others.

    seen: verified matches, by which one mapping is better than another.
    """
    unbent = replace(settings, refine_distortion=False)
    for tried in (unbent, replace(unbent, refine_focal=False)):
        if not lens_ran_away(mapping.models):
            break
        logger.info(
            "the lens ran away, or nothing is placed: mapping without distortion%s",
            "" if tried.refine_focal else ", by the focal length that it starts from",
        )
        held = mapped_by(tried)
        matches = seen()
        if _weight(held, matches) > _weight(mapping, matches):
            mapping, settings = held, tried
    return mapping, settings


def lens_ran_away(models: Sequence[SparseModel]) -> bool:
    """Whether most of what models hold is seen through what is no lens, or there is none.

    A piece of few images is bent often, and says nothing where others are not.
    """
    num_bent = num_plain = 0
    for model in models:
        if any(map(_is_no_lens, model.cameras)):
            num_bent += len(model.indices)
        else:
            num_plain += len(model.indices)
    return num_bent >= num_plain


def _is_no_lens(lens: Intrinsics) -> bool:
    """Whether it bends beyond what any does, or is shorter or longer than any."""
    focal = lens.fl_x / max(lens.width, lens.height)
    return abs(lens.k1) > MOST_BENT or not _SHORTEST < focal < _LONGEST


def _weight(mapping: Mapping, seen: Matches) -> float:
    """Images of its best model, as far as matches do not contradict it."""
    judged = [replace(m, agreement=agreement_of_model(m, seen)) for m in mapping.models]
    return max((model.weight for model in judged), default=0.0)
