"""White fronts hung below the near edge of a table's top, and open tables left open."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.maps import DepthMap, MapShelf
from pipelines.nerf.stereo.standing import stood_up
from tests.unit.pipelines.nerf.stereo.white_chest import Seen, walk

CONFIG = StereoConfig(num_neighbours=4)
UP = np.array([0.0, -1.0, 0.0])


def finished(seen: list[Seen]) -> list[DepthMap]:
    maps = MapShelf.of([one.known() for one in seen])
    return list(stood_up([one.view for one in seen], maps, CONFIG, up=UP))


def white_known(seen: list[Seen]) -> tuple[float, float]:
    """Of what is white, shares whose depth is known, and known within 2 %."""
    known, right = [], []
    for one, found in zip(seen, finished(seen), strict=True):
        z, truth = found.z[one.white], one.depth[one.white]
        known.append(z > 0)
        right.append(np.abs(z / truth - 1.0) < 0.02)
    return float(np.concatenate(known).mean()), float(np.concatenate(right).mean())


@pytest.mark.parametrize(("lines", "least"), [(False, 0.9), (True, 0.75)])
def test_a_white_front_hangs_below_the_edge_of_its_top(lines: bool, least: float) -> None:
    """Its sides and its foot are lines, too. Between gaps that are close together nothing is."""
    seen = walk(lines=lines)
    assert np.mean([one.white.mean() for one in seen]) > 0.15
    known, right = white_known(seen)
    assert right > least
    assert known - right < 0.02


def test_a_front_needs_neither_ends_nor_a_foot_where_there_are_gaps_on_it() -> None:
    """Nothing is known below its top then, which is no floor all the same."""
    known, right = white_known(walk(whole=False))
    assert right > 0.75
    assert known - right < 0.02
    assert white_known(walk(whole=False, lines=False))[0] < 0.02


def test_what_else_is_known_stays_as_it_was() -> None:
    seen = walk()
    for one, found in zip(seen, finished(seen), strict=True):
        known = one.known().z
        np.testing.assert_array_equal(found.z[known > 0], known[known > 0])


@pytest.mark.parametrize("lines", [False, True])
def test_below_a_table_without_a_front_there_is_none(lines: bool) -> None:
    """Lines of the floor, seen past the edge, go elsewhere on the front's plane from every view."""
    assert white_known(walk(front=False, lines=lines))[0] < 0.02


def test_between_the_legs_of_a_table_is_what_is_beside_them() -> None:
    """They stand where the sides of a front would be, and hide the same of it from every view."""
    assert white_known(walk(front=False, lines=False, legs=True))[0] < 0.02
