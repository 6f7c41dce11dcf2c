"""The blank ground of cut-out pictures is told from white things, white rooms, and skies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.stereo.blank import Blank, blank_of, find_blank, like_blank
from pipelines.nerf.stereo.maps import back_project
from tests.unit.pipelines.nerf.stereo.monument import (
    NUM_VIEWS,
    ON_PILLAR,
    Seen,
    in_the_dark,
    walk_round,
)

WHITE = (255, 255, 255)


def painted(one: Seen, where: np.ndarray, color: tuple[int, int, int], noise: int = 0) -> Seen:
    """The view with one colour, give or take some levels, in place of what is there."""
    random = np.random.default_rng(3)
    plain = np.array(color) + random.integers(-noise, noise + 1, one.picture.shape)
    picture = np.where(where[..., None], np.clip(plain, 0, 255), one.picture).astype(np.uint8)
    grey = np.where(where, picture.mean(axis=-1) / 255.0, one.view.picture)
    view = dataclasses.replace(one.view, picture=grey.astype(np.float32))
    return dataclasses.replace(one, view=view, picture=picture)


def cut_out(color: tuple[int, int, int] = WHITE, noise: int = 0) -> list[Seen]:
    return [painted(one, one.is_void, color, noise) for one in in_the_dark()]


def blank_in(seen: list[Seen], measured: list[np.ndarray | None] | None = None) -> Blank:
    views, depths = [one.view for one in seen], [one.known().z for one in seen]
    return find_blank(views, lambda index: seen[index].picture, depths, measured)


@pytest.mark.parametrize("color", [WHITE, (128, 128, 128), (0, 177, 64)])
@pytest.mark.parametrize("noise", [0, 3])
def test_all_of_the_ground_is_found_and_nothing_else(
    color: tuple[int, int, int], noise: int
) -> None:
    seen = cut_out(color, noise)
    found = blank_in(seen)
    assert found.color is not None
    assert np.abs(np.subtract(found.color, color)).max() <= max(noise, 1)
    assert found.num_views == NUM_VIEWS
    assert found.share > 0.5
    for one, mask in zip(seen, found.masks, strict=True):
        assert mask[one.is_void].mean() > 0.99
        assert mask[~one.is_void].mean() < 0.01


def test_a_white_spot_amid_the_thing_is_not_the_ground() -> None:
    """What is behind it is known from the other side, and before it from beside it."""
    spotted, spots = [], []
    for one in cut_out():
        spot = one.what == ON_PILLAR
        at = back_project(one.view, np.where(spot, one.depth, np.float32(0.0)))
        spot[spot] = (at[:, 0] > 0) & (np.abs(at[:, 1]) < 0.15) & (np.abs(at[:, 2] - 1.8) < 0.5)
        spots.append(spot)
        spotted.append(painted(one, spot, WHITE))
    found = blank_in(spotted)
    assert found.share > 0.5
    inside = 0
    for one, spot, mask in zip(spotted, spots, found.masks, strict=True):
        around, amid = like_blank(one.view, one.picture, WHITE)
        if spot.sum() > 100 and amid[spot].mean() > 0.9:
            inside += 1
            assert mask[spot].mean() < 0.05
        assert not (around & amid).any()
    assert inside == 3


def test_what_is_seen_through_a_hole_is_the_ground() -> None:
    """The same spot, with nothing known of anything before or behind it."""
    one = cut_out()[0]
    hole = np.zeros(one.depth.shape, np.bool_)
    hole[80:95, 55:65] = True
    assert (one.what[hole] == ON_PILLAR).all()
    seen = like_blank(one.view, painted(one, hole, WHITE).picture, WHITE)
    assert not seen[0][hole].any()
    assert seen[1][hole].all()
    assert blank_of(one.view, seen, np.zeros((0, 3)))[hole].all()
    solid = back_project(one.view, np.where(hole, one.depth, np.float32(0.0)))
    assert not blank_of(one.view, seen, solid)[hole][20:-20].any()
    dust = np.zeros(one.depth.shape, np.bool_)
    dust[80:83, 55:58] = True
    assert not like_blank(one.view, painted(one, dust, WHITE).picture, WHITE)[1].any()


def test_what_was_photographed_has_no_blank_ground() -> None:
    for seen in (walk_round(), in_the_dark()[:1] + walk_round()[1:]):
        found = blank_in(seen)
        assert (found.share, found.color) == (0.0, None)
        assert not any(mask.any() for mask in found.masks)


def test_a_black_ground_is_left_to_the_dark() -> None:
    """There unlit sides of the thing are told from it."""
    assert blank_in(cut_out((0, 0, 0))).share == 0.0
    assert blank_in(cut_out((40, 40, 40))).share > 0.5


def test_a_white_wall_has_light_on_it() -> None:
    """As white as can be at its one end, ten levels darker at the other."""
    lit = []
    for one in in_the_dark():
        shade = np.broadcast_to(np.linspace(255, 235, one.depth.shape[1]), one.depth.shape)
        picture = np.where(one.is_void[..., None], shade[..., None], one.picture).astype(np.uint8)
        lit.append(dataclasses.replace(one, picture=picture))
    assert blank_in(lit).share == 0.0


def test_few_cut_out_pictures_among_others_are_not_enough() -> None:
    cut, whole = cut_out(), walk_round()
    assert blank_in(cut[:8] + whole[8:]).share == 0.0
    assert blank_in(cut[:9] + whole[9:]).share > 0.3


def test_what_a_sensor_measures_is_not_nothing() -> None:
    seen = cut_out()
    wall: list[np.ndarray | None] = [
        np.where(one.is_void, np.float32(6.0), one.depth) for one in seen
    ]
    assert blank_in(seen, wall).share == 0.0
    alone: list[np.ndarray | None] = [one.depth for one in seen]
    assert blank_in(seen, alone).share > 0.5
    assert blank_in(seen, [None] * len(seen)).share > 0.5


def before_paper(noise: int, brightest: int = 255) -> list[Seen]:
    """The cut-out pictures before paper that is burnt out in the upper two thirds, and fades."""
    random = np.random.default_rng(5)
    seen = []
    for one in in_the_dark():
        height = one.depth.shape[0]
        fading = np.interp(np.arange(height), [0.65 * height, height - 1], [0.0, 35.0])
        paper = np.array([255.0, 251.0, 247.0]) - (255 - brightest) - fading[:, None, None]
        paper = paper + random.integers(-noise, noise + 1, one.picture.shape)
        picture = np.where(one.is_void[..., None], np.clip(paper, 0, 255), one.picture)
        seen.append(dataclasses.replace(one, picture=picture.astype(np.uint8)))
    return seen


def test_what_paper_fades_into_is_paper() -> None:
    seen = before_paper(2)
    found = blank_in(seen)
    assert found.is_paper
    assert found.color is not None
    for one, mask in zip(seen, found.masks, strict=True):
        strict, _ = like_blank(one.view, one.picture, found.color)
        assert strict[one.is_void].mean() < 0.9
        assert mask[one.is_void].mean() > 0.97
        assert mask[~one.is_void].mean() < 0.01


def test_only_paper_that_is_burnt_out_fades() -> None:
    assert not blank_in(before_paper(0)).is_paper
    for seen in (before_paper(0), before_paper(2, brightest=200)):
        found = blank_in(seen)
        assert found.share > 0.3
        assert not found.is_paper
        for one, mask in zip(seen, found.masks, strict=True):
            assert mask[one.is_void].mean() < 0.9


def test_a_shadow_with_a_border_is_no_paper() -> None:
    one = before_paper(1)[0]
    shadow = np.zeros(one.depth.shape, np.bool_)
    shadow[80:100, 5:30] = True
    assert one.is_void[shadow].all()
    picture = one.picture.copy()
    picture[shadow] -= 25
    looks = like_blank(one.view, picture, (255, 251, 247), is_paper=True)
    found = blank_of(one.view, looks, np.zeros((0, 3)))
    assert not found[shadow].any()
    assert found[one.is_void & ~shadow].mean() > 0.97


def test_a_white_thing_before_paper_is_no_paper() -> None:
    """Where it fades into the paper, what other views know of it says that it is there."""
    pale, fringes = [], []
    for number, one in enumerate(before_paper(2)):
        rows, columns = np.indices(one.depth.shape)
        fringe = (one.what == ON_PILLAR) & (rows < 60) & (columns < 60) & (number % 5 == 0)
        begins = np.where(fringe.any(axis=1), fringe.argmax(axis=1), 0)
        faded = np.array([253, 249, 245]) - 2 * (columns - begins[:, None])[..., None]
        picture = np.where(fringe[..., None], faded, one.picture).astype(np.uint8)
        pale.append(dataclasses.replace(one, picture=picture))
        fringes.append(fringe)
    found = blank_in(pale)
    assert found.is_paper
    assert found.color is not None
    for one, fringe, mask in zip(pale, fringes, found.masks, strict=True):
        if fringe.any():
            around, maybe = like_blank(one.view, one.picture, found.color, is_paper=True)
            assert maybe[fringe].mean() > 0.5
            assert (mask & ~around)[fringe].mean() < 0.2
