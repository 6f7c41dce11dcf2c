"""The circle around what the cameras look at, and the catalogue it stands in."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.errors import ExportError
from pipelines.exports.paths.catalogue import PATHS
from pipelines.exports.paths.flight import make_path
from pipelines.exports.paths.options import PathOptions
from pipelines.exports.paths.orbit import orbit
from pipelines.scene.cameras_file import PosedImage
from tests.unit.pipelines.scene.synthetic_views import look_at, ring

FOCUS = np.array([3.0, -1.0, 0.5])


def posed(poses: np.ndarray) -> list[PosedImage]:
    return [
        PosedImage(f"{index}.jpg", 0, tuple(tuple(map(float, row)) for row in pose))
        for index, pose in enumerate(poses)
    ]


def arc(num: int = 12) -> np.ndarray:
    """Cameras on a third of a circle of radius 2 around the focus, 0.8 above it."""
    angles = np.linspace(0.0, 2.1, num)
    places = FOCUS + np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(num, 0.8)], -1)
    return np.stack([look_at(place, FOCUS) for place in places])


def test_an_orbit_goes_once_round_what_the_cameras_look_at() -> None:
    path = orbit(posed(arc()), PathOptions(), 36).poses
    away = path[:, :, 3] - FOCUS
    assert np.allclose(np.linalg.norm(away, axis=1), np.hypot(2.0, 0.8), atol=1e-6)
    assert np.allclose(away[:, 2], 0.8, atol=1e-6)
    turned = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert np.allclose(np.diff(turned), 2 * np.pi / 36)
    assert abs(turned[0] - 1.05) < 0.05  # it starts in the middle of the captured arc


def test_an_orbit_looks_at_the_focus_and_is_level() -> None:
    path = orbit(posed(arc()), PathOptions(), 24).poses
    gaze = -path[:, :, 2]
    to_focus = FOCUS - path[:, :, 3]
    assert np.allclose((gaze * to_focus).sum(1), np.linalg.norm(to_focus, axis=1))
    assert np.allclose(path[:, 2, 0], 0.0)
    assert (path[:, 2, 1] > 0).all()
    turns = path[:, :, :3]
    assert np.allclose(turns.transpose(0, 2, 1) @ turns, np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(turns), 1.0)


def test_cameras_that_look_down_have_an_orbit_that_does_not_spin() -> None:
    places = FOCUS + np.array([[0.1, 0.0, 2.0], [-0.1, 0.05, 2.0], [0.0, -0.1, 2.0], [0.9, 0, 1.8]])
    poses = np.stack([look_at(place, FOCUS) for place in places])
    path = orbit(posed(poses), PathOptions(), 8).poses
    assert np.isfinite(path).all()
    assert np.linalg.norm(path[:, :2, 3] - FOCUS[:2], axis=1).min() > 0.3


def test_a_capture_without_a_focus_has_no_orbit() -> None:
    outward = ring(12, np.zeros(3))
    outward[:, :, 0] *= -1.0
    outward[:, :, 2] *= -1.0
    with pytest.raises(ExportError) as caught:
        orbit(posed(outward), PathOptions(), 10)
    assert caught.value.code == "no_focus"
    assert "video.path" in caught.value.hint


@pytest.mark.parametrize("name", PATHS)
def test_every_path_of_the_catalogue_gives_as_many_poses_as_asked_for(name: str) -> None:
    frames = [
        {"position": [0, 0, 1], "look_at": [1, 0, 0]},
        {"position": [0, 1, 1], "look_at": FOCUS.tolist()},
    ]
    file = {
        **{"render_height": 64, "render_width": 64, "fps": 17},
        "keyframes": [{"matrix": np.eye(4).ravel().tolist(), "fov": 50}] * 2,
    }
    options = PathOptions.model_validate({"path": name, "keyframes": frames, "camera_path": file})
    flight = make_path(options, posed(arc()), 17)
    path = flight.poses
    assert path.shape == (17, 3, 4)
    assert np.allclose(path[:, :, :3].transpose(0, 2, 1) @ path[:, :, :3], np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(path[:, :, :3]), 1.0)
    assert flight.fov_deg is None or flight.fov_deg.shape == (17,)


def test_an_orbit_of_another_height_distance_and_tilt() -> None:
    wanted = PathOptions.model_validate(
        {"orbit": {"height": -0.6, "distance": 2.0, "tilt_deg": 20.0, "turns": 0.5}}
    )
    path = orbit(posed(arc()), wanted, 10).poses
    away = path[:, :, 3] - FOCUS
    distance = 2.0 * np.hypot(2.0, 0.8)
    assert np.allclose(np.linalg.norm(away, axis=1), distance)
    assert np.allclose(away[:, 2], -0.6 * distance)
    turned = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert np.allclose(np.diff(turned), np.pi / 10)
    gaze, level = -path[:, :, 2], path[:, 2, 0]
    up = np.degrees(np.arcsin(gaze[:, 2]))
    straight = np.degrees(np.arcsin(0.6))
    assert np.allclose(up, straight + 20.0), "above what it circles"
    assert np.allclose(level, 0.0)
