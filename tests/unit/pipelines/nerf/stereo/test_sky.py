"""The sky is told from what stands before it, and from what only looks like it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.stereo.sky import Sky, find_sky
from tests.unit.pipelines.nerf.stereo.monument import (
    NUM_VIEWS,
    SKY_COLOR,
    UP,
    Seen,
    walk_round,
)

NO_POINTS = np.zeros((0, 3))


def sky_of(seen: list[Seen], points: np.ndarray = NO_POINTS, up: np.ndarray = UP) -> Sky:
    views, depths = [one.view for one in seen], [one.known().z for one in seen]
    return find_sky(views, lambda index: seen[index].picture, depths, up, points)


@pytest.mark.parametrize("color", [SKY_COLOR, (1.0, 1.0, 1.0), (0.45, 0.65, 0.95)])
def test_all_of_the_sky_is_found_and_nothing_else(color: tuple[float, float, float]) -> None:
    seen = walk_round(sky=color)
    found = sky_of(seen)
    assert found.num_views == NUM_VIEWS
    assert found.far == 1.0
    for one, mask in zip(seen, found.masks, strict=True):
        assert one.is_void.mean() > 0.2
        assert mask[one.is_void].mean() > 0.97
        assert mask[~one.is_void].mean() < 0.01


def test_a_white_wall_close_behind_is_no_sky() -> None:
    """The same pictures; what their upper parts border on is not far."""
    found = sky_of(walk_round(houses=7.0))
    assert found.num_views == NUM_VIEWS
    assert found.far == 0.0
    assert found.share == 0.0
    assert not any(mask.any() for mask in found.masks)


@pytest.mark.parametrize("color", [(0.98, 0.92, 0.85), (0.6, 0.6, 0.6), (0.2, 0.25, 0.95)])
def test_what_is_warm_or_dark_or_too_colourful_is_no_sky(
    color: tuple[float, float, float],
) -> None:
    assert sky_of(walk_round(sky=color)).num_views == 0


def test_what_lies_below_the_horizon_is_no_sky() -> None:
    assert sky_of(walk_round(), up=-UP).num_views == 0


def test_where_there_are_points_there_is_no_sky() -> None:
    seen = walk_round()
    rng = np.random.default_rng(0)
    away = rng.normal(size=(20000, 3))
    points = 9.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    assert sky_of(seen, points).num_views == 0
    assert sky_of(seen, points[points[:, 2] < 0]).share > 0.2


def test_what_a_sensor_measures_is_no_sky() -> None:
    """A white hall, high above: a sensor sees its ceiling, but nothing of a sky."""
    seen = walk_round()
    given = [one.view for one in seen], lambda index: seen[index].picture
    depths = [one.known().z for one in seen]
    hall = [np.where(one.is_void, np.float32(9.0), one.depth) for one in seen]
    outdoors: list[np.ndarray | None] = [one.depth for one in seen]
    assert find_sky(*given, depths, UP, NO_POINTS, hall).share == 0.0
    assert find_sky(*given, depths, UP, NO_POINTS, outdoors).share > 0.2
    assert find_sky(*given, depths, UP, NO_POINTS, [None] * len(seen)).share > 0.2


def test_few_pictures_that_may_show_sky_are_not_enough() -> None:
    seen = walk_round()
    dark = [
        dataclasses.replace(one, picture=np.where(one.is_void[..., None], 90, one.picture))
        for one in seen
    ]
    found = sky_of(seen[:2] + dark[2:])
    assert found.num_views == 2
    assert found.share == 0.0


def test_dark_twigs_at_its_border_make_it_no_less_sky() -> None:
    """A patch takes some of what it surrounds; its inside is what tells its colour."""
    rng = np.random.default_rng(0)
    seen = []
    for one in walk_round():
        rim = (
            one.is_void & ~np.roll(one.is_void, -2, axis=0) & (rng.random(one.is_void.shape) < 0.8)
        )
        picture = np.where(rim[..., None], np.uint8(10), one.picture)
        assert np.std(picture[one.is_void] / 255.0) > 0.06
        seen.append(dataclasses.replace(one, picture=picture))
    found = sky_of(seen)
    assert found.num_views == NUM_VIEWS
    for one, mask in zip(seen, found.masks, strict=True):
        assert mask[one.is_void].mean() > 0.95
