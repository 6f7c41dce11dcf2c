"""The dark is told from what is lit in it, from unlit sides, and from rooms with black things."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.stereo.dark import Dark, before_solid, find_dark, like_dark, solid_points
from pipelines.nerf.stereo.maps import back_project
from tests.unit.pipelines.nerf.stereo.monument import (
    LAMP,
    NUM_VIEWS,
    ON_PILLAR,
    Seen,
    in_the_dark,
    walk_round,
)


def dark_of(seen: list[Seen], measured: list[np.ndarray | None] | None = None) -> Dark:
    views, depths = [one.view for one in seen], [one.known().z for one in seen]
    return find_dark(views, lambda index: seen[index].picture, depths, measured)


def painted(one: Seen, where: np.ndarray, level: float) -> Seen:
    """The view with a grey in place of what is there."""
    picture = np.where(where[..., None], np.uint8(round(255 * level)), one.picture)
    grey = np.where(where, np.float32(level), one.view.picture)
    view = dataclasses.replace(one.view, picture=grey.astype(np.float32))
    return dataclasses.replace(one, view=view, picture=picture)


def test_all_of_the_dark_is_found_and_nothing_else() -> None:
    seen = in_the_dark()
    found = dark_of(seen)
    assert found.num_views == NUM_VIEWS
    assert found.share > 0.5
    for one, mask in zip(seen, found.masks, strict=True):
        # Beside what is solid a pixel's width is not told.
        assert mask[one.is_void].mean() > 0.95
        assert mask[~one.is_void].mean() < 0.01


def test_the_unlit_side_of_a_thing_is_not_nothing() -> None:
    """As black as what is beside it; but what others see lit lies behind it."""
    seen = in_the_dark(lamp=LAMP)
    found = dark_of(seen)
    num_from_behind = 0
    for one, mask in zip(seen, found.masks, strict=True):
        on_pillar = one.what == ON_PILLAR
        black = on_pillar & (one.picture.max(axis=-1) < 12)
        alone = like_dark(one.view, one.picture)
        if black.sum() > 0.95 * on_pillar.sum():
            num_from_behind += 1
            assert alone[black].mean() > 0.9
            assert mask[on_pillar].mean() < 0.25
        assert mask[one.is_void].mean() > 0.95
    assert num_from_behind == 2


def test_a_black_spot_on_a_lit_thing_is_not_nothing() -> None:
    """What is lit on its other side lies behind it."""
    spotted, spots = [], []
    for one in in_the_dark():
        spot = one.what == ON_PILLAR
        at = back_project(one.view, np.where(spot, one.depth, np.float32(0.0)))
        spot[spot] = (at[:, 0] > 0.35) & (np.abs(at[:, 2] - 1.8) < 0.4)
        spots.append(spot)
        spotted.append(painted(one, spot, 0.02))
    found = dark_of(spotted)
    assert sum(spot.sum() > 200 for spot in spots) >= 3
    for one, spot, mask in zip(spotted, spots, found.masks, strict=True):
        if spot.sum() > 200:
            assert like_dark(one.view, one.picture)[spot].mean() > 0.5
        assert mask[one.what == ON_PILLAR].mean() < 0.02


def test_a_square_by_day_has_no_dark() -> None:
    found = dark_of(walk_round())
    assert (found.share, found.num_views) == (0.0, 0)
    assert not any(mask.any() for mask in found.masks)


@pytest.mark.parametrize("level", [0.2, 0.5])
def test_what_is_grey_is_not_dark(level: float) -> None:
    assert dark_of([painted(one, one.is_void, level) for one in in_the_dark()]).num_views == 0


def test_few_pictures_with_black_in_them_are_not_enough() -> None:
    dark, light = in_the_dark(), walk_round()
    assert dark_of(dark[:4] + light[4:]).share == 0.0
    assert dark_of(dark[:6] + light[6:]).share > 0.0


def test_a_little_black_is_not_enough() -> None:
    """A black door in every picture."""
    seen = []
    for one in walk_round():
        door = np.zeros(one.depth.shape, np.bool_)
        door[:, :15] = True
        seen.append(painted(one, door, 0.02))
    found = dark_of(seen)
    assert found.num_views == NUM_VIEWS
    assert found.share == 0.0


def test_what_a_sensor_measures_is_not_nothing() -> None:
    seen = in_the_dark()
    cloth: list[np.ndarray | None] = [
        np.where(one.is_void, np.float32(6.0), one.depth) for one in seen
    ]
    assert dark_of(seen, cloth).share == 0.0
    alone: list[np.ndarray | None] = [one.depth for one in seen]
    assert dark_of(seen, alone).share > 0.5
    assert dark_of(seen, [None] * len(seen)).share > 0.5


def test_a_black_thing_that_somebody_has_cut_out_stays() -> None:
    """All that a mask leaves is at its border, and black."""
    cut = []
    for one in in_the_dark():
        black = painted(one, one.what == ON_PILLAR, 0.02)
        picture = np.where(one.what == ON_PILLAR, black.view.picture, np.float32(-1.0))
        view = dataclasses.replace(black.view, picture=picture.astype(np.float32))
        cut.append(dataclasses.replace(black, view=view))
        assert like_dark(view, black.picture).mean() > 0.15
    assert dark_of(cut).share == 0.0


def test_points_that_others_look_past_are_not_solid() -> None:
    """At outlines depths are wrong, of what is lit, too."""
    seen = in_the_dark()
    views, black = [one.view for one in seen], [one.is_void for one in seen]
    depths, num_wrong = [], 0
    for one in seen:
        pillar = one.what == ON_PILLAR
        outline = pillar & ~(np.roll(pillar, 3, axis=1) & np.roll(pillar, -3, axis=1))
        depths.append(np.where(outline, np.float32(5.0), one.depth))
        num_wrong += int(outline.sum())
    solid = solid_points(views, depths, black)
    above = solid[:, 2] > 0.05
    assert num_wrong > 3_000
    assert above.sum() > 10_000
    assert (np.linalg.norm(solid[above, :2], axis=1) > 0.7).sum() < 0.05 * num_wrong
    for one in seen:
        before = before_solid(one.view, solid)
        assert before[~one.is_void].mean() > 0.9
        assert before[one.is_void].mean() < 0.05
