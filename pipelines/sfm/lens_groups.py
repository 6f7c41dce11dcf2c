"""Photos of which nothing says through which lens they were taken, told apart by what they show.

Photos that a messenger sent have no EXIF. Where a phone's lenses are mixed among them, or some were
zoomed or cropped, one camera for all bends the world: what was zoomed stands nearer than it did.
All may be placed, with small errors. But let each image have a focal length of its own in the model
that came of it, and those of one lens agree within a few percent, while those of another go half of
their way or more; and observations that were set aside are missed by less. So:

1. A model is adjusted with a focal length by image. Where some differ from most (`grouped`) there
   may be several lenses, unless held-out observations of just these images speak against it.
2. Images whose focal lengths are alike are of one lens; images between lenses, and those without a
   pose, get a camera each. The capture is mapped again.
3. What came of that is looked at in the same way, once more, and lenses that are one are joined.

Where less than half of the images are placed at all, each gets a camera first, and that is taken
where more are placed and their focal lengths differ.

What is mapped anew is taken where it holds as many images and matches agree with it better.
"""

from __future__ import annotations

import itertools
import logging
import math
import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from pipelines.sfm.agreement import MUCH, Matches, agreement_of_model
from pipelines.sfm.intrinsics import MIN_HELD_OUT, Gain, gain
from pipelines.sfm.mending import Mapping as Mapped
from pipelines.tools.colmap_lenses import LensTrials
from pipelines.tools.colmap_results import SparseModel, best_model

Floats = npt.NDArray[np.float64]
Lenses = tuple[tuple[tuple[int, ...], float], ...]
"""Images of each further lens, and how many times as long as the first one it is."""
Settled = Literal["known", "unsuspected", "several", "doubtful"]
"""What is known of which images share a lens: EXIF says it, or they are of a film; nothing says
that there are several; there are, and they were told apart; there seem to be, and they were not."""

SUSPECTED = Gain(0.05, 1.5)
"""By which focal lengths by image lower the mean squared held-out error of images whose own are
others than most, and in standard errors. Two lenses: .2 to .7 (docs/poses-experiments.md)."""
FEWEST_IMAGES = 6
"""In a model, of unknown lens, for anything to be said."""
ENOUGH = 0.99
"""Agreement of a model of all images that nobody needs to doubt."""
_APART = 0.12
"""Logarithm by which the focal lengths of two lenses differ at least. Those of one by itself: .01
to .06."""
_WIDEST = 0.2
"""Logarithm that focal lengths of one lens span at most."""
_FEWEST_POINTS = 50
"""Matches with its best partner from which an image without a pose gets a camera of its own."""
_BETTER, _NO_WORSE = 0.003, 0.01
"""By which agreement rises, for lenses told apart to be believed; and by how much it may fall where
more images are placed."""
_PIECES = 0.5
"""Share of the images below which a model is a piece, which may be all that one camera can hold."""
_ROUNDS = 2


@dataclass(frozen=True)
class OwnLenses:
    """What comes of it where each image of unknown lens has a focal length of its own.

    focal_px: in pixels, by image. aside: images whose focal lengths are not those of most. Errors
    [H] of held-out observations, none where nothing is aside: shared_px with a shared focal length,
    own_px with these; image_of: the image of each.
    """

    focal_px: dict[int, float]
    aside: tuple[int, ...]
    shared_px: Floats
    own_px: Floats
    image_of: npt.NDArray[np.int64]

    @property
    def gain(self) -> Gain | None:
        """What those images have over a shared focal length; None of too few observations."""
        here = np.isin(self.image_of, self.aside)
        if here.sum() < MIN_HELD_OUT:
            return None
        return gain(self.shared_px[here], self.own_px[here], self.image_of[here])

    @property
    def may_differ(self) -> bool:
        """Whether there may be several lenses: some differ from most, and nothing speaks against
        it."""
        return bool(self.aside) and (self.gain is None or self.gain.share > SUSPECTED.share)

    @property
    def differ(self) -> bool:
        """Whether observations that were set aside say so, too."""
        found = self.gain
        return (
            found is not None and found.share > SUSPECTED.share and found.sigmas > SUSPECTED.sigmas
        )


def grouped(
    focal_px: Mapping[int, float],
    alike: Sequence[Collection[int]],
    others: Collection[int] = (),
) -> Lenses:
    """Images of unknown lens by their focal lengths.

    alike: those of one size, which had one camera. others: images whose focal length is not known.
    Of each size the largest group keeps that camera. Where focal lengths are spread evenly, as of
    photos that were each cropped otherwise, and of what is alone, each image is a group.
    """
    found: list[tuple[tuple[int, ...], float]] = []
    for images in alike:
        order = sorted(set(images) & set(focal_px), key=lambda image: (focal_px[image], image))
        if not order:
            continue
        groups = [[order[0]]]
        for before, image in itertools.pairwise(order):
            if math.log(focal_px[image] / focal_px[before]) > _APART:
                groups.append([])
            groups[-1].append(image)
        parts: list[list[int]] = []
        for group in groups:
            is_one = math.log(focal_px[group[-1]] / focal_px[group[0]]) <= _WIDEST
            parts += [group] if is_one else [[image] for image in group]
        parts.sort(key=len, reverse=True)
        first = _middle(parts[0], focal_px)
        found += [(tuple(sorted(part)), _middle(part, focal_px) / first) for part in parts[1:]]
        found += [((image,), 1.0) for image in sorted(set(images) & set(others))]
    return tuple(found)


def _middle(images: Sequence[int], focal_px: Mapping[int, float]) -> float:
    return statistics.median(focal_px[image] for image in images)


def own_lenses(trials: LensTrials, alike: Sequence[Collection[int]]) -> OwnLenses:
    """What a model comes to where each of these images has a focal length of its own. alike: as in
    `grouped`."""
    images = {image for one in alike for image in one}
    own = trials.fit_apart(images)
    aside = tuple(image for one, _ in grouped(own.focal_px, alike) for image in one)
    nothing = np.zeros(0)
    if not aside:
        return OwnLenses(own.focal_px, aside, nothing, nothing, np.zeros(0, np.int64))
    shared = trials.fit(trials.cameras)
    return OwnLenses(own.focal_px, aside, shared.errors_px, own.errors_px, trials.indices_held_out)


def told_apart(
    mapping: Mapped,
    anew: Callable[[Lenses], Mapped],
    alike: Sequence[Collection[int]],
    matches: Matches,
    looked_at: Callable[[Mapped, SparseModel], OwnLenses],
    most_matches: Sequence[int],
    logger: logging.Logger,
    known: Lenses = (),
) -> tuple[Mapped, Lenses, Settled]:
    """The mapping with photos' lenses told apart, those lenses, and whether that is settled.

    mapping: by a camera for all of a size, or by what an attempt before told apart (known). anew:
    maps by other lenses. alike: images of unknown lens, those of one size together. looked_at: the
    images of a mapping's best model by themselves (`own_lenses`). most_matches: of each image of
    the capture, with its best partner.
    """
    unknown = {image for one in alike for image in one}
    found, lenses = mapping, known
    best, agreed = _judged(mapping, matches)
    placed = set() if best is None else unknown.intersection(best.indices)
    if not known and len(placed) < _PIECES * len(unknown):
        each = tuple(((i,), 1.0) for i in sorted(unknown) if most_matches[i] >= _FEWEST_POINTS)
        logger.info("most images are not placed: mapping with a camera each")
        tried = anew(each) if len(each) >= FEWEST_IMAGES else mapping
        model, agrees = _judged(tried, matches)
        if model is not None and agrees >= MUCH and len(model.indices) > len(placed):
            found, lenses, best, agreed = tried, each, model, agrees
            placed = unknown.intersection(best.indices)
    is_fine = placed == unknown and agreed >= ENOUGH and not lenses
    if best is None or is_fine or len(placed) < FEWEST_IMAGES:
        return mapping, known, "several" if known else "unsuspected"
    own = looked_at(found, best)
    is_sure = own.differ
    if not known and not (own.aside if lenses else own.may_differ):
        return mapping, (), "unsuspected"
    for _ in range(_ROUNDS):
        others = [i for i in unknown if i not in own.focal_px and most_matches[i] >= _FEWEST_POINTS]
        wanted = grouped(own.focal_px, alike, others)
        if _images(wanted) == _images(lenses):
            break
        logger.info("several lenses: mapping with %d cameras more", len(wanted))
        tried = anew(wanted)
        model, agrees = _judged(tried, matches)
        more = 0 if model is None else len(model.indices) - len(best.indices)
        least = agreed - _NO_WORSE if more > 0 or lenses else agreed + _BETTER
        if model is None or more < 0 or agrees < least:
            logger.info("agreement %.3f, was %.3f: not taken", agrees, agreed)
            break
        looked = looked_at(tried, model)
        if lenses and looked.differ and not is_sure:
            logger.info("lenses that were joined differ: not taken")
            break
        found, best, agreed, lenses = tried, model, agrees, wanted
        own, is_sure = looked, looked.differ
    if is_sure:
        return found, lenses, "doubtful"
    return found, lenses, "several" if lenses else "unsuspected"


def _judged(mapping: Mapped, matches: Matches) -> tuple[SparseModel | None, float]:
    """A mapping's best model, and its agreement with what it did not leave out; 0 where too few
    matches tell."""
    best = best_model(mapping.models)
    if best is None:
        return None, 0.0
    used = {pair: places for pair, places in matches.items() if pair not in mapping.left_out}
    return best, agreement_of_model(best, used) or 0.0


def _images(lenses: Lenses) -> set[tuple[int, ...]]:
    return {images for images, _ in lenses}
