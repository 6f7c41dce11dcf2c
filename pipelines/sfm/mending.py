"""Mapping a capture anew where its path is torn (`pipelines.sfm.tears` finds where, and why).

Of what a torn model holds, one that is mended must hold most to be taken for it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipelines.sfm.agreement import MOST_MATCHES
from pipelines.sfm.tears import FilmOrder, PairSet, impossible, tears
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import SparseModel, best_model

_ENOUGH = 0.9
"""Share of a torn model's images that a mended one holds at least."""


@dataclass(frozen=True)
class Mapping:
    """What mapping comes to, and with whose matches.

    torn: where the path of the best model is torn all the same. left_out: pairs of images that
    matched and were not used, as they lay one side over another.
    """

    models: list[SparseModel]
    reconstructor: Reconstructor
    torn: tuple[tuple[int, int], ...] = ()
    left_out: PairSet = frozenset()


def mended(
    reconstructor: Reconstructor,
    mapped: Callable[[Reconstructor], list[SparseModel]],
    clips: Sequence[Sequence[int]],
    *,
    is_film: bool,
    logger: logging.Logger,
) -> Mapping:
    """Map; where the path is torn, anew without the pairs that lay one side over another.

    mapped: the models by a reconstructor's matches. clips: images in order of time. Photos count
    as a film in the order that they come in: where they are in no order, hardly any neighbours
    match, and nothing is said of a path (is_film: whether a torn one is told). Where mending
    fails, the models stay as they are.
    """
    models = mapped(reconstructor)
    most = best_model(models)
    if most is None:
        return Mapping(models, reconstructor)
    order = FilmOrder.of(clips)
    seen = reconstructor.verified(None, MOST_MATCHES)
    torn = tears(most, seen, order)
    if not torn:
        return Mapping(models, reconstructor)
    logger.info(
        "the path is torn between images %s: mapping by what is near in time",
        ", ".join(f"{i} and {j}" for i, j in torn),
    )
    enough = _ENOUGH * len(most.indices)
    far = frozenset(pair for pair in seen if order.is_far(pair))
    along = reconstructor.without_pairs(far)
    path_models = mapped(along)
    path = best_model(path_models)
    if path is None or len(path.indices) < enough or tears(path, seen, order):
        return Mapping(models, reconstructor, torn if is_film else ())
    wrong = impossible(path, seen, far)
    looped = reconstructor.without_pairs(wrong)
    looped_models = mapped(looped)
    found = best_model(looped_models)
    logger.info("%d of %d pairs far in time are left out", len(wrong), len(far))
    if found is None or len(found.indices) < enough or tears(found, seen, order):
        return Mapping(path_models, along, left_out=far)
    return Mapping(looped_models, looped, left_out=wrong)
