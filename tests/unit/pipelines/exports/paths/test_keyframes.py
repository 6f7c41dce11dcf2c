"""Flights through keyframes, captured poses and nerfstudio's files, and spirals."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pipelines.exports.paths.flight import make_path
from pipelines.exports.paths.options import PathOptions
from pipelines.scene.rotations import rotation_matrices
from tests.unit.pipelines.exports.paths.test_orbit import FOCUS, arc, posed
from tests.unit.pipelines.scene.synthetic_views import look_at

CORNERS = ((0.0, 0.0, 1.0), (2.0, 0.0, 1.0), (2.0, 3.0, 1.0), (0.0, 3.0, 2.0))


def keyframes(*, each: dict[str, Any] | None = None, **options: Any) -> PathOptions:
    """A path through the corners that looks at (1, 1.5, 0)."""
    frames = [{"position": p, "look_at": (1.0, 1.5, 0.0), **(each or {})} for p in CORNERS]
    return PathOptions.model_validate({"path": "keyframes", "keyframes": frames, **options})


def test_the_flight_begins_ends_and_passes_where_it_should() -> None:
    flight = make_path(keyframes(), [], 31)
    for index, corner in zip((0, 10, 20, 30), CORNERS, strict=True):
        np.testing.assert_allclose(flight.poses[index, :, 3], corner, atol=1e-9)
        exact = look_at(np.asarray(corner), np.array([1.0, 1.5, 0.0]))
        np.testing.assert_allclose(flight.poses[index], exact, atol=1e-9)
    assert flight.fov_deg is None
    steps = np.linalg.norm(np.diff(flight.poses[:, :, 3], axis=0), axis=1)
    assert steps.max() < 3.0 * np.median(steps), "no jump"


def test_seconds_and_speed_say_when_each_keyframe_is_passed() -> None:
    options = keyframes()
    frames = [frame.model_dump() for frame in options.keyframes]
    frames[1]["seconds"], frames[2]["speed"], frames[3]["seconds"] = 1.0, 1.5, 3.0
    timed = PathOptions.model_validate({"path": "keyframes", "keyframes": frames})
    assert timed.durations_s() == [1.0, 2.0, 3.0]
    path = make_path(timed, [], 61).poses
    for index, corner in zip((0, 10, 30, 60), CORNERS, strict=True):
        np.testing.assert_allclose(path[index, :, 3], corner, atol=1e-9)


def test_the_way_is_smooth_unless_tension_stops_it_at_each_keyframe() -> None:
    def turns(tension: float) -> np.ndarray:
        path = make_path(keyframes(tension=tension), [], 3001).poses[:, :, 3]
        velocity = np.diff(path, axis=0) * 1000
        return np.linalg.norm(velocity[[1000, 2000]] - velocity[[999, 1999]], axis=1)

    assert turns(0.0).max() < 0.05
    path = make_path(keyframes(tension=1.0), [], 3001).poses[:, :, 3]
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * 1000
    assert speed[[0, 999, 1000, 1999, 2000, 2999]].max() < 0.05
    assert speed[[500, 1500, 2500]].min() > 2.0


def test_a_loop_comes_back_without_a_stop() -> None:
    flight = make_path(keyframes(loop=True), [], 4000).poses
    for index, corner in zip((0, 1000, 2000, 3000), CORNERS, strict=True):
        np.testing.assert_allclose(flight[index, :, 3], corner, atol=1e-9)
    round_trip = np.concatenate((flight, flight[:2]))
    velocity = np.diff(round_trip[:, :, 3], axis=0) * 1000
    assert np.linalg.norm(velocity[4000] - velocity[3999]) < 0.05
    turning = np.diff(round_trip[:, :, :3], axis=0) * 1000
    assert np.abs(turning[4000] - turning[3999]).max() < 0.05


def test_a_whole_turn_in_place_goes_on_turning() -> None:
    """Quaternions of a whole turn end at the other sign of the first."""
    angles = np.radians([0.0, 90.0, 180.0, 270.0])
    frames = [
        {"position": (0, 0, 1), "rotation": (np.cos(a / 2), 0.0, 0.0, np.sin(a / 2))}
        for a in angles
    ]
    options = PathOptions.model_validate({"path": "keyframes", "keyframes": frames, "loop": True})
    path = make_path(options, [], 400).poses
    wanted = rotation_matrices(np.array([[np.cos(a / 2), 0, 0, np.sin(a / 2)] for a in angles]))
    np.testing.assert_allclose(path[::100, :, :3], wanted, atol=1e-9)
    heading = np.unwrap(np.arctan2(path[:, 1, 0], path[:, 0, 0]))
    steps = np.degrees(np.diff(heading))
    assert steps.min() > 0.6
    assert steps.max() < 1.3


def test_the_field_of_view_goes_from_one_to_the_other() -> None:
    options = keyframes(each={"fov_deg": 60.0})
    frames = [frame.model_dump() for frame in options.keyframes]
    frames[1]["fov_deg"] = 20.0
    flight = make_path(
        PathOptions.model_validate({"path": "keyframes", "keyframes": frames}), [], 31
    )
    assert flight.fov_deg is not None
    np.testing.assert_allclose(flight.fov_deg[[0, 10, 20, 30]], [60.0, 20.0, 60.0, 60.0])
    assert (np.diff(flight.fov_deg[:11]) < 0).all()
    assert flight.fov_deg.max() < 75.0


def test_interpolate_passes_every_captured_pose_in_the_order_of_the_walk() -> None:
    poses = arc(7)
    shuffled = [posed(poses)[index] for index in (3, 0, 6, 1, 5, 2, 4)]
    flight = make_path(PathOptions.model_validate({"path": "interpolate"}), shuffled, 61)
    found = flight.poses[::10]
    if np.linalg.norm(found[0, :, 3] - poses[0, :, 3]) > 0.1:
        found = found[::-1]
    np.testing.assert_allclose(found, poses, atol=1e-6)


def test_a_spiral_stays_before_what_is_looked_at() -> None:
    options = PathOptions.model_validate({"path": "spiral", "spiral": {"radius": 0.2, "turns": 3}})
    path = make_path(options, posed(arc(9)), 300).poses
    middle = arc(9)[4]
    distance = float(np.linalg.norm(middle[:, 3] - FOCUS))
    away = (path[:, :, 3] - middle[:, 3]) @ middle[:, :3]
    np.testing.assert_allclose(np.hypot(away[:, 0], away[:, 1]), 0.2 * distance, atol=1e-6)
    turned = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert turned[-1] - turned[0] == pytest.approx(6 * np.pi * 299 / 300)
    to_focus = FOCUS - path[:, :, 3]
    aimed = (-path[:, :, 2] * to_focus).sum(1) / np.linalg.norm(to_focus, axis=1)
    assert aimed.min() > np.cos(np.radians(1.0))


def nerfstudio_file(**changes: Any) -> dict[str, Any]:
    """As its viewer writes it, with keys that nobody uses here."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3] = arc(5)
    frames = [
        {"camera_to_world": pose.ravel().tolist(), "fov": 50.0 + index, "aspect": 1.5}
        for index, pose in enumerate(poses)
    ]
    shown = [
        {
            "matrix": json.dumps(pose.ravel().tolist()),
            "fov": 50.0,
            "aspect": 1.5,
            "override_transition_enabled": index == 1,
            "override_transition_sec": 1.0 if index == 1 else None,
        }
        for index, pose in enumerate(poses[:3])
    ]
    return {
        **{"camera_type": "perspective", "render_height": 240, "render_width": 360},
        **{"fps": 30, "seconds": 4.0, "is_cycle": False, "smoothness_value": 0.5},
        **{"default_fov": 50, "default_transition_sec": 2.0},
        "keyframes": shown,
        "camera_path": frames,
        **changes,
    }


def test_nerfstudios_file_is_taken_as_it_is() -> None:
    options = PathOptions.model_validate({"path": "camera_path", "camera_path": nerfstudio_file()})
    assert options.camera_path is not None
    assert options.camera_path.frames() == 5
    flight = make_path(options, [], options.camera_path.frames())
    np.testing.assert_allclose(flight.poses, arc(5), atol=1e-9)
    assert flight.fov_deg is not None
    np.testing.assert_allclose(flight.fov_deg, [50.0, 51.0, 52.0, 53.0, 54.0])
    stored = json.loads(json.dumps(options.model_dump(mode="json")))
    assert PathOptions.model_validate(stored) == options


def test_its_keyframes_are_expanded_where_it_has_no_frames() -> None:
    file = nerfstudio_file(camera_path=[])
    options = PathOptions.model_validate({"path": "camera_path", "camera_path": file})
    assert options.camera_path is not None
    assert options.camera_path.frames() == 90, "1 s, then 2 s, at 30 frames a second"
    path = make_path(options, [], 91).poses
    np.testing.assert_allclose(path[[0, 30, 90]], arc(5)[:3], atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"camera_type": "omni"}, "'perspective'"),
        ({"render_height": 0}, "greater than or equal to 16"),
        ({"render_width": 100_000}, "less than or equal to 8192"),
        ({"camera_path": [], "keyframes": []}, "at least 2 keyframes"),
        ({"camera_path": [{"camera_to_world": [1.0] * 12, "fov": 50}]}, "at least 16"),
        (
            {"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 0}]},
            "or equal to 1",
        ),
        ({"camera_path": [{"camera_to_world": [1.0] * 16, "fov": 50}]}, "without scale"),
        ({"camera_path": [{"camera_to_world": [2.0, *[0.0] * 15], "fov": 50}]}, "without scale"),
        (
            {
                "camera_path": [
                    {"camera_to_world": np.diag([1.0, 1, -1, 1]).ravel().tolist(), "fov": 50}
                ]
            },
            "without scale",
        ),
        ({"camera_path": [{"camera_to_world": ["x"] * 16, "fov": 9}]}, "valid number"),
        ({"camera_path": [{"camera_to_world": [float("nan")] * 16, "fov": 9}]}, "finite"),
        ({"camera_path": [{"camera_to_world": "[1, 2", "fov": 9}]}, "no list in JSON"),
        ({"fps": 0}, "greater than or equal to 1"),
        ({"default_transition_sec": 1e-300}, "greater than or equal to 0.001"),
    ],
)
def test_files_that_cannot_be_flown_are_refused(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError) as caught:
        PathOptions.model_validate({"path": "camera_path", "camera_path": nerfstudio_file(**wrong)})
    assert told in str(caught.value)
