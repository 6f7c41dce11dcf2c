"""What the cameras look at: found where it is, and nothing found where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene.focus import find_focus
from tests.unit.pipelines.scene.synthetic_views import arc, look_at, ring

CENTER = np.array([5.0, -3.0, 2.0])


def test_cameras_around_something_look_at_its_middle() -> None:
    focus = find_focus(ring(20, CENTER))
    assert focus is not None
    np.testing.assert_allclose(focus, CENTER, atol=1e-9)


def test_parallel_and_outward_cameras_have_no_focus() -> None:
    ahead = np.stack([look_at(np.array([x, 0.0, 0.0]), np.array([x, 9.0, 0])) for x in range(5)])
    assert find_focus(ahead) is None
    outward = ring(20, np.zeros(3))
    outward[:, :, [0, 2]] *= -1.0
    assert find_focus(outward) is None


@pytest.mark.parametrize("seed", range(10))
def test_cameras_that_look_elsewhere_do_not_move_it(seed: int) -> None:
    """Three of ten photos show something else: the door, the dog, the ceiling."""
    rng = np.random.default_rng(seed)
    cameras = ring(40, CENTER)
    for index in rng.choice(40, 12, replace=False):
        place = cameras[index, :, 3]
        cameras[index] = look_at(place, place + rng.normal(size=3))
    focus = find_focus(cameras)
    assert focus is not None
    assert np.linalg.norm(focus - CENTER) < 0.15


@pytest.mark.parametrize("seed", range(10))
def test_a_room_looked_about_in_has_none(seed: int) -> None:
    """Some point is always nearest to all axes, and here most cameras do not look at it."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1.5, 1.5, (60, 3)) * [1.0, 1.0, 0.2]
    gaze = rng.normal(size=(60, 3)) * [1.0, 1.0, 0.3]
    assert (
        find_focus(np.stack([look_at(p, p + g) for p, g in zip(places, gaze, strict=True)])) is None
    )


def test_axes_that_hardly_turn_do_not_tell_how_far_it_is() -> None:
    """0.3 m of travel at a door handle: half a degree of drift moves the crossing by a third."""
    x = np.linspace(-0.1, 0.1, 30)
    poses = np.stack([look_at(np.array([v, 0.0, 0.0]), np.array([0.0, 0.7, 0.0])) for v in x])
    assert find_focus(poses) is None


def test_a_part_of_a_circle_is_enough() -> None:
    focus = find_focus(arc(40, shake=0.02))
    assert focus is not None
    assert np.linalg.norm(focus) < 0.1


@pytest.mark.parametrize("num", [0, 1])
def test_too_few_cameras_have_none(num: int) -> None:
    assert find_focus(ring(12, CENTER)[:num]) is None


def test_cameras_in_one_point_have_none() -> None:
    cameras = ring(24, CENTER)
    cameras[:, :, 3] = 4.0
    assert find_focus(cameras) is None
