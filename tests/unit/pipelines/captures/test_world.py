"""Which way is up in a world that brings no gravity, and where its origin is."""

from __future__ import annotations

import numpy as np
import PIL.Image
import PIL.ImageOps
import pytest

from pipelines.captures.world import as_viewed, other_axis_up, settled
from pipelines.sample.film import phone_camera, walk
from pipelines.sample.scene import pose_matrix
from tests.unit.pipelines.scene.synthetic_views import ring

QUARTERS = {
    "+Y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-Y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "+X": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-X": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-Z": np.diag([1.0, -1, -1]),
}
"""From a world with +Z up to one in which another axis is."""


def walked() -> np.ndarray:
    """[N, 3, 4]: upright pictures around the sample's table, +Z up."""
    truth = walk(30, phone_camera(64))
    return np.stack([pose_matrix(image)[:3] for image in truth.images])


@pytest.mark.parametrize("axis", QUARTERS)
def test_another_axis_is_found_and_turned_up(axis: str) -> None:
    upright = walked()
    found = other_axis_up(QUARTERS[axis] @ upright)
    assert found is not None
    assert found[0] == axis
    np.testing.assert_allclose(np.linalg.det(found[1]), 1.0)
    turned = found[1] @ QUARTERS[axis] @ upright
    ups = turned[:, :, 1].mean(axis=0)
    assert ups[2] > 0.8 * np.linalg.norm(ups)


def test_an_upright_world_stays_as_it_is_however_pictures_are_stored() -> None:
    upright = walked()
    assert other_axis_up(upright) is None
    for turn in ([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]):
        sideways = upright.copy()
        sideways[:, :, :3] = upright[:, :, :3] @ np.array(turn)
        assert other_axis_up(sideways) is None


@pytest.mark.parametrize(
    "turn", [[[0, 1, 0], [-1, 0, 0], [0, 0, 1]], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
)
def test_a_world_that_lies_is_turned_up_by_pictures_on_their_side_too(
    turn: list[list[int]],
) -> None:
    """Where somebody went all round the thing."""
    upright = np.array(ring(24, np.zeros(3)))
    sideways = upright.copy()
    sideways[:, :, :3] = upright[:, :, :3] @ np.array(turn, float)
    assert other_axis_up(sideways) is None
    found = other_axis_up(QUARTERS["+Y"] @ sideways)
    assert found is not None
    assert found[0] == "+Y"


def test_a_world_that_leans_between_its_axes_is_left_alone() -> None:
    angle = np.radians(45.0)
    lean = np.array(
        [[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]]
    )
    assert other_axis_up(lean @ walked()) is None


def test_cameras_that_only_move_along_say_nothing() -> None:
    """Level cameras that all look one way could be rolled by a quarter."""
    one = walked()[:1]
    assert other_axis_up(QUARTERS["+Y"] @ np.repeat(one, 10, axis=0)) is None


STORED = {
    3: [[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]],
    6: [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    8: [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]],
}
"""The stored picture's axes (columns) in those of the viewed one, by EXIF orientation."""


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_poses_are_turned_as_the_picture_is_for_people_who_look_at_it(orientation: int) -> None:
    """The marked pixel of a stored picture: along which viewed axes does it lie?"""
    pixels = np.zeros((5, 9), np.uint8)
    pixels[2, 8] = 255  # on the right edge, in the middle
    image = PIL.Image.fromarray(pixels)
    image.getexif()[0x0112] = orientation
    viewed = np.asarray(PIL.ImageOps.exif_transpose(image))
    row, column = np.argwhere(viewed == 255)[0]
    right = np.array([column - viewed.shape[1] // 2, viewed.shape[0] // 2 - row]) / 4.0
    stored = np.eye(3, 4)[None]
    turned = as_viewed(stored, [orientation])[0]
    # The stored picture's X axis in the world, by both accounts.
    np.testing.assert_allclose(turned[:, :2] @ right, stored[0, :, 0], atol=1e-12)
    upright = walked()
    on_its_side = upright.copy()
    on_its_side[:, :, :3] = upright[:, :, :3] @ np.array(STORED[orientation])
    back = as_viewed(on_its_side, [orientation] * len(upright))
    np.testing.assert_allclose(back, upright, atol=1e-12)


def leaning(angle_deg: float) -> np.ndarray:
    a = np.radians(angle_deg)
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


@pytest.mark.parametrize("angle_deg", [60.0, 90.0, 150.0, 180.0])
@pytest.mark.parametrize("orientation", [None, 6])
def test_an_unknown_vertical_is_found_however_pictures_are_stored(
    angle_deg: float, orientation: int | None
) -> None:
    poses = walked()
    if orientation is not None:
        poses[:, :, :3] = poses[:, :, :3] @ np.array(STORED[orientation])
    lying = leaning(angle_deg) @ poses
    move = settled(lying, [orientation] * len(lying), "unknown", {})
    up = move.rotation @ leaning(angle_deg)[:, 2]
    assert np.degrees(np.arccos(min(up[2], 1.0))) < 8.0
    np.testing.assert_allclose(np.array(move.notes["applied_transform"])[:, :3], move.rotation)
    assert move.notes["up_from"] == "vertical"
    assert settled(lying, [orientation] * len(lying), "known", {}).notes == {}


@pytest.mark.parametrize("orientation", [None, 6])
def test_a_world_of_which_only_devices_know_up_is_turned_as_they_say(
    orientation: int | None,
) -> None:
    """A drone's pictures, straight down, and a world that has them look along its Y axis."""
    poses = np.stack([np.eye(3, 4)] * 9)
    poses[:, :2, 3] = [(x, y) for x in range(3) for y in range(3)]
    if orientation is not None:
        poses[:, :, :3] = poses[:, :, :3] @ np.array(STORED[orientation])
    lying = leaning(90.0) @ poses
    unknown = settled(lying, [orientation] * 9, "unknown", {})
    assert unknown.notes["up_from"] == "camera_up"
    move = settled(lying, [orientation] * 9, "unknown", {}, [(0.0, 0.0, 1.0)] * 8 + [None])
    assert move.notes["up_from"] == "measured"
    np.testing.assert_allclose(move.poses(lying)[:, 2, 2], 1.0, atol=1e-9)
    np.testing.assert_allclose(np.ptp(move.poses(lying)[:, 2, 3]), 0.0, atol=1e-9)


def test_map_coordinates_are_brought_near_in_double_precision() -> None:
    truth = walked()
    away = truth.copy()
    away[:, :, 3] += [449_123.25, 5_411_804.5, 341.75]
    move = settled(away, [None] * len(away), "known", {"applied_scale": 2.0})
    near = move.poses(away)
    assert np.linalg.norm(near[:, :, 3].mean(axis=0)) < 1e-8
    gaps = np.diff(near[:, :, 3].astype(np.float32), axis=0) - np.diff(truth[:, :, 3], axis=0)
    assert np.abs(gaps).max() < 1e-6, "in float32 the original would be off by half a metre"
    assert np.abs(np.diff(away[:, :, 3].astype(np.float32), axis=0)).min() == 0.0
    # nerfstudio's rule: world = scale * (transform @ original).
    applied = np.array(move.notes["applied_transform"])
    original = away[:, :, 3] / 2.0
    np.testing.assert_allclose(
        2.0 * (original @ applied[:, :3].T + applied[:, 3]), near[:, :, 3], atol=1e-8
    )
    (told,) = move.warnings
    assert "from the world's origin" in told


def test_a_world_around_its_origin_is_left_where_it_is() -> None:
    truth = walked()
    truth[:, :, 3] += [20.0, 5.0, 1.0]
    move = settled(truth, [None] * len(truth), "known", {"a": 1})
    np.testing.assert_array_equal(move.poses(truth), truth)
    assert (move.notes, move.warnings) == ({"a": 1}, [])
