"""Views cut from a panorama show what plain cameras in their places show."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene.panoramas import (
    LEVEL,
    WHOLE,
    cut_views,
    is_whole,
    pano_from_views,
    view_lens,
    world_from_views,
)
from tests.lens_films import directions, level_pose, panorama_camera, picture_of

AXES = np.diag([1.0, -1.0, -1.0])


def test_views_show_what_cameras_of_their_poses_see() -> None:
    """Rendered anew through the view's lens and pose, by a tracer that knows no panorama."""
    pose, camera = level_pose(0.3), panorama_camera(512)
    views = cut_views(picture_of(camera, pose, side=2), WHOLE)
    opencv = np.column_stack([pose[:, :3] @ AXES, pose[:, 3]])
    lens = view_lens(camera.width)
    for view, seen_from in zip(views, world_from_views(opencv, WHOLE), strict=True):
        turned = np.column_stack([seen_from[:, :3] @ AXES, seen_from[:, 3]])
        true = picture_of(lens, turned, side=2).astype(float)[2:-2, 2:-2]
        shifted = {
            (dx, dy): np.abs(np.roll(view, (dy, dx), (0, 1))[2:-2, 2:-2] - true).mean()
            for dx in (-1, 0, 1)
            for dy in (-1, 0, 1)
        }
        assert min(shifted, key=lambda shift: shifted[shift]) == (0, 0), shifted


def test_views_are_cut_without_a_seam_and_up_to_the_poles() -> None:
    """A panorama whose colours say which way a pixel looks gives views whose pixels agree."""
    camera = panorama_camera(720)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = directions(camera, np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1))
    painted = np.rint(127.5 + 127.0 * rays).astype(np.uint8)
    views = cut_views(painted.reshape(camera.height, camera.width, 3), WHOLE)
    lens = view_lens(camera.width)
    y, x = np.mgrid[0 : lens.height, 0 : lens.width]
    local = directions(lens, np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1))
    for view, rotation in zip(views, pano_from_views(WHOLE), strict=True):
        wanted = 127.5 + 127.0 * local @ rotation.T
        assert np.abs(view.reshape(-1, 3) - wanted).max() < 1.6


def test_views_look_ahead_right_behind_left_up_and_down() -> None:
    axes = [tuple(np.rint(rotation[:, 2])) for rotation in pano_from_views(WHOLE)]
    assert axes == [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, -1, 0), (0, 1, 0)]
    assert len(pano_from_views(LEVEL)) == 4
    for rotation in pano_from_views(WHOLE):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_whole_sphere_is_twice_as_wide_as_high() -> None:
    sizes = [(5760, 2880), (5761, 2880), (3840, 3840), (3840, 2160), (0, 0)]
    assert [is_whole(*size) for size in sizes] == [True, True, False, False, False]
