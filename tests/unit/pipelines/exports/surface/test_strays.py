"""Points in the air before a wall whose photos are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.surface.strays import strays
from pipelines.exports.surface.surface_file import KeptSurface
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.stereo_views import ColorView

FAR = np.array([4.0e6, -2.0e6, 300.0])
LENS = Pinhole(64, 64, 40.0, 40.0, 32.0, 32.0)
GREY, RED = (120, 120, 120), (200, 30, 30)


def _wall() -> KeptSurface:
    """A square of side 4 at z = 0; cameras look down on it."""
    corners = np.array([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return KeptSurface(FAR, corners, faces, np.full(4, 0.1, np.float32))


def _photo(eye: tuple[float, float], red: NDArray[np.float64] | None = None) -> ColorView:
    """A grey picture from 4 above, with a red blot where it sees the point `red` [3]."""
    picture = np.full((64, 64, 3), GREY, np.uint8)
    if red is not None:
        depth = 4.0 - red[2]
        u = int(32.0 + 40.0 * (red[0] - eye[0]) / depth)
        v = int(32.0 - 40.0 * (red[1] - eye[1]) / depth)
        picture[v - 1 : v + 2, u - 1 : u + 2] = RED
    pose = np.column_stack([np.eye(3), FAR + np.array([*eye, 4.0])])
    return ColorView(picture, np.ones((64, 64), np.bool_), LENS, pose)


EYES = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 1.0)]
AIR = np.array([0.1, 0.0, 1.5])
"""Before the wall, by more than a twentieth of its distance."""


def _lost(point: NDArray[np.float64], color: tuple[int, int, int], photos: list[ColorView]) -> bool:
    colors = np.array([color], np.uint8)
    return bool(strays(FAR + point[None], colors, _wall(), photos)[0])


def test_what_no_photo_has_there_goes() -> None:
    """The fog of a field, which its own views agree on."""
    assert _lost(AIR, RED, [_photo(eye) for eye in EYES])


def test_a_thing_too_thin_for_the_surface_stays_for_its_colour() -> None:
    assert not _lost(AIR, RED, [_photo(eye, red=AIR) for eye in EYES])


def test_what_hangs_needs_more_photos_that_agree_than_what_does_not() -> None:
    """Two of three agree: enough beside the wall, too few before it."""
    beside = np.array([2.6, 0.0, 1.5])
    for point, lost in ((AIR, True), (beside, False)):
        eyes = [(float(np.clip(point[0], -1.6, 1.6)), y) for y in (-1.0, 0.0, 1.0)]
        photos = [_photo(eye, red=point if eye[1] else None) for eye in eyes]
        assert _lost(point, RED, photos) is lost


def test_a_point_near_the_surface_is_asked_for_half_of_its_photos_alone() -> None:
    near = np.array([0.1, 0.0, 0.1])
    photos = [_photo(eye, red=near if eye[0] else None) for eye in EYES]
    assert not _lost(near, RED, photos), "four of six"
    assert _lost(near, RED, [_photo(eye, red=near if eye[0] > 0 else None) for eye in EYES])


def test_photos_that_the_surface_stands_before_say_nothing() -> None:
    """A red thing behind the wall: the cameras above see the wall, the one below sees the thing."""
    behind = np.array([0.0, 0.0, -1.0])
    above = [_photo(eye) for eye in EYES]
    assert _lost(behind, RED, above), "no photo sees it"
    turned = np.diag([1.0, -1.0, -1.0])
    picture = np.full((64, 64, 3), RED, np.uint8)
    usable = np.ones((64, 64), np.bool_)
    pose = np.column_stack([turned, FAR - np.array([0.0, 0.0, 4.0])])
    below = ColorView(picture, usable, LENS, pose)
    assert not _lost(behind, RED, [*above, below])


def test_pixels_that_a_mask_hides_say_nothing() -> None:
    photos = [_photo(eye, red=AIR) for eye in EYES]
    masked = _photo((0.0, 0.0))
    hidden = ColorView(masked.picture, np.zeros_like(masked.usable), LENS, masked.world_from_camera)
    assert not _lost(AIR, RED, photos + 20 * [hidden])
    assert _lost(AIR, RED, photos + 20 * [masked])


@pytest.mark.parametrize("num", [0, 3])
def test_without_points_or_photos_nothing_breaks(num: int) -> None:
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    assert strays(points, colors, _wall(), [_photo(eye) for eye in EYES[:num]]).shape == (0,)
