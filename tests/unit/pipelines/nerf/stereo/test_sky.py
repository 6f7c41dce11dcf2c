"""The sky is told from what stands before it, and from what only looks like it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.stereo.sky import Sky, find_sky, like_sky
from tests.unit.pipelines.nerf.stereo.monument import (
    NUM_VIEWS,
    ON_HOUSES,
    SKY_COLOR,
    UP,
    Seen,
    rays_of,
    walk_round,
)

NO_POINTS = np.zeros((0, 3))


def sky_of(
    seen: list[Seen],
    points: np.ndarray = NO_POINTS,
    up: np.ndarray = UP,
    *,
    daylight: bool = False,
) -> Sky:
    views, depths = [one.view for one in seen], [one.known().z for one in seen]
    given = views, lambda index: seen[index].picture, depths, up, points
    return find_sky(*given, daylight=daylight)


@pytest.mark.parametrize("color", [SKY_COLOR, (1.0, 1.0, 1.0), (0.45, 0.65, 0.95)])
def test_all_of_the_sky_is_found_and_nothing_else(color: tuple[float, float, float]) -> None:
    seen = walk_round(sky=color)
    found = sky_of(seen)
    assert found.num_views == NUM_VIEWS
    assert found.far == 1.0
    assert all(one.is_void.mean() > 0.2 for one in seen)
    assert_all_of_the_sky(found, seen)


def test_a_white_wall_close_behind_is_no_sky() -> None:
    """The same pictures; what their upper parts border on is not far."""
    found = sky_of(walk_round(houses=7.0))
    assert found.num_views == NUM_VIEWS
    assert found.far == 0.0
    assert found.share == 0.0
    assert not any(mask.any() for mask in found.masks)


def assert_all_of_the_sky(found: Sky, seen: list[Seen]) -> None:
    for one, mask in zip(seen, found.masks, strict=True):
        assert mask[one.is_void].mean() > 0.97
        assert mask[~one.is_void].mean() < 0.01


def test_a_burnt_out_sky_is_known_wherever_it_borders() -> None:
    """Overcast: the camera exposes for what stands on the ground."""
    seen = walk_round(houses=7.0, sky=(1.0, 0.99, 1.0))
    found = sky_of(seen)
    assert found.far == 0.0
    assert found.blown_out > 0.2
    assert not found.by_day
    assert_all_of_the_sky(found, seen)


def test_a_burnt_out_window_or_lamp_is_no_sky() -> None:
    """Of a room with a white ceiling, a part of which is as bright as light can be."""
    seen = []
    for one in walk_round(houses=7.0):
        rows, columns = np.mgrid[: one.picture.shape[0], : one.picture.shape[1]]
        lamp = (rows < 30) & (np.abs(columns - 20) < 8) & one.is_void
        assert 0.01 < lamp.mean() < 0.05
        seen.append(painted(one, lamp, np.ones(3)))
    found = sky_of(seen)
    assert found.num_views == NUM_VIEWS
    assert found.share == 0.0


def test_points_before_what_is_burnt_out_are_wrong_or_hidden() -> None:
    """A few, as of a tree behind the house: nothing that is white all over shows any."""
    rng = np.random.default_rng(0)
    away = rng.normal(size=(600, 3)) * [1.0, 1.0, 0.5]
    points = 9.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    white, grey = walk_round(sky=(1.0, 1.0, 1.0)), walk_round()
    shown = [(one.is_void[one.view.seen_at(points)[1:]]).sum() / one.is_void.sum() for one in white]
    assert 1.2e-3 < np.mean(shown) < 4e-3
    assert sky_of(white, points).share > 0.2
    assert sky_of(grey, points).share < 0.5 * sky_of(white, points).share


def test_what_a_sensor_measures_is_no_burnt_out_sky() -> None:
    seen = walk_round(houses=7.0, sky=(1.0, 1.0, 1.0))
    given = [one.view for one in seen], lambda index: seen[index].picture
    depths = [one.known().z for one in seen]
    hall = [np.where(one.is_void, np.float32(9.0), one.depth) for one in seen]
    assert find_sky(*given, depths, UP, NO_POINTS, hall, daylight=True).share == 0.0
    assert find_sky(*given, depths, UP, NO_POINTS, [None] * len(seen)).share > 0.2


def test_photos_taken_by_day_know_their_sky_wherever_it_borders() -> None:
    seen = walk_round(houses=7.0)
    assert sky_of(seen).share == 0.0
    found = sky_of(seen, daylight=True)
    assert found.far == 0.0
    assert found.blown_out == 0.0
    assert_all_of_the_sky(found, seen)


@pytest.mark.parametrize("color", [(0.98, 0.92, 0.85), (0.6, 0.6, 0.6)])
def test_by_day_not_all_that_is_plain_is_sky(color: tuple[float, float, float]) -> None:
    assert sky_of(walk_round(houses=7.0, sky=color), daylight=True).share == 0.0


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


ZENITH, HORIZON = np.array([0.30, 0.52, 0.85]), np.array([0.70, 0.86, 1.00])


def painted(one: Seen, where: np.ndarray, color: np.ndarray) -> Seen:
    """The view with another colour there, [3] or [H, W, 3], sRGB in [0, 1]."""
    picture = np.where(where[..., None], np.rint(255.0 * color), one.picture).astype(np.uint8)
    grey = (picture.mean(axis=-1) / 255.0).astype(np.float32)
    view = dataclasses.replace(one.view, picture=grey)
    return dataclasses.replace(one, view=view, picture=picture)


def by_day(above: np.ndarray = ZENITH, houses: float = 7.0) -> list[Seen]:
    """Close houses, that is, nothing far behind anything, below a sky that pales downwards."""
    seen = walk_round(houses=houses)
    height = seen[0].picture.shape[0]
    down = np.linspace(0.0, 2.0, height).clip(0.0, 1.0)[:, None, None]
    slope = (1.0 - down) * above + down * HORIZON
    return [painted(one, one.is_void, np.broadcast_to(slope, one.picture.shape)) for one in seen]


def assert_known_by_day(found: Sky, seen: list[Seen]) -> None:
    assert found.by_day
    assert_all_of_the_sky(found, seen)


def test_a_blue_sky_is_known_without_anything_far_behind() -> None:
    seen = by_day()
    assert np.std(seen[0].picture[seen[0].is_void] / 255.0, axis=0).max() > 0.06
    found = sky_of(seen)
    assert_known_by_day(found, seen)


def test_by_day_some_pictures_show_it_white() -> None:
    """The camera looks towards the sun, or exposes for the shade."""
    white = np.array([0.99, 1.0, 1.0])
    seen = [painted(one, one.is_void, white) if i > 5 else one for i, one in enumerate(by_day())]
    found = sky_of(seen)
    assert_known_by_day(found, seen)


def test_clouds_are_sky_and_birds_and_lamps_are_not() -> None:
    seen, clouds, lamps = [], [], []
    rng = np.random.default_rng(0)
    for one in by_day():
        rows, columns = np.mgrid[: one.picture.shape[0], : one.picture.shape[1]]
        cloud = (np.hypot(rows - 18, 0.5 * (columns - 95)) < 9) & one.is_void
        lamp = (np.hypot(rows - 15, columns - 20) < 6) & one.is_void
        billows = 0.75 + 0.2 * rng.random((*cloud.shape, 1)) * np.ones(3)
        seen.append(painted(painted(one, cloud, billows), lamp, np.array([0.1, 0.1, 0.1])))
        clouds.append(cloud)
        lamps.append(lamp)
    found = sky_of(seen)
    assert found.by_day
    for mask, cloud, lamp in zip(found.masks, clouds, lamps, strict=True):
        assert mask[cloud].mean() > 0.97
        assert mask[lamp].mean() < 0.2


@pytest.mark.parametrize(("stone", "num_points"), [((0.85, 0.75, 0.6), 0), ((0.8, 0.82, 0.85), 40)])
def test_a_tower_that_reaches_into_the_picture_is_no_cloud(
    stone: tuple[float, float, float], num_points: int
) -> None:
    """Sunlit, of sandstone, or of marble with points on it; nothing in the picture carries it."""
    rng = np.random.default_rng(0)
    for one in by_day():
        rows, columns = np.mgrid[: one.picture.shape[0], : one.picture.shape[1]]
        tower = (rows < 22) & (columns > 104) & one.is_void
        light = rng.uniform(0.9, 1.1, (*tower.shape, 1)) * np.array(stone)
        seen = painted(one, tower, light.clip(0.0, 1.0))
        at = rng.permutation(np.argwhere(tower))[:num_points]
        points = seen.view.center + 5.0 * rays_of(seen.view)[at[:, 0], at[:, 1]]
        mask = like_sky(seen.view, seen.picture, UP, points, by_day=True)
        assert mask[tower].mean() < 0.3
        assert mask[one.is_void & ~tower].mean() > 0.95


def test_a_blue_wall_that_reaches_below_the_horizon_is_no_sky() -> None:
    """Houses painted like the sky: one blue wall from the ground up."""
    seen = [painted(one, one.what == ON_HOUSES, HORIZON) for one in by_day(HORIZON)]
    found = sky_of(seen)
    assert not found.by_day
    assert found.share == 0.0


@pytest.mark.parametrize("color", [(0.27, 0.33, 0.57), (0.69, 0.71, 0.81), (0.55, 0.45, 0.75)])
def test_screens_and_paints_are_no_sky(color: tuple[float, float, float]) -> None:
    seen = [painted(one, one.is_void, np.array(color)) for one in by_day()]
    assert sky_of(seen).share == 0.0


def test_a_little_blue_is_no_sky() -> None:
    wood = np.array([0.5, 0.35, 0.2])
    seen = [painted(one, one.is_void, wood) if i > 2 else one for i, one in enumerate(by_day())]
    found = sky_of(seen)
    assert not found.by_day
    assert found.share == 0.0


def test_by_day_what_a_sensor_measures_is_no_sky() -> None:
    seen = by_day()
    hall = [np.where(one.is_void, np.float32(9.0), one.depth) for one in seen]
    given = [one.view for one in seen], lambda index: seen[index].picture
    depths = [one.known().z for one in seen]
    assert find_sky(*given, depths, UP, NO_POINTS, hall).share == 0.0
    assert find_sky(*given, depths, UP, NO_POINTS, [None] * len(seen)).by_day


def test_a_picture_of_which_a_mask_hides_all_has_no_sky() -> None:
    seen = by_day()
    hidden = dataclasses.replace(seen[2].view, picture=np.full_like(seen[2].view.picture, -1.0))
    seen[2] = dataclasses.replace(seen[2], view=hidden)
    found = sky_of(seen)
    assert not found.masks[2].any()
    assert found.by_day
    assert not like_sky(seen[2].view, seen[2].picture, UP, NO_POINTS, by_day=True).any()
