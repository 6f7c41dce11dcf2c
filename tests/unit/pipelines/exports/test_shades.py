"""Depth and normals of exact views, as numbers and as pictures."""

from __future__ import annotations

import numpy as np

from pipelines.exports import shades
from pipelines.scene.depth_views import Pinhole
from tests.unit.pipelines.scene.synthetic_views import look_at, sphere_view

CENTER = np.array([3.0, -1.0, 0.5])
LENS = Pinhole(97, 81, 100.0, 100.0, 48.5, 40.5)
POSE = look_at(CENTER + np.array([2.0, 2.0, 1.5]), CENTER)


def test_normals_of_a_ball_point_away_from_its_middle() -> None:
    view = sphere_view(LENS, POSE, CENTER)
    normals = shades.normals_of(view)
    known = np.asarray(normals.any(axis=-1))
    assert known.sum() > 0.8 * (view.z_depth > 0).sum()
    assert not known[view.z_depth == 0].any()
    outward = (view.points()[known] - CENTER) @ POSE[:, :3]
    assert (normals[known] * outward).sum(axis=-1).min() > 0.97
    assert (normals[known][:, 2] > 0).all(), "to the camera"
    np.testing.assert_allclose(np.linalg.norm(normals[known], axis=-1), 1.0, atol=1e-5)


def test_the_picture_of_normals_is_red_to_the_right_green_above_and_grey_beside() -> None:
    view = sphere_view(LENS, POSE, CENTER)
    picture = shades.normals_picture(shades.normals_of(view)).astype(int)
    rows, columns = np.nonzero(view.z_depth)
    left, right, top, bottom = columns.min(), columns.max(), rows.min(), rows.max()
    middle_row, middle_column = (top + bottom) // 2, (left + right) // 2
    assert np.abs(picture[middle_row, middle_column] - [128, 128, 255]).max() < 6
    assert picture[middle_row, right - 8, 0] > 170 > 85 > picture[middle_row, left + 8, 0]
    assert picture[top + 8, middle_column, 1] > 170 > 85 > picture[bottom - 8, middle_column, 1]
    assert (picture[0, 0] == 60).all()


def test_near_is_bright_far_is_dark_and_the_same_depth_the_same_colour() -> None:
    z = np.array([[0.0, 1.0, 2.0, 4.0, 8.0, 100.0]])
    picture = shades.depth_picture(z, (1.0, 8.0)).astype(int)
    assert (picture[0, 0] == 60).all(), "unknown"
    brightness = picture[0, 1:].sum(axis=-1)
    assert (np.diff(brightness[:4]) < 0).all()
    np.testing.assert_array_equal(picture[0, 5], picture[0, 4])
    alone = shades.depth_picture(np.array([[2.0]]), (1.0, 8.0))
    np.testing.assert_array_equal(alone[0, 0], picture[0, 2])
    assert (shades.depth_picture(z, None) == 60).all()
    assert shades.depth_range(np.zeros((3, 3))) is None


def test_accumulation_is_grey() -> None:
    picture = shades.accumulation_picture(np.array([[0.0, 0.5, 1.0, 1.2]]))
    np.testing.assert_array_equal(picture[0, :, 0], [0, 128, 255, 255])
    assert (picture == picture[..., :1]).all()
