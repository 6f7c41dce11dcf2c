"""Films of things that look the same from several sides: a torn path, found and mended.

A can with its label on it twice, a box with the same front and back: frames from opposite sides
match, and mapping lays the one side over the other. The model has small errors, agrees with most
matches and holds nearly all frames; the thing has one side, its other was never filmed. (Known as
folding, or as ambiguous structure: Heinly et al., "Correcting for Duplicate Scene Structure in
Sparse 3D Reconstruction", ECCV 2014.)

In a film time tells. Frames that follow each other show the same thing from nearly the same place,
so their matches are right; where a path jumps from one side to the other, just those are
contradicted. `tears` finds such places. To mend them, the film is mapped by the pairs that are near
in time alone, which gives its path without any loop; then far pairs come back, but for those that
this path makes impossible: SIFT finds nothing again that is seen from a wholly other side.

Symbols: N images of a model. Order: of each image its number along the film, as it is mapped.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.sfm.agreement import FEWEST_MATCHES, Matches, share_that_fits
from pipelines.tools.colmap_rays import rays_through
from pipelines.tools.colmap_results import SparseModel

PairSet = frozenset[tuple[int, int]]

_WIDEST, _NARROWEST, _OF_CLIP = 8, 2, 8
"""Frames that count as near in time are at most so many apart, and an eighth of their clip: in a
film that goes round once, an eighth of a turn."""
_TORN = 0.3
"""Share of the matches across a place below which the path is torn there. Measured: 0.01 to 0.11
where it was, 0.63 and more at all places of ten captures where it was not."""
_ENOUGH = 60
"""Matches across a place (a pair counts with 60 at most) for them to say that it is torn."""
_MOST_OF_PAIR = 60
WIDEST_PARALLAX_DEG = 60.0
"""Between the two rays to the same thing, from where SIFT still finds it again."""


@dataclass(frozen=True)
class FilmOrder:
    """What is near in time. clip_of: of each image of the film its clip. place_of: its number
    within that clip. window: of each clip, how far apart two near frames are at most."""

    clip_of: Mapping[int, int]
    place_of: Mapping[int, int]
    window: Mapping[int, int]

    @classmethod
    def of(cls, clips: Sequence[Sequence[int]]) -> FilmOrder:
        """Of the clips of a film, each the indices of its frames in order of time."""
        return cls(
            clip_of={i: number for number, clip in enumerate(clips) for i in clip},
            place_of={i: place for clip in clips for place, i in enumerate(clip)},
            window={
                number: min(_WIDEST, max(_NARROWEST, len(clip) // _OF_CLIP))
                for number, clip in enumerate(clips)
            },
        )

    def is_far(self, pair: tuple[int, int]) -> bool:
        """Whether both images are of one clip, but not near in time."""
        i, j = pair
        clip = self.clip_of.get(i)
        if clip is None or clip != self.clip_of.get(j):
            return False
        return abs(self.place_of[i] - self.place_of[j]) > self.window[clip]

    def is_near(self, pair: tuple[int, int]) -> bool:
        """Whether both images are of one clip, and near in time."""
        i, j = pair
        clip = self.clip_of.get(i)
        return clip is not None and clip == self.clip_of.get(j) and not self.is_far(pair)


def tears(model: SparseModel, matches: Matches, order: FilmOrder) -> tuple[tuple[int, int], ...]:
    """Where a film's path is torn: pairs of images that follow each other in the model, though what
    the frames before the one and after the other show contradicts that they stand where they do.

    matches: verified, of all pairs that are near in time; further ones are left alone.
    """
    near = {pair: places for pair, places in matches.items() if order.is_near(pair)}
    row = {index: number for number, index in enumerate(model.indices)}
    all_across = np.zeros(len(model.indices))
    fitting_across = np.zeros(len(model.indices))
    for (i, j), share in share_that_fits(model, near).items():
        weight = min(len(near[i, j][0]), _MOST_OF_PAIR)
        all_across[row[i] : row[j]] += weight
        fitting_across[row[i] : row[j]] += weight * share
    return tuple(
        (before, after)
        for number, (before, after) in enumerate(itertools.pairwise(model.indices))
        if order.clip_of.get(before) == order.clip_of.get(after)
        and all_across[number] >= _ENOUGH
        and fitting_across[number] < _TORN * all_across[number]
    )


def impossible(model: SparseModel, matches: Matches, pairs: Collection[tuple[int, int]]) -> PairSet:
    """Those of some pairs that cannot have matched if the model is right: the rays to what both are
    said to show are WIDEST_PARALLAX_DEG apart or more, in the median.

    Pairs of which the model does not hold both images, or with few matches, are possible.
    """
    row = {index: number for number, index in enumerate(model.indices)}
    found = set()
    for i, j in pairs:
        places = matches.get((i, j))
        if places is None or i not in row or j not in row or len(places[0]) < FEWEST_MATCHES:
            continue
        rays = [
            rays_through(model.cameras[model.camera_of[row[index]]], place)
            @ model.world_from_camera[row[index], :, :3].T
            for index, place in zip((i, j), places, strict=True)
        ]
        cosine = np.nanmedian((rays[0] * rays[1]).sum(axis=1))
        if cosine <= np.cos(np.radians(WIDEST_PARALLAX_DEG)):
            found.add((i, j))
    return frozenset(found)
