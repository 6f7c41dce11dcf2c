"""What is nothing leaves the maps, with the sheets that hung there, and the rest stays."""

from __future__ import annotations

import numpy as np

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.dark import find_dark
from pipelines.nerf.stereo.maps import VOID, DepthMap, MapShelf
from pipelines.nerf.stereo.sky import find_sky
from pipelines.nerf.stereo.void import without
from tests.unit.pipelines.nerf.stereo.monument import ON_PILLAR, UP, Seen, in_the_dark, walk_round

CONFIG = StereoConfig(num_neighbours=4)


def masks_of(seen: list[Seen]) -> list[np.ndarray]:
    views, depths = [one.view for one in seen], [one.known().z for one in seen]
    return find_sky(views, lambda index: seen[index].picture, depths, UP, np.zeros((0, 3))).masks


def test_nothing_is_left_where_nothing_stands_and_the_rest_stays() -> None:
    seen = walk_round()
    maps = MapShelf.of([one.known() for one in seen])
    left = without(masks_of(seen), [one.view for one in seen], maps, CONFIG)
    for one, before, found in zip(seen, maps, left, strict=True):
        assert (before.z[one.is_void] > 0).mean() > 0.5
        assert (found.z[one.is_void] > 0).mean() < 0.03
        assert found.is_void[one.is_void].mean() > 0.93
        assert not found.is_void[~one.is_void].any()
        on_pillar = one.what == ON_PILLAR
        same = (found.z == before.z) & (found.votes == before.votes)
        assert same[on_pillar].mean() > 0.97
        assert ((found.votes == VOID) == found.is_void).all()


def test_a_sheet_where_others_see_nothing_goes_too() -> None:
    """One picture's sky was not told, since a gull's colour was on it; its neighbours' was."""
    seen = walk_round()
    maps = MapShelf.of([one.known() for one in seen])
    masks = masks_of(seen)
    views = [one.view for one in seen]
    left = without([masks[0] & False, *masks[1:]], views, maps, CONFIG)
    sheet = seen[0].is_void & (maps[0].z > 0)
    assert sheet.sum() > 1000
    assert (left[0].z[sheet] > 0).mean() < 0.3
    on_pillar = seen[0].what == ON_PILLAR
    assert (left[0].z[on_pillar] > 0).mean() > 0.9


def test_nothing_is_no_depth() -> None:
    z = np.array([[0.0, 2.0, 0.0]], np.float32)
    found = DepthMap(z, np.array([[VOID, VOID, 0]], np.uint8))
    assert found.is_void.tolist() == [[True, False, False]]


def test_black_sheets_go_and_what_is_lit_stays() -> None:
    seen = in_the_dark()
    maps = MapShelf.of([one.known() for one in seen])
    views, depths = [one.view for one in seen], [one.known().z for one in seen]
    found = find_dark(views, lambda index: seen[index].picture, depths)
    for one, before, after in zip(
        seen, maps, without(found.masks, views, maps, CONFIG), strict=True
    ):
        assert (before.z[one.is_void] > 0).mean() > 0.4
        assert (after.z[one.is_void] > 0).mean() < 0.03
        assert (after.z[one.what == ON_PILLAR] > 0).mean() > 0.95
        assert not after.is_void[~one.is_void].any()
