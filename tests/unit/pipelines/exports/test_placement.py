"""Frames that exports are asked for, and the way there from the world of cameras.json."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.errors import ExportError
from pipelines.exports.crop import crop_of, empty_crop
from pipelines.exports.frame import FrameName
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.options import CropShapeOptions
from pipelines.exports.placement import placement_of, to_world
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage

Floats = NDArray[np.float64]
NAMES: tuple[FrameName, ...] = get_args(FrameName)
TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From +Y up to +Z up, as apps' worlds are turned."""
SHIFT, SCALE = np.array([3.0, -2.0, 0.5]), 0.25
MOVED = {
    "applied_transform": np.column_stack([TURN, SHIFT]).tolist(),
    "applied_scale": SCALE,
    "world": "an app's",
}


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)


def around(**more: Any) -> CamerasFile:
    """Eight cameras on a circle about (1, 2, 0.5), which they look at from 2 units off."""
    images = []
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        back = np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        center = np.array([1.0, 2.0, 0.5]) + 2.0 * back
        pose = np.column_stack([right, [0.0, 0.0, 1.0], back, center])
        images.append(PosedImage(f"images/{angle:.2f}.png", 0, _rows(pose)))
    lens = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)
    return replace(CamerasFile((lens,), tuple(images), metric=True), **more)


def centers(cameras: CamerasFile) -> Floats:
    return np.asarray([image.world_from_camera for image in cameras.images])[:, :, 3]


def some_points(count: int = 500) -> Floats:
    return np.random.default_rng(5).normal([1.0, 2.0, 0.5], 1.0, (count, 3))


def test_gravity_changes_nothing_and_neither_does_source_where_there_is_none() -> None:
    cameras, points = around(), some_points()
    for name in ("gravity", "source"):
        place = placement_of(name, cameras)
        assert place.cameras(cameras) is cameras
        assert place.points(points) is points
        assert place.metric
        assert place.as_dict()["from_world"] == np.eye(3, 4).tolist()
    assert placement_of("gravity", around(notes=MOVED)).similarity is None


def test_source_is_where_the_captures_own_poses_were() -> None:
    own = around(metric=False)
    world = [
        np.column_stack([TURN @ pose[:, :3], SCALE * (TURN @ pose[:, 3] + SHIFT)])
        for pose in (np.asarray(image.world_from_camera) for image in own.images)
    ]
    here = replace(
        own,
        images=tuple(
            replace(image, world_from_camera=_rows(pose))
            for image, pose in zip(own.images, world, strict=True)
        ),
        notes=MOVED,
        metric=True,
    )
    place = placement_of("source", here)
    back = place.cameras(here)
    for image, wanted in zip(back.images, own.images, strict=True):
        np.testing.assert_allclose(image.world_from_camera, wanted.world_from_camera, atol=1e-12)
    assert back.notes == {"world": "an app's"}, "nothing has moved it any more"
    # It has +Y up: there as it is, and here as it is.
    note = "right-handed, the world of the capture's own poses; the unit's length is unknown"
    assert place.frame().note() == note
    own_up = place.directions(np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(place.frame("y").of_world(own_up), own_up)
    assert place.scale == 4.0
    assert not place.metric, "4 units of it are a metre"
    unscaled = {"applied_transform": MOVED["applied_transform"]}
    assert placement_of("source", replace(here, notes=unscaled)).metric


def test_normalised_stands_upright_about_what_the_cameras_look_at() -> None:
    cameras = around()
    place = placement_of("normalised", cameras)
    np.testing.assert_allclose(place.points(np.array([[1.0, 2.0, 0.5]])), 0.0, atol=1e-9)
    moved = place.cameras(cameras)
    assert np.abs(centers(moved)).max() == pytest.approx(1.0)
    np.testing.assert_allclose(place.directions(np.array([[0.0, 0.0, 1.0]])), [[0.0, 0.0, 1.0]])
    assert place.scale == pytest.approx(0.5)
    assert (place.metric, moved.metric) == (False, False)
    assert "+Z up" in place.frame().note()
    assert "+Y up" in place.frame("y").note()


def test_normalised_cameras_say_how_the_captures_own_world_came_there() -> None:
    cameras = around(notes=MOVED)
    moved = placement_of("normalised", cameras).cameras(cameras)
    own = centers(placement_of("source", cameras).cameras(cameras))
    matrix = np.asarray(moved.notes["applied_transform"])
    again = moved.notes["applied_scale"] * (own @ matrix[:, :3].T + matrix[:, 3])
    np.testing.assert_allclose(again, centers(moved), atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_what_an_export_says_of_its_frame_leads_back(name: FrameName) -> None:
    place, points = placement_of(name, around(notes=MOVED)), some_points()
    summary = {"frame": place.as_dict()}
    np.testing.assert_allclose(to_world(place.points(points), summary), points, atol=1e-9)
    np.testing.assert_array_equal(to_world(points, {}), points)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "shape",
    [
        {"shape": "sphere", "center": (0.1, 0.0, 0.2), "radius": 0.7},
        {"shape": "box", "size": (1.0, 0.6, 2.0), "rotation_deg": (20.0, -30.0, 50.0)},
    ],
)
def test_a_crop_lies_in_the_frame_that_is_asked_for(name: FrameName, shape: dict[str, Any]) -> None:
    place = placement_of(name, around(notes=MOVED))
    crop = crop_of(CropShapeOptions(**shape))
    assert crop is not None
    there = np.random.default_rng(2).normal(0.0, 0.6, (2000, 3))
    world = to_world(there, {"frame": place.as_dict()})
    found = place.crop(crop)
    assert found is not None
    told, wanted = empty_crop(found, world, "mesh"), empty_crop(crop, there, "mesh")
    for key, value in wanted.details.items():
        np.testing.assert_allclose(told.details[key], value, atol=2e-6, err_msg=key)
    assert ("cameras.json" in told.hint) == (name == "gravity")
    inside = found.contains(world)
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(inside, crop.contains(there))
    assert place.crop(None) is None


@pytest.mark.parametrize("name", NAMES)
def test_a_mesh_keeps_its_outside(name: FrameName) -> None:
    """Its normals stay unit and turn with it; its faces stay counter-clockwise."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    mesh = TriangleMesh(vertices, np.array([[0, 1, 2]], np.int32), np.zeros((3, 3)), normals)
    placed = placement_of(name, around(notes=MOVED)).mesh(mesh)
    first, second, third = placed.vertices
    across = np.cross(second - first, third - first)
    np.testing.assert_allclose(placed.normals[0], across / np.linalg.norm(across), atol=1e-12)
    assert placed.faces is mesh.faces


@pytest.mark.parametrize(
    "notes",
    [
        {"applied_transform": np.diag([1.0, -1.0, 1.0, 0.0])[:3].tolist()},
        {"applied_transform": (2.0 * np.eye(3, 4)).tolist()},
        {"applied_scale": 0.0},
    ],
)
def test_a_world_that_is_mirrored_or_of_no_size_is_refused(notes: dict[str, Any]) -> None:
    with pytest.raises(ExportError) as caught:
        placement_of("source", around(notes=notes))
    assert caught.value.code == "frame_unknown"
    placement_of("gravity", around(notes=notes))
