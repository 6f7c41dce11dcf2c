"""Which views see the same, in a flat of closed rooms filmed from within each."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.nerf.stereo import neighbours
from pipelines.nerf.stereo.neighbours import choose_neighbours, depth_range, seen_before_others
from pipelines.nerf.stereo.views import StereoView

Floats = NDArray[np.float64]
SIDE, PER_ROOM, ROOMS = 4.0, 12, 9
LENS = (74.0, 74.0, 48.0, 36.0)


def room(number: int) -> Floats:
    return np.array([number % 3 * SIDE, number // 3 * SIDE, 0.0])


def on_walls(number: int, num: int = 800) -> Floats:
    """Points [P, 3] on the walls of a room."""
    random = np.random.default_rng(number)
    points = random.uniform(-0.5, 0.5, (num, 3)) * [SIDE, SIDE, 2.0]
    wall = random.integers(0, 4, num)
    points[np.arange(num), wall % 2] = np.where(wall < 2, -0.49, 0.49) * SIDE
    return points + room(number)


def inside(number: int) -> list[StereoView]:
    """Cameras near the middle of a room, all round, that look outwards."""
    found = []
    for angle in np.linspace(0.0, 2.0 * np.pi, PER_ROOM, endpoint=False):
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([np.sin(angle), -np.cos(angle), 0.0])
        center = room(number) - 0.3 * axis
        pose = np.column_stack([right, [0.0, 0.0, -1.0], axis, center])
        found.append(StereoView(np.zeros((72, 96), np.float32), LENS, pose))
    return found


VIEWS = [view for number in range(ROOMS) for view in inside(number)]
POINTS = np.concatenate([on_walls(number) for number in range(ROOMS)])


def test_a_view_sees_the_walls_of_its_room_and_little_behind_them() -> None:
    shares = []
    for index, view in enumerate(VIEWS):
        _, seen = seen_before_others(view, POINTS)
        own = np.abs(POINTS - room(index // PER_ROOM))[:, :2].max(axis=1) < 0.5 * SIDE
        _, shown = view.seen(POINTS)
        assert (seen & own).sum() > 0.95 * (shown & own).sum()
        shares.append((own[seen].mean(), own[shown].mean()))
    seen_share, shown_share = np.mean(shares, axis=0)
    assert seen_share > 0.5 > 0.4 > shown_share


def test_views_are_compared_with_those_of_their_own_room() -> None:
    neighbours = choose_neighbours(VIEWS, POINTS, 4, 6.0)
    own = [
        [other // PER_ROOM == index // PER_ROOM for other in found]
        for index, found in enumerate(neighbours)
    ]
    assert all(own)
    assert np.mean(np.concatenate(own)) > 0.9


def test_depth_is_sought_from_the_walls_of_the_room_on() -> None:
    for view in VIEWS:
        limits = depth_range(view, POINTS)
        assert limits is not None
        assert limits[0] < 0.45 * SIDE


def test_depth_is_sought_behind_a_fence_too() -> None:
    """Before all of what is there."""
    view = inside(0)[0]
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 20), np.linspace(-0.5, 0.5, 20))
    fence, hill = (
        np.stack([x * z * 1.2, y * z, np.full_like(x, z)], axis=-1).reshape(-1, 3)
        for z in (1.0, 20.0)
    )
    points = np.concatenate([fence, hill]) @ view.world_from_camera[:, :3].T + view.center
    depths, seen = seen_before_others(view, points)
    assert depths[seen].max() < 1.1
    limits = depth_range(view, points)
    assert limits is not None
    assert limits[0] < 1.0
    assert limits[1] > 20.0


def test_a_few_points_at_a_time_give_the_same_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view of which no portion shows anything among them."""
    pose = VIEWS[0].world_from_camera.copy()
    pose[2, 3] = 100.0
    aside = StereoView(VIEWS[0].picture, LENS, pose)
    views = [*VIEWS[: 2 * PER_ROOM], aside]
    whole = choose_neighbours(views, POINTS, 4, 6.0)
    monkeypatch.setattr(neighbours, "_DIRECTIONS", 700 * len(views))
    assert len(neighbours._portions(len(POINTS), len(views))) == 11
    assert choose_neighbours(views, POINTS, 4, 6.0) == whole
    assert all(whole[: 2 * PER_ROOM])


def before_wall(x: float, down_deg: float) -> StereoView:
    """A camera two metres before a wall at z = 0, that looks down by some degrees."""
    down = np.radians(down_deg)
    axis = np.array([0.0, -np.sin(down), np.cos(down)])
    below = np.array([0.0, -np.cos(down), -np.sin(down)])
    pose = np.column_stack([[1.0, 0.0, 0.0], below, axis, [x, 0.0, -2.0]])
    return StereoView(np.zeros((72, 96), np.float32), LENS, pose)


def lower(neighbours: list[int]) -> int:
    """How many of the neighbours look down."""
    return sum(index >= 9 for index in neighbours)


def test_who_alone_sees_the_lower_half_of_a_picture_is_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A plain cupboard below a shelf has no points: by these, who looks at the shelf is best."""
    shelf = [before_wall(x, 0.0) for x in np.linspace(-0.3, 0.3, 9)]
    cupboard = [before_wall(x, 25.0) for x in (-0.12, 0.0, 0.12)]
    random = np.random.default_rng(0)
    points = random.uniform([-0.6, -0.3, 0.0], [0.6, 0.4, 0.0], (500, 3))
    found = choose_neighbours([*shelf, *cupboard], points, 6, 6.0)
    assert all(len(set(one)) == 6 for one in found)
    assert min(lower(one) for one in found[9:]) >= 2
    monkeypatch.setattr(neighbours, "_LEAST_GAIN", 2.0)
    by_points = choose_neighbours([*shelf, *cupboard], points, 6, 6.0)
    assert max(lower(one) for one in by_points[9:]) < 2
    assert [one[:3] for one in found] == [one[:3] for one in by_points]
