"""A white table's top laid at the height of its rim."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.completing import completed
from pipelines.nerf.stereo.maps import DepthMap, MapShelf
from pipelines.nerf.stereo.patches import even_patches
from pipelines.nerf.stereo.planes import floors_of, planes_and_samples, up_of
from pipelines.nerf.stereo.tops import Rims, laid_on_tops, upwards
from tests.unit.pipelines.nerf.stereo.white_table import (
    FLOOR,
    ON_BOX,
    ON_WALL,
    TOP,
    Seen,
    walk_round,
)

CONFIG = StereoConfig(num_neighbours=4)
FLOOR_PLANE = np.array([[0.0, 1.0, 0.0, FLOOR]])
UP = np.array([0.0, -1.0, 0.0])


def finished(seen: list[Seen], config: StereoConfig = CONFIG) -> list[DepthMap]:
    maps = MapShelf.of([one.known() for one in seen])
    return list(completed([one.view for one in seen], maps, config))


def rims_of(seen: list[Seen]) -> Rims:
    rims = Rims()
    for one in seen:
        rims.add(one.view, one.known().z, even_patches(one.view.picture))
    return rims


def test_the_table_is_known_whole_and_where_it_is() -> None:
    seen = walk_round()
    for one, found in zip(seen, finished(seen), strict=True):
        assert one.on_table.sum() > 2000
        assert (one.known().z[one.on_table] > 0).mean() < 0.5
        assert (found.z[one.on_table] > 0).mean() > 0.97
        off = np.abs(found.z / np.maximum(one.depth, 1e-6) - 1.0)
        assert np.percentile(off[one.on_table & (found.z > 0)], 97) < 0.01
        assert (found.votes[one.on_table & (found.z > 0)] > 0).mean() > 0.9


def test_what_the_box_had_carried_onto_the_table_is_the_tables() -> None:
    seen = walk_round()
    before = np.mean([_off(one, one.known()) for one in seen])
    after = np.mean([_off(one, found) for one, found in zip(seen, finished(seen), strict=True)])
    assert before > 0.5
    assert after < 0.2 * before


def _off(one: Seen, found: DepthMap) -> float:
    """How much of what is beside the box on the table is off by more than 2 %."""
    at = one.on_table & one.beside_box
    return float((np.abs(found.z / np.where(at, one.depth, 1.0) - 1.0)[at] > 0.02).mean())


def test_the_height_is_found_from_the_rim() -> None:
    seen = walk_round()
    views, maps = [one.view for one in seen], [one.known() for one in seen]
    planes, points, depths = planes_and_samples(views, maps)
    assert np.abs(np.abs(planes @ [0.0, 1.0, 0.0, 0.0]) * np.abs(planes[:, 3]) - TOP).min() > 0.1
    (floor,) = floors_of(up_of(views), planes, points, depths)
    assert np.abs(np.abs(planes[floor]) - FLOOR_PLANE).max() < 0.01
    normal = upwards(up_of(views), planes)
    assert normal is not None
    assert normal @ UP > 0.999
    (top,) = rims_of(seen).tops(normal, FLOOR_PLANE)
    assert np.abs(top - [0.0, -1.0, 0.0, -TOP]).max() < 0.01


def test_a_floor_is_no_top() -> None:
    floor = np.array([[0.0, -1.0, 0.0, -TOP * 1.01]])
    assert len(rims_of(walk_round()).tops(UP, floor)) == 0
    assert len(rims_of(walk_round()).tops(UP, -floor)) == 0
    assert len(rims_of(walk_round()).tops(UP, np.zeros((0, 4)))) == 1


def test_what_is_above_the_camera_is_no_top() -> None:
    """The same rims turned over: a ceiling's."""
    seen = walk_round()
    assert len(rims_of(seen).tops(-UP, np.zeros((0, 4)))) == 0
    for one in seen:
        under = np.array([[0.0, 1.0, 0.0, TOP]])
        laid = laid_on_tops(one.view, one.known().z, under, even_patches(one.view.picture))
        assert (laid == one.known().z).all()


def test_two_tables_of_different_heights_are_two_tops() -> None:
    """As many patches lie at the one as at the other, and none between them."""
    low = walk_round()
    rims = rims_of(low)
    for one in low:
        up = np.column_stack([one.view.world_from_camera[:, :3], one.view.center - [0, 0.4, 0]])
        view = dataclasses.replace(one.view, world_from_camera=up)
        rims.add(view, one.known().z, even_patches(view.picture))
    tops = rims.tops(UP, FLOOR_PLANE)
    assert len(tops) == 2
    assert np.abs(np.sort(tops[:, 3]) - [-TOP, 0.4 - TOP]).max() < 0.01


def test_two_views_are_not_enough() -> None:
    assert len(rims_of(walk_round()[:2]).tops(UP, FLOOR_PLANE)) == 0
    assert len(Rims().tops(UP, FLOOR_PLANE)) == 0


def test_without_a_level_plane_there_are_no_tops() -> None:
    seen = walk_round()
    views = [one.view for one in seen]
    assert upwards(up_of(views), np.array([[0.0, 0.0, 1.0, 3.0], [0.6, 0.5, 0.62, 1.0]])) is None
    assert upwards(up_of(views), np.zeros((0, 4))) is None


def test_the_wall_behind_a_chest_does_not_begin_at_its_height() -> None:
    """The only thing known of the wall is the chest's depth, carried over its upper edge."""
    seen = walk_round(chest=True)
    maps = [_carried_up(one) for one in seen]
    rims = Rims()
    for one, found in zip(seen, maps, strict=True):
        rims.add(one.view, found.z, even_patches(one.view.picture))
    tops = rims.tops(UP, FLOOR_PLANE)
    assert len(tops) == 1
    for one, found in zip(seen, maps, strict=True):
        on_wall = one.what == ON_WALL
        laid = laid_on_tops(one.view, found.z, tops, even_patches(one.view.picture))
        assert on_wall.sum() > 3000
        assert ((laid > 0) & (found.z == 0) & on_wall).sum() < 0.02 * on_wall.sum(), one.view.center


def _carried_up(one: Seen) -> DepthMap:
    """Four rows of the wall above the chest have the depth of its upper edge."""
    z = np.where(one.what == ON_WALL, np.float32(0.0), one.depth)
    for column in np.flatnonzero((one.what == ON_BOX).any(axis=0)):
        edge = int(np.flatnonzero(one.what[:, column] == ON_BOX)[0])
        above = slice(max(edge - 4, 0), edge)
        if (one.what[above, column] == ON_WALL).all():
            z[above, column] = one.depth[edge, column]
    return DepthMap(z, np.where(z > 0, 4, 0).astype(np.uint8))


def test_a_white_cup_stays_where_it_is_known() -> None:
    """It is of the table's own patch, but nothing beyond the patch's border is as deep."""
    seen = walk_round()
    tops = np.array([[0.0, -1.0, 0.0, -TOP]])
    for one in seen:
        z = one.known().z.copy()
        rows, columns = np.nonzero(one.on_table & (z == 0) & ~one.beside_box)
        at = np.s_[rows[500] : rows[500] + 6, columns[500] : columns[500] + 6]
        cup = np.zeros(z.shape, bool)
        cup[at] = one.on_table[at] & (z[at] == 0)
        z[cup] = 0.8 * one.depth[cup]
        laid = laid_on_tops(one.view, z, tops, even_patches(one.view.picture))
        assert cup.any()
        assert (laid[cup] == z[cup]).all()


def test_it_can_be_left_out() -> None:
    seen = walk_round()
    without = finished(seen, dataclasses.replace(CONFIG, level_tops=False))
    for one, found in zip(seen, without, strict=True):
        assert (found.z[one.on_table] > 0).mean() < 0.5


def test_progress_rises_to_the_end_and_may_end_it() -> None:
    seen = walk_round()
    maps = MapShelf.of([one.known() for one in seen])
    told: list[float] = []
    completed([one.view for one in seen], maps, CONFIG, lambda share, _: told.append(share))
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert np.diff([0.0, *told]).max() < 0.25
