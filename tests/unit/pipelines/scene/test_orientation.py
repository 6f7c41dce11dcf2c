"""Gravity and normalisation, on cameras whose true frame is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.scene.orientation import (
    Similarity,
    find_up,
    normalise,
    opengl_from_opencv,
    rotation_to_z,
)


def random_rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def look_at(center: np.ndarray, target: np.ndarray, roll_deg: float = 0.0) -> np.ndarray:
    """An OpenGL camera [3, 4] in a +Z-up world with a level X axis, then rolled."""
    z = (center - target) / np.linalg.norm(center - target)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    return np.stack([c * x + s * y, c * y - s * x, z, center], axis=1)


def orbit(num: int = 24, height: float = 1.5, arc_deg: float = 360.0) -> np.ndarray:
    """Cameras on an arc of radius 2 that look down at the point (1, 2, 0)."""
    target = np.array([1.0, 2.0, 0.0])
    angles = np.radians(np.linspace(0.0, arc_deg, num, endpoint=False))
    rings = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(num, height)], axis=1)
    return np.stack([look_at(target + ring, target) for ring in rings])


def moved(cameras: np.ndarray, seed: int) -> np.ndarray:
    """The cameras in a frame turned, shifted and scaled at random."""
    similarity = Similarity(random_rotation(seed), np.array([5.0, -3.0, 2.0]), 3.7)
    return similarity.apply_to_cameras(cameras)


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("arc_deg", [360.0, 90.0])
def test_turned_cameras_that_look_down_come_back_upright(seed: int, arc_deg: float) -> None:
    truth = orbit(arc_deg=arc_deg)
    found = normalise(moved(truth, seed))
    assert found.up_from == "vertical"
    back = found.similarity.apply_to_cameras(moved(truth, seed))
    np.testing.assert_allclose(back[:, 2, :3], truth[:, 2, :3], atol=1e-9)


def test_the_focus_becomes_the_origin_and_cameras_fill_the_unit_cube() -> None:
    cameras = moved(orbit(), 3)
    found = normalise(cameras)
    assert found.centered_on == "focus"
    focus = Similarity(random_rotation(3), np.array([5.0, -3.0, 2.0]), 3.7).apply_to_points(
        np.array([1.0, 2.0, 0.0])
    )
    np.testing.assert_allclose(found.similarity.apply_to_points(focus), 0.0, atol=1e-9)
    back = found.similarity.apply_to_cameras(cameras)
    assert np.abs(back[:, :, 3]).max() == pytest.approx(1.0)
    np.testing.assert_allclose(
        back[:, :, :3] @ back[:, :, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(24, 0), atol=1e-9
    )


def test_a_few_rolled_cameras_do_not_tilt_the_rest() -> None:
    truth = orbit(num=20)
    target = np.array([1.0, 2.0, 0.0])
    for index in (2, 9, 15):
        truth[index] = look_at(truth[index][:, 3], target, roll_deg=90.0)
    up, found_by = find_up(moved(truth, 1))
    assert found_by == "vertical"
    assert angle_deg(up, random_rotation(1) @ [0, 0, 1]) < 0.5


def rolled(cameras: np.ndarray, roll_deg: float, which: slice = slice(None)) -> np.ndarray:
    """Some of the cameras turned about what they look along."""
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    turned = cameras.copy()
    turned[which, :, :2] = cameras[which, :, :2] @ np.array([[c, -s], [s, c]])
    return turned


@pytest.mark.parametrize("roll_deg", [90.0, -90.0])
@pytest.mark.parametrize("arc_deg", [360.0, 200.0])
def test_photos_that_lost_how_they_were_held_stand_all_the_same(
    arc_deg: float, roll_deg: float
) -> None:
    truth = rolled(orbit(arc_deg=arc_deg), roll_deg)
    rng = np.random.default_rng(1)
    shaky = truth.copy()
    shaky[:, :, :3] = [rotation_about(rng.normal(size=3) * 0.05) @ pose[:, :3] for pose in truth]
    found = normalise(moved(shaky, 3))
    assert found.up_from == "sideways"
    back = found.similarity.apply_to_cameras(moved(truth, 3))
    assert np.abs(back[:, 2, 1]).max() < 0.05, "Y axes are level"
    assert np.sign(back[:, 2, 0].mean()) == np.sign(truth[:, 2, 0].mean())
    assert back[:, 2, 2].mean() > 0.5, "they look down"


def test_a_walk_around_at_the_things_height_is_on_its_side_where_it_goes_all_round() -> None:
    """The X axes are parallel, as those of a camera that is tipped over a roof are."""
    up, found_by = find_up(moved(rolled(orbit(height=0.0), -90.0), 6))
    assert found_by == "sideways"
    assert angle_deg(up, random_rotation(6) @ [0, 0, 1]) < 1e-3
    over_it = [np.array([0.0, np.cos(a), np.sin(a)]) for a in np.radians(np.linspace(10, 80, 9))]
    arc = np.stack([look_at(2.0 * place, np.zeros(3)) for place in over_it])
    overhead = rolled(arc, 180.0, slice(2, 5))
    for tipped in (arc, overhead, rolled(orbit(height=0.0, arc_deg=150.0), -90.0)):
        assert find_up(moved(tipped, 6))[1] == "camera_up"


def test_what_may_be_held_either_way_is_taken_for_upright() -> None:
    half = rolled(orbit(), 90.0, slice(0, None, 2))
    assert find_up(moved(half, 2))[1] == "vertical"
    few = rolled(orbit(), 90.0, slice(0, None, 5))
    up, found_by = find_up(moved(few, 2))
    assert found_by == "vertical"
    assert angle_deg(up, random_rotation(2) @ [0, 0, 1]) < 2.0


@pytest.mark.parametrize("share", [0.3, 0.4, 0.5, 0.6, 0.7])
@pytest.mark.parametrize(("arc_deg", "height"), [(330.0, 0.7), (200.0, 0.7), (330.0, 0.25)])
@pytest.mark.parametrize("clockwise", [1.0, -1.0])
def test_a_phone_that_is_turned_while_it_films_leaves_the_world_upright(
    share: float, arc_deg: float, height: float, clockwise: float
) -> None:
    rng = np.random.default_rng(4)
    truth = orbit(90, height, arc_deg)
    shaken = [rotation_about(rng.normal(scale=0.03, size=3)) @ pose for pose in truth]
    cameras = np.stack(shaken)
    turned = rolled(cameras, 90.0 * clockwise, slice(0, round(share * 90)))
    up, found_by = find_up(turned)
    assert angle_deg(up, np.array([0.0, 0.0, 1.0])) < 2.0, found_by
    every_second = rolled(cameras, 90.0 * clockwise, slice(0, None, 2))
    up, found_by = find_up(every_second)
    assert found_by == "either_way"
    assert angle_deg(up, np.array([0.0, 0.0, 1.0])) < 2.0


def test_shaky_hands_of_whoever_holds_it_upright_are_no_turning() -> None:
    rng = np.random.default_rng(5)
    for _ in range(60):
        arc_deg, height = rng.uniform(60.0, 360.0), rng.uniform(0.1, 3.0)
        cameras = np.stack(
            [
                rotation_about(rng.normal(scale=0.08, size=3)) @ pose
                for pose in orbit(40, height, arc_deg)
            ]
        )
        assert find_up(cameras)[1] != "either_way"


def rotation_about(vector: np.ndarray) -> np.ndarray:
    """By the vector's length, in radians, about it."""
    return Rotation.from_rotvec(vector).as_matrix()


def test_shaky_hands_cost_little() -> None:
    rng = np.random.default_rng(0)
    target = np.array([1.0, 2.0, 0.0])
    truth = np.stack([look_at(pose[:, 3], target, rng.normal(scale=4.0)) for pose in orbit(num=60)])
    up, _ = find_up(moved(truth, 2))
    assert angle_deg(up, random_rotation(2) @ [0, 0, 1]) < 2.0


def test_cameras_that_look_straight_down_know_up_by_their_gaze() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    cameras = []
    for a in angles:
        x, z = np.array([np.cos(a), np.sin(a), 0.0]), np.array([0.0, 0.0, 1.0])
        cameras.append(np.stack([x, np.cross(z, x), z, [np.cos(a), np.sin(a), 3.0]], axis=1))
    up, _ = find_up(moved(np.stack(cameras), 4))
    assert angle_deg(up, random_rotation(4) @ [0, 0, 1]) < 1e-3


def test_parallel_cameras_fall_back_to_their_own_up() -> None:
    """Cameras that slide sideways without turning: X axes alone leave up undetermined."""
    cameras = np.stack(
        [look_at(np.array([x, -3.0, 1.0]), np.array([x, 0.0, 1.0])) for x in np.linspace(-1, 1, 9)]
    )
    up, found_by = find_up(moved(cameras, 5))
    assert found_by == "camera_up"
    assert angle_deg(up, random_rotation(5) @ [0, 0, 1]) < 1e-3
    found = normalise(moved(cameras, 5))
    assert found.centered_on == "centers"
    back = found.similarity.apply_to_cameras(moved(cameras, 5))
    np.testing.assert_allclose(back[:, :, 3].mean(axis=0), 0.0, atol=1e-9)


def over_a_field(num: int = 12, turned: tuple[int, ...] = ()) -> np.ndarray:
    """Cameras [num, 3, 4] that look straight down from height 3, side by side, all the same way but
    for those that are turned by half."""
    cameras = []
    for index in range(num):
        x = np.array([-1.0 if index in turned else 1.0, 0.0, 0.0])
        z = np.array([0.0, 0.0, 1.0])
        cameras.append(np.stack([x, np.cross(z, x), z, [index % 3, index // 3, 3.0]], axis=1))
    return np.stack(cameras)


def test_a_field_is_no_wall_where_the_drone_says_so() -> None:
    cameras = moved(over_a_field(), 7)
    down = [(0.0, 0.0, 1.0)] * 12
    up, found_by = find_up(cameras)
    assert (found_by, round(angle_deg(up, random_rotation(7) @ [0, 0, 1]))) == ("camera_up", 90)
    found = normalise(cameras, measured=down)
    assert found.up_from == "measured"
    back = found.similarity.apply_to_cameras(cameras)
    np.testing.assert_allclose(back[:, 2, 2], 1.0, atol=1e-9)
    np.testing.assert_allclose(back[:, 2, 3], back[0, 2, 3], atol=1e-9)


@pytest.mark.parametrize("back", [(3, 4, 5, 9, 10, 11), (4, 5, 6, 7), (0, 1, 2)])
def test_rows_that_are_flown_to_and_fro_are_over_a_field(back: tuple[int, ...]) -> None:
    cameras = moved(over_a_field(turned=back), 8)
    up, _ = find_up(cameras)
    assert angle_deg(up, random_rotation(8) @ [0, 0, 1]) < 1e-3


def test_one_picture_of_a_wall_upside_down_makes_it_no_field() -> None:
    up, found_by = find_up(moved(over_a_field(turned=(5,)), 8))
    assert found_by == "camera_up"
    assert angle_deg(up, random_rotation(8) @ [0, 1, 0]) < 1e-3


@pytest.mark.parametrize(
    ("known", "noise", "found_by"),
    [
        (range(24), 0.0, "measured"),
        (range(0, 24, 4), 0.03, "measured"),
        (range(5), 0.0, "vertical"),  # too few
        (range(24), 0.6, "vertical"),  # they contradict one another
    ],
)
def test_what_devices_measured_is_believed_where_they_agree(
    known: range, noise: float, found_by: str
) -> None:
    rng = np.random.default_rng(0)
    truth = orbit()
    noisy = truth[:, 2, :3] + rng.normal(scale=noise, size=(24, 3))
    noisy /= np.linalg.norm(noisy, axis=1)[:, None]
    measured = [noisy[index] if index in known else None for index in range(24)]
    up, told = find_up(moved(truth, 3), measured)
    assert told == found_by
    assert angle_deg(up, random_rotation(3) @ [0, 0, 1]) < 2.0


def test_directions_in_axes_of_another_camera_are_not_believed() -> None:
    truth = orbit()
    aside = truth[:, 2, [1, 0, 2]]  # as if the picture lay on its side
    _, told = find_up(moved(truth, 4), list(aside))
    assert told == "vertical"


def test_one_wrong_direction_in_five_is_left_out() -> None:
    truth = orbit(num=20)
    measured = truth[:, 2, :3].copy()
    measured[::5] = [1.0, 0.0, 0.0]
    up, told = find_up(moved(truth, 5), list(measured))
    assert told == "measured"
    assert angle_deg(up, random_rotation(5) @ [0, 0, 1]) < 1e-3


def test_without_orientation_axes_stay_parallel() -> None:
    found = normalise(moved(orbit(), 6), orient=False)
    np.testing.assert_allclose(found.similarity.rotation, np.eye(3), atol=1e-12)
    assert found.up_from == "none"


def test_cameras_in_one_point_keep_their_scale() -> None:
    cameras = orbit()
    cameras[:, :, 3] = 4.0
    assert normalise(cameras).similarity.scale == 1.0


def test_no_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="no cameras"):
        find_up(np.zeros((0, 3, 4)))


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0.0, -0.8]])
def test_the_rotation_to_z_is_a_rotation_to_z(up: list[float]) -> None:
    rotation = rotation_to_z(np.array(up, float))
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_opencv_cameras_turn_about_their_own_x_axis() -> None:
    """OpenCV's +Z is the gaze and +Y points down; ours look along -Z with +Y up."""
    pose = np.concatenate([random_rotation(7), [[1.0], [2.0], [3.0]]], axis=1)[None]
    ours = opengl_from_opencv(pose)[0]
    np.testing.assert_array_equal(ours[:, 0], pose[0, :, 0])
    np.testing.assert_array_equal(ours[:, 1], -pose[0, :, 1])
    np.testing.assert_array_equal(-ours[:, 2], pose[0, :, 2])
    np.testing.assert_array_equal(ours[:, 3], pose[0, :, 3])
