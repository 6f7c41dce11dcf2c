"""Which way is up in a world that brings no gravity."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.captures.posed import other_axis_up
from pipelines.sample.film import phone_camera, walk
from pipelines.sample.scene import pose_matrix

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
