"""Who walked round a thing is told from who filmed a place, and the thing is held whole."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.subject import Decision, find_subject
from pipelines.sample.film import phone_camera, walk
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.scene.depth_views import DepthView, Pinhole
from pipelines.scene.gaze import Gaze
from tests.unit.pipelines.exports.made_places import around, block, seen_from, sheet, table

THING = ((-0.2, -0.15, 0.0), (0.2, 0.15, 0.3))
MIDDLE = (0.0, 0.0, 0.15)


def _decided(parts: list[TriangleMesh], gaze: Gaze) -> Decision:
    mesh = joined(parts)
    return find_subject(mesh.vertices, mesh.faces, gaze)


def _corners(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def _holds(found: Decision) -> None:
    """The thing is in the region, and the region is hardly larger than it and its rim."""
    assert found.kind == "subject", found.why
    assert found.thing is not None
    region = found.thing.region
    assert region.contains(_corners(*THING)).all()
    assert (2.0 * region.half < [0.9, 0.9, 0.5]).all(), region
    np.testing.assert_allclose(found.thing.origin, [0.0, 0.0, 0.0], atol=0.05)


@pytest.mark.parametrize("arc_deg", [360.0, 180.0, 90.0])
def test_a_thing_on_a_table_is_a_subject_from_any_good_arc(arc_deg: float) -> None:
    found = _decided([table(2.0), block(*THING)], seen_from(around(arc_deg), MIDDLE))
    _holds(found)
    assert found.thing is not None
    assert found.thing.carried_by is not None
    assert found.thing.carried_by.normal[2] == pytest.approx(1.0, abs=1e-3)


def test_what_goes_by_the_size_of_the_world_is_no_different_in_another_unit() -> None:
    mesh = joined([table(2.0), block(*THING)])
    for scale, shift in ((1000.0, 0.0), (0.01, 0.0), (1.0, 5e5)):
        gaze = seen_from(around(180.0), MIDDLE)
        gaze.poses[:, :, 3] = scale * gaze.poses[:, :, 3] + shift
        found = find_subject(scale * mesh.vertices + shift, mesh.faces, gaze)
        assert found.thing is not None
        assert found.thing.region.contains(scale * _corners(*THING) + shift).all()
        assert (2.0 * found.thing.region.half < scale * np.array([0.9, 0.9, 0.5])).all()


def test_a_thing_turned_on_its_table_has_a_region_turned_alike() -> None:
    turn = np.radians(30.0)
    matrix = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    thing = block((-0.3, -0.1, 0.0), (0.3, 0.1, 0.2))
    turned = TriangleMesh(
        thing.vertices @ matrix.T, thing.faces, thing.colors, thing.normals @ matrix.T
    )
    found = _decided([table(2.0), turned], seen_from(around(360.0), MIDDLE))
    assert found.thing is not None
    axes = found.thing.region.axes
    assert np.abs(axes.T @ matrix[:, 0])[:2].max() > np.cos(np.radians(3.0))
    np.testing.assert_array_equal(axes[2], [0.0, 0.0, 1.0])


def test_a_table_off_level_as_poses_from_pictures_are_carries_all_the_same() -> None:
    lean = np.radians(9.0)
    matrix = np.array(
        [[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]]
    )
    mesh = joined([table(2.0), block(*THING)])
    gaze = seen_from(around(180.0), MIDDLE)
    leant = Gaze(np.einsum("ij,njk->nik", matrix, gaze.poses), gaze.lenses)
    found = find_subject(mesh.vertices @ matrix.T, mesh.faces, leant)
    assert found.thing is not None
    assert found.thing.region.contains(_corners(*THING) @ matrix.T).all()
    np.testing.assert_allclose(found.thing.origin, 0.0, atol=0.06)


def test_a_thing_on_a_wall_is_held_with_a_piece_of_the_wall() -> None:
    wall = sheet((-2.0, 0.3, -1.5), (4.0, 0, 0), (0, 0, 3.0))
    head = block((-0.2, -0.1, -0.2), (0.2, 0.31, 0.2))
    found = _decided([wall, head], seen_from(around(100.0, height=0.1), (0.0, 0.1, 0.0)))
    assert found.kind == "subject", found.why
    assert found.thing is not None
    region = found.thing.region
    assert region.contains(_corners((-0.2, -0.1, -0.2), (0.2, 0.3, 0.2))).all()
    assert (2.0 * region.half < [0.9, 0.9, 0.9]).all()
    assert region.contains(np.array([[0.27, 0.3, 0.27]])).all(), "a rim of the wall"


def test_a_thing_that_nothing_carries_is_held_too() -> None:
    found = _decided([block(*THING)], seen_from(around(360.0), MIDDLE))
    assert found.kind == "subject"
    assert found.thing is not None
    assert found.thing.carried_by is None
    assert found.thing.region.contains(_corners(*THING)).all()
    assert found.thing.origin[2] == pytest.approx(
        found.thing.region.center[2] - found.thing.region.half[2]
    )


def test_a_stand_that_ends_soon_is_kept_whole_and_one_that_does_not_is_cut() -> None:
    stand = block((-0.32, -0.3, -0.4), (0.32, 0.3, 0.0))
    for carrier, whole in ((stand, True), (table(0.9), False)):
        found = _decided([carrier, block(*THING)], seen_from(around(360.0), MIDDLE))
        assert found.thing is not None, found.why
        held = found.thing.region.contains(carrier.vertices[carrier.vertices[:, 2] == 0.0])
        assert held.all() == whole


def test_the_wall_behind_a_thing_is_no_part_of_it() -> None:
    wall = sheet((-2.0, 0.5, 0.0), (4.0, 0, 0), (0, 0, 1.5))
    floor = sheet((-2.0, -2.0, 0.0), (4.0, 0, 0), (0, 2.5, 0))
    _holds(_decided([floor, block(*THING), wall], seen_from(around(120.0), MIDDLE)))


def test_what_stands_beside_it_is_left_out_but_for_what_people_looked_at_as_much() -> None:
    beside = block((0.29, -0.9, 0.0), (0.6, -0.5, 0.25))
    gaze = seen_from(around(360.0, radius=0.8), MIDDLE)
    lamp = block((-0.9, 0.1, 0.0), (-0.5, 0.5, 0.6))
    found = _decided([table(2.0), block(*THING), lamp, beside], gaze)
    assert found.thing is not None
    assert not found.thing.is_other(_corners(*THING) + np.array([0.0, 0.0, 0.1])).any()
    far = np.array([[-0.8, 0.3, 0.5], [0.5, -0.8, 0.2]])
    assert (found.thing.is_other(far) | ~found.thing.region.contains(far)).all()
    twins = [block((-0.3, -0.1, 0.0), (-0.1, 0.1, 0.2)), block((0.1, -0.1, 0.0), (0.3, 0.1, 0.2))]
    both = _decided([table(2.0), *twins], gaze)
    assert both.thing is not None
    assert both.thing.region.contains(_corners((-0.3, -0.1, 0.0), (0.3, 0.1, 0.2))).all()


def _yard() -> list[TriangleMesh]:
    """Ground and four walls, seen from within."""
    return [
        table(2.0),
        sheet((-2, 2, 0), (4, 0, 0), (0, 0, 2)),
        sheet((2, -2, 0), (-4, 0, 0), (0, 0, 2)),
        sheet((-2, -2, 0), (0, 4, 0), (0, 0, 2)),
        sheet((2, 2, 0), (0, -4, 0), (0, 0, 2)),
    ]


def _columns() -> list[TriangleMesh]:
    """A facade with columns before it."""
    wall = sheet((-4, 0, -1), (8, 0, 0), (0, 0, 3))
    return [wall, *(block((x, -0.15, -1), (x + 0.2, 0, 2)) for x in np.arange(-4.0, 4.0, 0.4))]


def _way(x: float, y: float) -> np.ndarray:
    return np.array([x, y, 0.0])


FACADE = [sheet((-4, 0, -1), (8, 0, 0), (0, 0, 3))]
ALONG = np.stack([np.linspace(-3, 3, 40), np.full(40, -1.0), np.full(40, 0.5)], axis=1)
STALLS = [
    block((x, y, 0.0), (x + 0.15, y + 0.15, 0.15))
    for x in np.arange(-1.8, 1.8, 0.3)
    for y in np.arange(-1.8, 1.8, 0.3)
]
PLACES: dict[str, Callable[[], Decision]] = {
    "an empty table": lambda: _decided([table(2.0)], seen_from(around(360.0), (0, 0, 0))),
    "an empty yard, across": lambda: _decided(
        _yard(), seen_from(around(360.0, radius=1.2, height=1.2), (0, 0, 1.0))
    ),
    "a room, along its walls": lambda: _decided(
        _yard(), seen_from(around(360.0, radius=1.8, height=1.4), (0, 0, 0.9))
    ),
    "a room, outwards": lambda: _decided(
        _yard(), seen_from(around(360.0, radius=0.4, height=1.2), lambda eye: eye * [3, 3, 0.9])
    ),
    "a corridor": lambda: _decided(
        [sheet((-4, 0.8, -1), (8, 0, 0), (0, 0, 3)), sheet((4, -0.8, -1), (-8, 0, 0), (0, 0, 3))],
        seen_from(ALONG + np.eye(3)[1], lambda eye: eye + _way(1.0, 0.1 * np.sin(5 * eye[0]))),
    ),
    "a facade, straight on": lambda: _decided(
        FACADE, seen_from(ALONG, lambda eye: eye + _way(0.05 * np.sin(eye[0]), 1.0))
    ),
    "a facade, its middle": lambda: _decided(FACADE, seen_from(around(90.0), (0, 0, 0.5))),
    "columns, their middle": lambda: _decided(_columns(), seen_from(around(90.0), (0, 0, 0.5))),
    "stalls all over": lambda: _decided(
        [table(2.0), *STALLS], seen_from(around(360.0, radius=0.9, height=0.8), (0, 0, 0))
    ),
    "a thing, from one side": lambda: _decided(
        [table(2.0), block(*THING)], seen_from(around(30.0), MIDDLE)
    ),
    "a thing, in passing": lambda: _decided(
        [*_yard(), block(*THING)],
        seen_from(
            np.concatenate([around(300.0, count=13), around(360.0, radius=1.1, count=27)]),
            lambda eye: np.array(MIDDLE) if np.hypot(*eye[:2]) < 1.05 else eye * [3, 3, 1],
        ),
    ),
}


@pytest.mark.parametrize("name", PLACES)
def test_a_place_is_a_scene(name: str) -> None:
    found = PLACES[name]()
    assert found.kind == "scene", found.measures
    assert found.thing is None
    assert found.why


def test_no_camera_and_no_surface_are_a_scene() -> None:
    mesh = table(1.0)
    nobody = Gaze(np.zeros((0, 3, 4)), [])
    assert find_subject(mesh.vertices, mesh.faces, nobody).kind == "scene"
    far = table(1.0, height=-50.0)
    gaze = seen_from(around(360.0), MIDDLE)
    assert find_subject(far.vertices, far.faces, gaze).kind == "scene"


def _seen_mesh(name: str, num_views: int = 24) -> tuple[TriangleMesh, Gaze]:
    """The exact surface that a take's cameras see, and they."""
    take = TAKES[name]
    truth = walk(num_views, phone_camera(64), take=take)
    views = [
        DepthView(
            Pinhole.of(truth.cameras[0], 64),
            pose_matrix(image),
            np.zeros((0, 0, 3), np.uint8),
            depth_image(truth.cameras[0], pose_matrix(image), take.scene).astype(np.float32),
        )
        for image in truth.images
    ]
    parts = []
    for view in views:
        height, width = view.z_depth.shape
        number = np.arange(height * width).reshape(height, width)
        good = view.smooth_mask()
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
        whole = good[:-1, :-1] & good[1:, :-1] & good[:-1, 1:] & good[1:, 1:]
        faces = np.concatenate(
            [
                np.stack([a[whole], b[whole], c[whole]], 1),
                np.stack([c[whole], b[whole], d[whole]], 1),
            ]
        )
        points = view.points().reshape(-1, 3)
        plain = np.full_like(points, 0.5)
        parts.append(TriangleMesh(points, faces.astype(np.int32), plain, plain))
    poses = np.stack([view.world_from_camera for view in views])
    return joined(parts), Gaze(poses, [view.lens for view in views])


def test_the_object_on_its_stand_is_held_with_the_top_of_the_stand() -> None:
    mesh, gaze = _seen_mesh("object")
    found = find_subject(mesh.vertices, mesh.faces, gaze)
    assert found.kind == "subject", found.why
    assert found.thing is not None
    things = TAKES["object"].scene.things
    assert things is not None
    near = mesh.vertices[things.contains(mesh.vertices)]
    assert found.thing.region.contains(near).all()
    assert not found.thing.is_other(near).any()
    # The stand is a drum of 0.45 m, 0.70 m high.
    assert found.thing.region.contains(np.array([[0.31, 0.31, 0.7], [-0.31, -0.31, 0.7]])).all()
    assert (2.0 * found.thing.region.half < [1.3, 1.3, 0.6]).all()
    np.testing.assert_allclose(found.thing.origin, [0.0, 0.0, 0.7], atol=0.05)


def test_the_sample_is_a_subject_and_the_room_is_not() -> None:
    mesh, gaze = _seen_mesh("bowl")
    found = find_subject(mesh.vertices, mesh.faces, gaze)
    assert found.kind == "subject", found.why
    assert found.thing is not None
    bowl = mesh.vertices[(np.hypot(*mesh.vertices[:, :2].T) < 0.25) & (mesh.vertices[:, 2] < 0.4)]
    assert found.thing.region.contains(bowl).all()
    mesh, gaze = _seen_mesh("room")
    found = find_subject(mesh.vertices, mesh.faces, gaze)
    assert (found.kind, found.thing) == ("scene", None)


SPECK = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0]])


@pytest.mark.parametrize(
    ("vertices", "num_faces"),
    [
        (np.zeros((0, 3)), 0),
        (SPECK, 1),
        (0.0 * SPECK, 1),  # a face without an area
        (SPECK + 1e6, 1),
        (1e9 * SPECK, 1),
    ],
    ids=["empty", "speck", "no area", "far away", "huge"],
)
def test_a_mesh_with_hardly_anything_in_it_is_a_scene(vertices: np.ndarray, num_faces: int) -> None:
    faces = np.arange(3 * num_faces, dtype=np.int32).reshape(-1, 3)
    gaze = seen_from(around(360.0), MIDDLE)
    for where in (None, (np.zeros(3), 1.0)):
        found = find_subject(vertices, faces, gaze, where)
        assert (found.kind, found.thing) == ("scene", None)
        assert found.why
