"""Blank walls stood up where the floor ends, and what only looks like one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.maps import DepthMap, MapShelf
from pipelines.nerf.stereo.planes import up_of
from pipelines.nerf.stereo.standing import _goes_around, _is_level_or_upright, stood_up
from tests.unit.pipelines.nerf.stereo.blank_room import WALL, Seen, look, walk

CONFIG = StereoConfig(num_neighbours=5)


def stood(seen: list[Seen], maps: list[DepthMap] | None = None) -> list[DepthMap]:
    before = MapShelf.of(maps or [one.known() for one in seen])
    return list(stood_up([one.view for one in seen], before, CONFIG))


def test_a_blank_wall_stands_where_the_floor_ends() -> None:
    seen = [look(place) for place in walk()]
    told: list[float] = []
    found = stood_up(
        [one.view for one in seen],
        MapShelf.of([one.known() for one in seen]),
        CONFIG,
        lambda share, message: told.append(share),
    )
    for one, after in zip(seen, found, strict=True):
        wall = ~one.on_floor
        assert wall.sum() > 3000
        assert (after.z[wall] > 0).mean() > 0.8
        there = wall & (after.z > 0)
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.02
        assert (after.votes[there] >= 1).all()
        assert np.array_equal(after.z[~wall], one.known().z[~wall])
    assert told == sorted(told)
    assert told[-1] == 1.0


def still() -> list[tuple[float, float, float]]:
    """Where eight cameras are that see the wall's foot from less than a degree apart."""
    return [(-0.8 + 0.22 * i, -0.03 * (i % 3), 0.0) for i in range(8)]


def way_through(seen: list[Seen]) -> list[DepthMap]:
    """What is known where two of the views know something behind the blank wall, to the side."""
    maps = [one.known() for one in seen]
    for index in (2, 3):
        maps[index] = with_known(seen[index], (slice(5, 45), slice(60, 110)), 1.5)
    return maps


def test_a_wall_that_ends_all_that_is_known_stands_for_who_hardly_moved() -> None:
    """As for who turns in the middle of a room."""
    seen = [look(place) for place in still()]
    for one, after in zip(seen, stood(seen), strict=True):
        wall = ~one.on_floor
        there = wall & (after.z > 0)
        assert there.sum() > 0.8 * wall.sum()
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.02
    maps = way_through(seen)
    for before, after in zip(maps, stood(seen, maps), strict=True):
        assert np.array_equal(before.z, after.z)


def test_of_a_wall_that_is_seen_from_apart_something_may_be_known_behind() -> None:
    """A door is open."""
    seen = [look(place) for place in walk()]
    maps = way_through(seen)
    for index, after in enumerate(stood(seen, maps)):
        if index not in (2, 3):
            assert (after.z[~seen[index].on_floor] > 0).mean() > 0.5


def test_a_corner_of_blank_walls_is_two_planes() -> None:
    """The cameras look along the floor's diagonal, so that its end is one line and then another."""
    seen = [look(place, turn=0.5 * (-1) ** i) for i, place in enumerate(walk())]
    found = stood(seen)
    errors = [
        np.abs(after.z / one.depth - 1.0)[~one.on_floor & (after.z > 0)]
        for one, after in zip(seen, found, strict=True)
    ]
    assert np.quantile(np.concatenate(errors), 0.95) < 0.02
    assert sum(len(error) for error in errors) > 0.7 * sum((~one.on_floor).sum() for one in seen)


def test_what_hangs_before_a_floor_stands_on_no_line_of_it() -> None:
    """Its lower edge hides another line of the floor in each view."""
    seen = [look(place, box=(2.2, 1.2)) for place in walk()]
    found = stood(seen)
    for one, after in zip(seen, found, strict=True):
        board = one.view.picture == np.float32(0.15)
        assert board.sum() > 300
        assert (after.z[board] > 0).mean() < 0.01


def test_a_table_with_a_floor_below_it_has_no_walls() -> None:
    """Its end looks the same, but where there is something below a plane it is no floor."""
    seen = [look(place, backdrop=9.0) for place in walk()]
    maps = [one.known() for one in seen]
    assert any((after.z > before.z).any() for before, after in zip(maps, stood(seen), strict=True))
    deep = []
    for one in seen:
        z = one.known().z.copy()
        z[-30:, :40] *= 1.5  # beside the table, below it
        deep.append(DepthMap(z, np.where(z > 0, 4, 0).astype(np.uint8)))
    for before, after in zip(deep, stood(seen, deep), strict=True):
        assert np.array_equal(before.z, after.z)


def test_no_wall_has_cameras_on_both_sides() -> None:
    """Who walks round a table sees its ends before a plain room from all around."""
    across = [(0.4 * i - 0.6, -0.2 * (i % 2), 2 * WALL - 0.3 * i) for i in range(4)]
    seen = [look(place, backdrop=9.0) for place in walk()]
    seen += [look(place, turn=np.pi, backdrop=9.0) for place in across]
    maps = [one.known() for one in seen]
    for before, after in zip(maps, stood(seen), strict=True):
        assert np.array_equal(before.z, after.z)


def test_a_wall_that_others_see_through_is_not_believed() -> None:
    """Three of the views know what is behind it."""
    seen = [look(place) for place in walk()]
    maps = [one.known() for one in seen]
    for index in (2, 3, 4, 5, 6):
        far = np.where(seen[index].on_floor, maps[index].z, 3.0 * seen[index].depth)
        maps[index] = dataclasses.replace(maps[index], z=far.astype(np.float32))
    found = stood(seen, maps)
    for index in (0, 1, 7):
        assert np.array_equal(found[index].z, maps[index].z)


def test_views_without_any_depth_stay_as_they_are() -> None:
    seen = [look(place) for place in walk()[:3]]
    nothing = [
        DepthMap(np.zeros_like(one.depth), np.zeros(one.depth.shape, np.uint8)) for one in seen
    ]
    for after in stood(seen, nothing):
        assert not after.z.any()


def with_known(one: Seen, where: tuple[slice, slice], factor: float = 1.0) -> DepthMap:
    """What is known of a view, and there its true depth times a factor."""
    z, votes = one.known().z.copy(), one.known().votes.copy()
    z[where], votes[where] = factor * one.depth[where], 3
    return DepthMap(z, votes)


def test_a_wall_of_which_something_is_known_stands_up_as_well() -> None:
    """A picture on it tells where it is, not how far it reaches."""
    seen = [look(place) for place in walk()]
    picture = (slice(5, 45), slice(90, 150))
    maps = [with_known(one, picture) for one in seen]
    for one, before, after in zip(seen, maps, stood(seen, maps), strict=True):
        wall = ~one.on_floor
        assert (before.z[wall] > 0).mean() < 0.4
        assert (after.z[wall] > 0).mean() > 0.8
        assert (
            np.abs(after.z[wall & (after.z > 0)] / one.depth[wall & (after.z > 0)] - 1).max() < 0.02
        )


def test_views_in_which_the_foot_of_the_wall_is_hidden_learn_it_from_others() -> None:
    seen = [look(place) for place in walk()]
    maps = []
    for number, one in enumerate(seen):
        z = one.known().z.copy()
        foot = int(one.on_floor.any(axis=1).argmax())
        if number >= 4:
            z[: foot + 30] = 0.0
        maps.append(DepthMap(z, np.where(z > 0, 4, 0).astype(np.uint8)))
    for one, after in zip(seen[4:], stood(seen, maps)[4:], strict=True):
        wall = ~one.on_floor
        assert (after.z[wall] > 0).mean() > 0.6
        there = wall & (after.z > 0)
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.02
        assert (after.votes[there] >= 1).all()


def test_what_seems_to_stand_before_a_plain_wall_goes_back_onto_it() -> None:
    """Matching by squares makes things a little larger than they are, at the cost of the wall."""
    seen = [look(place) for place in walk()]
    halo = (slice(10, 30), slice(100, 130))
    maps = [with_known(one, halo, 0.8) if i == 3 else one.known() for i, one in enumerate(seen)]
    after = stood(seen, maps)[3]
    wall = ~seen[3].on_floor[halo]
    assert wall.all()
    right = np.abs(after.z[halo] / seen[3].depth[halo] - 1.0) < 0.02
    assert right.mean() > 0.9
    # Something farther is a way through, and stays.
    maps[3] = with_known(seen[3], halo, 1.3)
    assert np.array_equal(stood(seen, maps)[3].z[halo], maps[3].z[halo])


HUNG = (-0.7, 0.5, -0.6, 0.3)
UP = np.array([0.0, -1.0, 0.0])


def before_a_wall(box: tuple[float, float] | None = None) -> list[Seen]:
    """What hangs on a blank wall, filmed so that no floor is seen."""
    places = [(-0.4 + 0.12 * i, -0.5 - 0.1 * (i % 3), 1.6 + 0.05 * i) for i in range(8)]
    return [look(place, hung=HUNG, box=box) for place in places]


def known_of(one: Seen, where: np.ndarray) -> DepthMap:
    """A view of which its true depth is known there [H, W], and nothing else."""
    z = np.where(where, one.depth, 0.0).astype(np.float32)
    return DepthMap(z, np.where(where, 4, 0).astype(np.uint8))


def stood_without_floor(seen: list[Seen], maps: list[DepthMap]) -> list[DepthMap]:
    return list(stood_up([one.view for one in seen], MapShelf.of(maps), CONFIG, up=UP))


def test_a_blank_wall_goes_on_around_what_hangs_on_it() -> None:
    """The wall is known by the picture on it alone, and no floor is seen."""
    seen = before_a_wall()
    assert not any(one.on_floor.any() for one in seen)
    pictures = [one.view.picture < 0.8 for one in seen]
    maps = [known_of(one, picture) for one, picture in zip(seen, pictures, strict=True)]
    for one, picture, after in zip(seen, pictures, stood_without_floor(seen, maps), strict=True):
        assert 0.04 < picture.mean() < 0.5
        there = after.z > 0
        assert there[~picture].mean() > 0.85
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.02
        assert (after.votes[there] >= 1).all()


def test_a_wall_without_a_floor_is_handed_on_to_who_knows_nothing_of_it() -> None:
    seen = before_a_wall()
    pictures = [one.view.picture < 0.8 for one in seen]
    maps = [
        known_of(one, picture & (number < 6))
        for number, (one, picture) in enumerate(zip(seen, pictures, strict=True))
    ]
    found = stood_without_floor(seen, maps)
    for one, picture, after in zip(seen[6:], pictures[6:], found[6:], strict=True):
        there = after.z > 0
        assert there[~picture].mean() > 0.8
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.02


def test_a_surface_with_much_behind_it_is_no_wall_that_goes_on() -> None:
    """As the front of a cupboard, which ends somewhere."""
    seen = before_a_wall()
    maps = [known_of(one, one.view.picture < 0.8) for one in seen]
    for one, found in zip(seen, maps, strict=True):
        found.z[:, -40:] = 1.5 * one.depth[:, -40:]
        found.votes[:, -40:] = 4
    for before, after in zip(maps, stood_without_floor(seen, maps), strict=True):
        assert np.array_equal(before.z, after.z)


def test_a_front_with_another_surface_behind_it_is_no_wall_that_goes_on() -> None:
    """As what is seen beside a fridge, little as it may be: where else than there is its wall."""
    seen = before_a_wall()
    maps, without = [], []
    for one in seen:
        picture = one.view.picture < 0.8
        without.append(known_of(one, picture))
        farther = (6.0 - one.view.center[2]) / (WALL - one.view.center[2])
        beside = np.zeros_like(picture)
        beside[:, -8:] = True
        z = np.where(picture, one.depth, np.where(beside, farther * one.depth, 0.0))
        maps.append(DepthMap(z.astype(np.float32), np.where(z > 0, 4, 0).astype(np.uint8)))
    pairs = zip(without, stood_without_floor(seen, without), strict=True)
    assert all((after.z > before.z).any() for before, after in pairs)
    for before, after in zip(maps, stood_without_floor(seen, maps), strict=True):
        assert np.array_equal(before.z, after.z)


def test_what_hangs_free_before_a_known_wall_is_not_laid_on_it() -> None:
    """The wall is all around the blank board, which reaches no rim of the pictures."""
    seen = before_a_wall(box=(3.4, 0.3))
    boards = [one.view.picture == np.float32(0.15) for one in seen]
    maps = [known_of(one, ~board) for one, board in zip(seen, boards, strict=True)]
    for board, after in zip(boards, stood_without_floor(seen, maps), strict=True):
        assert board.sum() > 300
        assert not after.z[board].any()


def test_a_wall_that_is_next_to_a_patch_along_one_line_is_not_around_it() -> None:
    """That is the border of the next wall."""
    ending, along = np.array([True, False]), np.arange(20.0)
    own = np.zeros(40, np.int64)
    corner = np.concatenate([along, along]), np.concatenate([2.0 * along, 2.0 * along + 0.5])
    around = np.concatenate([along, 0.0 * along]), np.concatenate([0.0 * along, along])
    assert not _goes_around(*corner, own, ending).any()
    assert _goes_around(*around, own, ending).tolist() == [True, False]
    assert not _goes_around(*around, own + 1, ending).any()
    assert not _goes_around(*around, own - 1, ending).any()


def test_nothing_is_laid_aslant_by_its_border_alone() -> None:
    """Planes of small surfaces, 8 degrees off upright, are touched by some border, too."""
    assert _is_level_or_upright(np.array([1.0, -0.99, 0.85, 0.0, -0.08])).all()
    assert not _is_level_or_upright(np.array([0.139, -0.5, 0.7])).any()


def on_its_side(one: Seen) -> Seen:
    """The same rays of the same place, stored a quarter turned."""
    view, height_px = one.view, one.view.picture.shape[1]
    fx, fy, cx, cy = view.lens
    x, y, z, center = view.world_from_camera.T
    return dataclasses.replace(
        one,
        view=dataclasses.replace(
            view,
            picture=np.ascontiguousarray(np.rot90(view.picture)),
            lens=(fy, fx, cy, height_px - cx),
            world_from_camera=np.column_stack([y, -x, z, center]),
        ),
        depth=np.ascontiguousarray(np.rot90(one.depth)),
        on_floor=np.ascontiguousarray(np.rot90(one.on_floor)),
    )


@pytest.mark.parametrize("every", [1, 2], ids=["all", "every second"])
def test_pictures_that_are_stored_on_their_side_show_the_same_wall(every: int) -> None:
    seen = [look(place) for place in walk()]
    up = up_of([one.view for one in seen])
    seen = [on_its_side(one) if i % every == 0 else one for i, one in enumerate(seen)]
    before = MapShelf.of([one.known() for one in seen])
    found = stood_up([one.view for one in seen], before, CONFIG, up=up)
    for one, after in zip(seen, found, strict=True):
        wall = ~one.on_floor
        assert (after.z[wall] > 0).mean() > 0.8
        there = wall & (after.z > 0)
        assert np.abs(after.z[there] / one.depth[there] - 1.0).max() < 0.02
