"""Walls handed on from views that know them to views that do not."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.maps import DepthMap, MapShelf
from pipelines.nerf.stereo.spreading import PlainPatches, refutes, spread
from tests.unit.pipelines.nerf.stereo.blank_room import WALL, Seen, look, walk

CONFIG = StereoConfig(num_neighbours=3)
BACK = np.array([[0.0, 0.0, 1.0, WALL]])
SEEN = [look(place) for place in walk()]
NEAR = [[j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(SEEN)] for i in range(len(SEEN))]


def laid(one: Seen, share: float = 1.0) -> DepthMap:
    """A view that knows its floor and so much of its wall, from the left."""
    z = one.depth.copy()
    z[:, int(share * z.shape[1]) :] = one.known().z[:, int(share * z.shape[1]) :]
    return DepthMap(z, np.where(z > 0, 2, 0).astype(np.uint8))


def run(knowing: set[int], walls: np.ndarray = BACK, share: float = 1.0) -> list[DepthMap]:
    before = [one.known() for one in SEEN]
    maps = [laid(one, share) if i in knowing else one.known() for i, one in enumerate(SEEN)]
    looks = [
        PlainPatches(one.view, (~one.on_floor).astype(np.int32), np.array([1])) for one in SEEN
    ]
    return list(spread(looks, before, MapShelf.of(maps), walls, NEAR, CONFIG))


@pytest.mark.parametrize("knowing", [{0, 1, 2}, {5, 6, 7}, {0, 3, 7}])
def test_a_wall_goes_all_the_way_along_a_film_both_ways(knowing: set[int]) -> None:
    for one, after in zip(SEEN, run(knowing), strict=True):
        wall = ~one.on_floor
        there = wall & (after.z > 0)
        # The first view shows a wider piece of the wall than the last ones.
        assert there.sum() > 0.6 * wall.sum()
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.01
        assert (after.votes[there] >= 1).all()
        assert np.array_equal(after.z[~wall], one.known().z[~wall])


@pytest.mark.parametrize(
    ("knowing", "share"), [({3, 4}, 1.0), ({1, 2, 3, 4, 5}, 0.04)], ids=["two views", "slivers"]
)
def test_what_few_views_or_slivers_say_is_not_handed_on(knowing: set[int], share: float) -> None:
    for number, (one, after) in enumerate(zip(SEEN, run(knowing, share=share), strict=True)):
        if number not in knowing:
            assert np.array_equal(after.z, one.known().z)


def test_another_wall_than_the_neighbours_see_is_laid_nowhere() -> None:
    nearer = np.vstack([BACK * [[1, 1, 1, 0.8]], BACK])
    for one, after in zip(SEEN, run({0, 1, 2}, walls=nearer), strict=True):
        there = ~one.on_floor & (after.z > 0)
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.01
    found = run({0, 1, 2}, walls=BACK * [[1, 1, 1, 0.8]])
    assert not any(
        after.z[~one.on_floor].any() for one, after in zip(SEEN[3:], found[3:], strict=True)
    )


def test_neighbours_refute_what_none_sees_and_what_more_than_half_see_through() -> None:
    agree, through = np.array([0, 1, 1, 2, 1], np.int32), np.array([0, 0, 1, 1, 0], np.int32)
    assert refutes(agree, through).tolist() == [True, False, True, False, False]
