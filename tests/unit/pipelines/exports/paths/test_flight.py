"""The flight of the video: its way, its lens, its preview."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.exports.kinds.video import VideoOptions
from pipelines.exports.paths.flight import (
    Flight,
    filmed_path,
    held_upright,
    lens_of_size,
    looking_at,
    make_path,
    preview_index,
    typical_lens,
)
from pipelines.exports.paths.options import PathOptions
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.trained_scene import TrainedScene
from pipelines.workspace import Workspace
from tests.unit.pipelines.scene.synthetic_views import look_at, ring


def test_the_path_follows_the_walk(trained_job: Workspace) -> None:
    images = TrainedScene.load(trained_job.stage("train") / "model.zip").cameras.images
    path = make_path(PathOptions(), tuple(reversed(images)), 24).poses
    first = np.asarray(images[0].world_from_camera)[:, 3]
    last = np.asarray(images[-1].world_from_camera)[:, 3]
    extent = np.linalg.norm(last - first)
    assert np.linalg.norm(path[0][:, 3] - first) < 0.1 * extent
    assert np.linalg.norm(path[-1][:, 3] - last) < 0.1 * extent


def test_the_preview_looks_at_the_subject_from_where_someone_stood() -> None:
    poses = ring(30, np.zeros(3))[::3]
    images = [
        PosedImage(f"{index}.jpg", 0, tuple(tuple(map(float, row)) for row in pose))
        for index, pose in enumerate(poses)
    ]
    path = np.repeat(poses, 2, axis=0)
    aside = look_at(path[9, :, 3], np.array([1.5, 0.0, 0.0]))
    path[:] = aside
    path[9] = poses[4]
    assert preview_index(path, images) == 9


def test_the_typical_lens_is_centred_and_of_the_most_common_size() -> None:
    wide = Intrinsics(640, 480, 500.0, 500.0, 310.0, 250.0)
    longer = dataclasses.replace(wide, fl_x=520.0)
    other = Intrinsics(480, 640, 900.0, 900.0, 240.0, 320.0)
    lens = typical_lens([other, wide, longer])
    assert (lens.width, lens.height, lens.cx, lens.cy) == (640, 480, 320.0, 240.0)
    assert lens.fl_x == 510.0


@pytest.mark.parametrize("quarter", [0, 1, 3])
def test_pictures_on_their_side_are_shown_upright(quarter: int) -> None:
    """The same rays, in a picture turned by so many quarters."""
    upright = np.array(ring(8, np.zeros(3)))
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarter)
    stored = upright.copy()
    stored[:, :, :2] = upright[:, :, :2] @ turn
    size = (40, 30) if quarter == 0 else (30, 40)
    lens = Intrinsics(*size, 33.0, 35.0, size[0] / 2, size[1] / 2)
    images = [
        PosedImage(f"{index}.jpg", 0, tuple(tuple(map(float, row)) for row in pose))
        for index, pose in enumerate(stored)
    ]
    shown, seen_by = held_upright(images, lens)
    np.testing.assert_allclose([image.world_from_camera for image in shown], upright, atol=1e-12)
    assert (seen_by.width, seen_by.height) == (40, 30)

    def rays(one: Intrinsics, pose: np.ndarray) -> np.ndarray:
        return Pinhole.of(one, 40).directions() @ pose[:, :3].T

    before, after = rays(lens, stored[2]), rays(seen_by, upright[2])
    np.testing.assert_allclose(np.rot90(before, quarter), after, atol=1e-12)


@pytest.mark.parametrize("quarters", [(0, 1), (1, 0), (0, 2), (1, 3), (0, 1, 2, 3)])
def test_each_picture_is_turned_by_its_own_quarter(quarters: tuple[int, ...]) -> None:
    """A phone that is turned on the way: the film stays level."""
    upright = np.array(ring(12, np.zeros(3)))
    stored = upright.copy()
    for index, pose in enumerate(stored):
        quarter = quarters[index * len(quarters) // 12]
        turn = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarter)
        pose[:, :2] = pose[:, :2] @ turn
    images = [
        PosedImage(f"{index}.jpg", 0, tuple(tuple(map(float, row)) for row in pose))
        for index, pose in enumerate(stored)
    ]
    shown, _ = held_upright(images, Intrinsics(40, 30, 33.0, 33.0, 20.0, 15.0))
    np.testing.assert_allclose([image.world_from_camera for image in shown], upright, atol=1e-12)


def test_pictures_on_their_side_from_steeply_above_are_shown_upright_too() -> None:
    place = np.array([0.0, -1.0, 1.8])  # 61 degrees down
    pose = look_at(place, np.zeros(3))
    for turn, is_turned in (([[0.0, -1.0], [1.0, 0.0]], True), (np.eye(2), False)):
        stored = pose.copy()
        stored[:, :2] = pose[:, :2] @ np.array(turn)
        images = [PosedImage("a.jpg", 0, tuple(tuple(map(float, row)) for row in stored))]
        shown, lens = held_upright(images, Intrinsics(40, 30, 33.0, 33.0, 20.0, 15.0))
        assert (lens.width == 30) == is_turned
        np.testing.assert_allclose(shown[0].world_from_camera, pose, atol=1e-12)


def test_cameras_that_look_straight_down_are_left_as_they_are() -> None:
    down = np.eye(3, 4)
    images = [PosedImage("a.jpg", 0, tuple(tuple(map(float, row)) for row in down))]
    lens = Intrinsics(40, 30, 33.0, 33.0, 20.0, 15.0)
    assert held_upright(images, lens) == (images, lens)
    assert held_upright([], lens) == ([], lens)


def test_a_lens_of_another_size_fills_it_and_stretches_nothing() -> None:
    lens = Intrinsics(1920, 1080, 1500.0, 1500.0, 960.0, 540.0)
    square = lens_of_size(lens, 540, 540)
    assert (square.width, square.height, square.cx, square.cy) == (540, 540, 270.0, 270.0)
    assert square.fl_x == square.fl_y == 750.0, "as high as the capture's picture, less wide"
    wide = lens_of_size(lens, 3840, 1080)
    assert wide.fl_x == wide.fl_y == 3000.0, "as wide, less high"


def test_a_flight_with_its_own_field_of_view_zooms() -> None:
    poses = ring(3, np.zeros(3))
    lens = lens_of_size(Intrinsics(640, 480, 500.0, 500.0, 300.0, 250.0), 320, 240)
    assert Flight(poses).lens(1, lens) == lens
    zoomed = Flight(poses, np.array([90.0, 60.0, 30.0])).lens(0, lens)
    assert np.isclose(zoomed.fl_y, 120.0)
    assert (zoomed.fl_x, zoomed.cx, zoomed.cy) == (zoomed.fl_y, 160.0, 120.0)


def test_looking_straight_down_is_no_spin() -> None:
    poses = looking_at(np.array([[0.0, 0.0, 5.0], [0.0, 3.0, 0.0], [4.0, 0.0, 0.0]]), np.zeros(3))
    turns = poses[:, :, :3]
    assert np.allclose(turns.transpose(0, 2, 1) @ turns, np.eye(3))
    assert np.allclose(np.linalg.det(turns), 1.0)
    assert np.allclose(-turns[:, :, 2], [[0, 0, -1], [0, -1, 0], [-1, 0, 0]])


def _walked(rounds: int) -> list[PosedImage]:
    """A film that goes round a thing so often."""
    angles = np.linspace(0.0, 2.0 * np.pi * rounds, 24 * rounds)
    places = np.stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), np.ones(len(angles))], axis=1)
    poses = looking_at(places, np.zeros(3))
    return [
        PosedImage(f"{index}.jpg", 0, tuple(map(tuple, pose.tolist())), float(index))
        for index, pose in enumerate(poses)
    ]


def test_a_way_that_turns_more_is_filmed_for_longer() -> None:
    options = VideoOptions(turn_deg_per_s=60.0, min_seconds=2.0, max_seconds=20.0)
    once, thrice = (filmed_path(options, _walked(rounds)) for rounds in (1, 3))
    assert once.turned_deg() == pytest.approx(360.0, abs=40.0)
    assert len(once) == pytest.approx(once.turned_deg() / 60.0 * 24.0, rel=0.05)
    assert len(thrice) == pytest.approx(3 * len(once), rel=0.1)
    # And no longer or shorter than is wanted, or as long as somebody says.
    brief = options.model_copy(update={"max_seconds": 4.0})
    assert len(filmed_path(brief, _walked(3))) == 96
    assert len(filmed_path(options, _walked(1)[:2])) == 48
    for told, frames in (({"num_frames": 31}, 31), ({"seconds": 1.0}, 24)):
        assert len(filmed_path(options.model_copy(update=told), _walked(3))) == frames


def test_jumps_of_a_way_are_no_turning() -> None:
    angles = np.radians(np.concatenate([start + np.arange(0.0, 20.0, 0.5) for start in (0, 120)]))
    places = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    turned = Flight(looking_at(3.0 * places, np.zeros(3))).turned_deg()
    assert turned == pytest.approx(39.0, abs=0.1)


def test_how_far_a_way_turns_is_told_in_any_direction() -> None:
    pose = looking_at(np.array([[2.0, 0.0, 0.0]]), np.zeros(3))[0]
    assert Flight(pose[None]).turned_deg() == 0.0
    rolled = pose.copy()
    rolled[:, :2] = pose[:, :2] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    assert Flight(np.stack([pose, rolled, pose])).turned_deg() == pytest.approx(180.0)
