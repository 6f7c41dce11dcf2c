"""What stands right before a camera that saw far beyond it."""

from __future__ import annotations

import numpy as np
import open3d
import pytest

from pipelines.errors import Cancelled
from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.paths.flight import looking_at
from pipelines.exports.surface.unblocking import unblocked
from pipelines.scene.depth_views import DepthView, Pinhole

LENS = Pinhole(48, 36, 40.0, 40.0, 24.0, 18.0)


def sheet(distance: float, side: float, origin: float = 0.0) -> TriangleMesh:
    """A square before a camera at the origin that looks down -z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * side / 2.0
    return TriangleMesh(
        corners + np.array([0.0, 0.0, -distance]) + origin,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.full((4, 3), 0.5),
        np.tile([0.0, 0.0, 1.0], (4, 1)),
    )


def seen(z: float | np.ndarray, origin: float = 0.0) -> DepthView:
    """What the camera at the origin saw at this depth; 0 is unknown."""
    pose = np.concatenate([np.eye(3), np.full((3, 1), origin)], axis=1)
    depth = np.broadcast_to(np.asarray(z, np.float32), (36, 48)).copy()
    return DepthView(LENS, pose, np.zeros((36, 48, 3), np.uint8), depth)


@pytest.mark.parametrize("origin", [0.0, 1e6])
def test_sheets_before_a_camera_go_one_behind_the_other(origin: float) -> None:
    mesh = joined(
        [sheet(distance, side, origin) for distance, side in ((2.0, 4.0), (0.1, 0.4), (0.02, 0.1))]
    )
    kept = unblocked(mesh, [[seen(2.0, origin)]])
    assert len(kept.faces) == 2
    np.testing.assert_allclose(kept.vertices[:, 2], origin - 2.0, atol=1e-9)
    assert len(kept.vertices) == len(kept.normals) == len(kept.colors) == 4


def test_what_was_filmed_from_nearby_and_what_nothing_is_known_behind_stay() -> None:
    mesh = joined([sheet(2.0, 4.0), sheet(0.1, 0.4)])
    assert unblocked(mesh, [[seen(0.1)], [], [seen(0.9)]]) is mesh
    assert unblocked(mesh, [[seen(0.0)]]) is mesh
    assert unblocked(mesh, []) is mesh
    left = np.full((36, 48), 2.0)
    left[:, 16:] = 0.0
    assert len(unblocked(mesh, [[], [seen(left)]]).faces) < 4


def ball(radius: float) -> TriangleMesh:
    made = open3d.geometry.TriangleMesh.create_sphere(radius, 60)
    vertices = np.asarray(made.vertices)
    return TriangleMesh(
        vertices,
        np.asarray(made.triangles, np.int32),
        np.full((len(vertices), 3), 0.5),
        vertices / radius,
    )


def of_a_ball(place: np.ndarray, beyond: float) -> DepthView:
    """What a camera at [3] sees of a ball with a radius of 1, before a ground at this depth."""
    lens = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0)
    pose = looking_at(place[None], np.zeros(3))[0]
    ways = lens.directions() @ pose[:, :3].T
    a, b, c = (ways * ways).sum(-1), ways @ place, place @ place - 1.0
    met = b * b - a * c
    z = np.where(met > 0.0, (-b - np.sqrt(np.maximum(met, 0.0))) / a, beyond)
    return DepthView(lens, pose, np.zeros((120, 160, 3), np.uint8), z.astype(np.float32))


def test_outlines_before_a_far_ground_stand_before_nobody() -> None:
    """Half a pixel around a thing its mesh meets what the maps have of the ground."""
    angles = np.radians(np.arange(0.0, 360.0, 15.0))
    places = np.stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), np.sin(3.0 * angles)], axis=1)
    views = [of_a_ball(place, 60.0) for place in places]
    for radius in (1.0, 1.01, 1.03):
        mesh = ball(radius)
        assert unblocked(mesh, [views]) is mesh


def test_faces_of_a_sheet_that_are_smaller_than_rays_are_apart_go_too() -> None:
    small = sheet(0.05, 0.03)
    for _ in range(5):
        small = split(small)
    mesh = joined([sheet(2.0, 4.0), small])
    assert len(unblocked(mesh, [[seen(2.0)]]).faces) == 2


def split(mesh: TriangleMesh) -> TriangleMesh:
    """Each face as four."""
    made = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces)
    ).subdivide_midpoint(1)
    vertices = np.asarray(made.vertices)
    plain = np.full((len(vertices), 3), 0.5), np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    return TriangleMesh(vertices, np.asarray(made.triangles, np.int32), *plain)


def test_a_mesh_is_never_all_taken_away() -> None:
    mesh = sheet(0.1, 0.4)
    assert unblocked(mesh, [[seen(2.0)]]) is mesh
    none = mesh.with_faces(np.zeros((0, 3), np.int32))
    assert unblocked(none, [[seen(2.0)]]) is none


def test_it_can_be_cancelled() -> None:
    def stop(_: float) -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        unblocked(sheet(2.0, 4.0), [[seen(2.0)]], stop)
