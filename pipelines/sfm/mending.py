"""Mapping a capture anew where its model is torn (`pipelines.sfm.tears`) or folded
(`pipelines.sfm.folds`).

Of what such a model holds, one that is mended must hold most to be taken for it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipelines.sfm.agreement import MOST_MATCHES, Matches
from pipelines.sfm.folds import suspected_folds
from pipelines.sfm.tears import FilmOrder, PairSet, impossible, tears
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import SparseModel, best_model

_ENOUGH = 0.9
"""Share of a torn model's images that a mended one holds at least."""
_UNFOLDED = 0.7
"""Share of the pairs that laid one side over another that cannot have matched, if they did."""
_ONE_SIDE, _LEAST_SIDE = 0.4, 0.1
"""Share of a folded model's images that one side holds at least for it to be worth having alone,
and any model for it to be a side."""

Sides = tuple[frozenset[int], ...]
_Mapped = Callable[[Reconstructor], list[SparseModel]]


@dataclass(frozen=True)
class Mapping:
    """What mapping comes to, and with whose matches.

    torn: where the path of the best model is torn all the same. left_out: pairs of images that
    matched and were not used, as they lay one side over another. sides: the images of each
    side, where the models are sides apart, which nothing else joins.
    """

    models: list[SparseModel]
    reconstructor: Reconstructor
    torn: tuple[tuple[int, int], ...] = ()
    left_out: PairSet = frozenset()
    sides: Sides = ()


def mended(
    reconstructor: Reconstructor,
    mapped: _Mapped,
    clips: Sequence[Sequence[int]],
    *,
    is_film: bool,
    logger: logging.Logger,
    sides: Sides = (),
) -> Mapping:
    """Map; where the path is torn or the model is folded, anew without the pairs that lay one side
    over another.

    mapped: the models by a reconstructor's matches. clips: images in order of time. Photos count
    as a film in the order that they come in: where they are in no order, hardly any neighbours
    match, and nothing is said of a path (is_film: whether a torn one is told). Where mending
    fails, the models stay as they are. sides: those that an earlier attempt told apart; what
    images of two of them share is not used.
    """
    if sides:
        return _apart(reconstructor, mapped, sides)
    models = mapped(reconstructor)
    most = best_model(models)
    if most is None:
        return Mapping(models, reconstructor)
    order = FilmOrder.of(clips)
    seen = reconstructor.verified(None, MOST_MATCHES)
    torn = tears(most, seen, order)
    doubtful = _Doubtful(reconstructor, mapped, most, seen, order, logger)
    if torn:
        logger.info(
            "the path is torn between images %s: mapping by what is near in time",
            ", ".join(f"{i} and {j}" for i, j in torn),
        )
        return _by_time(doubtful) or Mapping(models, reconstructor, torn if is_film else ())
    return _unfolded(doubtful) or Mapping(models, reconstructor)


@dataclass(frozen=True)
class _Doubtful:
    """A mapping that may be wrong: by whose matches, how, and what came of it. seen: some matches
    of all verified pairs."""

    reconstructor: Reconstructor
    mapped: _Mapped
    most: SparseModel
    seen: Matches
    order: FilmOrder
    logger: logging.Logger

    def is_torn(self, model: SparseModel) -> bool:
        """Whether the path of another model is."""
        return bool(tears(model, self.seen, self.order))


def _by_time(doubtful: _Doubtful) -> Mapping | None:
    """Along the film, and with those pairs far in time that its path makes possible; None where
    that holds too little."""
    reconstructor, mapped, seen = doubtful.reconstructor, doubtful.mapped, doubtful.seen
    enough = _ENOUGH * len(doubtful.most.indices)
    far = frozenset(pair for pair in seen if doubtful.order.is_far(pair))
    along = reconstructor.without_pairs(far)
    path_models = mapped(along)
    path = best_model(path_models)
    if path is None or len(path.indices) < enough or doubtful.is_torn(path):
        return None
    wrong = impossible(path, seen, far)
    looped = reconstructor.without_pairs(wrong)
    looped_models = mapped(looped)
    found = best_model(looped_models)
    doubtful.logger.info("%d of %d pairs far in time are left out", len(wrong), len(far))
    if found is None or len(found.indices) < enough or doubtful.is_torn(found):
        return Mapping(path_models, along, left_out=far)
    return Mapping(looped_models, looped, left_out=wrong)


def _unfolded(doubtful: _Doubtful) -> Mapping | None:
    """Without pairs that should have matched better; None where there are none.

    Where other images join the sides there is room for more of them than before, and most of those
    pairs are impossible. Where nothing joins them each side is a model of its own: one that is
    right is worth more than both of them, one laid over the other.
    """
    reconstructor, most, seen = doubtful.reconstructor, doubtful.most, doubtful.seen
    logger = doubtful.logger
    counts = {(i, j): num for i, j, num in reconstructor.statistics().verified.tolist()}
    one_side: Mapping | None = None
    for across in suspected_folds(most, seen, counts):
        logger.info("one side may lie over another: mapping without %d pairs", len(across))
        apart = reconstructor.without_pairs(across)
        models = doubtful.mapped(apart)
        found = best_model(models)
        if found is None or doubtful.is_torn(found):
            continue
        placed, before = len(found.indices), len(most.indices)
        if placed > before and len(impossible(found, seen, across)) >= _UNFOLDED * len(across):
            logger.info("%d images are placed in place of %d", placed, before)
            return Mapping(models, apart, left_out=across)
        is_alone = _ONE_SIDE * before <= placed < before and not any(
            i in found.indices and j in found.indices for i, j in across
        )
        if one_side is None and is_alone:
            large = [one for one in models if len(one.indices) >= _LEAST_SIDE * before]
            sides = tuple(frozenset(model.indices) for model in large)
            one_side = Mapping(models, apart, left_out=across, sides=sides)
    if one_side is not None:
        logger.info("nothing else joins the sides: the larger one is taken")
    return one_side


def _apart(reconstructor: Reconstructor, mapped: _Mapped, sides: Sides) -> Mapping:
    """Without what images of two sides share; that may be whole now, by other images between."""
    side_of = {image: number for number, side in enumerate(sides) for image in side}
    across = frozenset(
        (i, j)
        for i, j, _ in reconstructor.statistics().verified.tolist()
        if i in side_of and j in side_of and side_of[i] != side_of[j]
    )
    apart = reconstructor.without_pairs(across)
    models = mapped(apart)
    found = best_model(models)
    held = [] if found is None else [len(side.intersection(found.indices)) for side in sides]
    is_joined = sum(2 * num >= len(side) for num, side in zip(held, sides, strict=False)) >= 2
    return Mapping(models, apart, left_out=across, sides=() if is_joined else sides)
