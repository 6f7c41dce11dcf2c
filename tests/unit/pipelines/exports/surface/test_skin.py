"""The picture on a mesh, worn by a cloud; and gaps of a cloud, filled from a mesh."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipelines.errors import Cancelled
from pipelines.exports.mesh import TexturedMesh
from pipelines.exports.surface import skin
from pipelines.exports.surface.cloud import Cloud
from pipelines.exports.surface.skin import Skin

EYES = np.array([[0.5, 0.5, 2.0], [0.4, 0.6, 2.0]])


def sheet(far: float = 0.0) -> TexturedMesh:
    """The unit square at a height of 0, facing up, its picture red where x < 1/2, else green."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[:, :128, 0] = picture[:, 128:, 1] = 255
    return TexturedMesh(
        vertices=corners + far,
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile([0.0, 0.0, 1.0], (4, 1)),
        uv=corners[:, :2].copy(),
        texture=picture,
    )


def cloud_at(points: np.ndarray) -> Cloud:
    grey = np.full((len(points), 3), 100, np.uint8)
    return Cloud(points, grey, np.tile(EYES[0], (len(points), 1)), np.zeros_like(points))


def grid(count: int, height: float = 0.0, most_x: float = 1.0) -> np.ndarray:
    x, y = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return points[points[:, 0] < most_x]


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_points_on_the_mesh_get_the_pictures_colours_and_others_keep_theirs(far: float) -> None:
    points = grid(20) + far
    cloud = cloud_at(points)
    on_mesh = points[:, 1] < 0.5 + far
    painted = Skin(sheet(far)).painted(cloud, on_mesh)
    left = points[:, 0] - far < 0.45
    right = points[:, 0] - far > 0.55
    np.testing.assert_array_equal(painted.colors[on_mesh & left], [[255, 0, 0]] * 90)
    np.testing.assert_array_equal(painted.colors[on_mesh & right], [[0, 255, 0]] * 90)
    np.testing.assert_array_equal(painted.colors[~on_mesh], cloud.colors[~on_mesh])
    np.testing.assert_array_equal(painted.points, cloud.points)


def test_what_the_delivered_mesh_has_lost_keeps_its_colour() -> None:
    points = np.concatenate([grid(20), grid(20) + np.array([3.0, 0.0, 0.0])])
    cloud = cloud_at(points)
    painted = Skin(sheet()).painted(cloud, np.ones(800, bool))
    assert (painted.colors[:400] != 100).all(axis=1).mean() > 0.99
    np.testing.assert_array_equal(painted.colors[400:], cloud.colors[400:])


def test_colours_are_means_over_what_a_point_stands_for() -> None:
    mesh = sheet()
    mesh.texture[:] = 0
    mesh.texture[::2, ::2] = mesh.texture[1::2, 1::2] = 200
    coarse = Skin(mesh).painted(cloud_at(grid(20)), np.ones(400, bool))
    assert np.abs(coarse.colors.astype(int) - 100).max() <= 2


def test_gaps_are_filled_with_points_of_the_mesh_and_nothing_else_is() -> None:
    cloud = cloud_at(grid(60, most_x=0.5))
    skin = Skin(sheet())
    filling = skin.filling(cloud, EYES, 4 * 400, seed=0)
    np.testing.assert_allclose(filling.points[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(filling.normals, [[0.0, 0.0, 1.0]] * len(filling), atol=1e-12)
    assert filling.points[:, 0].min() > 0.5
    assert 150 < len(filling) < 210, "half of the 400 places that are a quarter of the points"
    assert {tuple(eye) for eye in filling.eyes} <= {tuple(eye) for eye in EYES}
    both = np.concatenate([cloud.points, filling.points])
    off, _ = cKDTree(both).query(grid(50))
    assert off.max() < 0.11
    assert cKDTree(cloud.points).query(grid(50))[0].max() > 0.45
    assert len(skin.filling(cloud_at(grid(60)), EYES, 1600, seed=0)) == 0
    again = skin.filling(cloud, EYES, 1600, seed=0)
    np.testing.assert_array_equal(again.points, filling.points)


def test_what_was_filmed_from_nearby_is_filled_more_densely() -> None:
    at_a_corner = np.array([[0.0, 1.0, 0.1]])
    filling = Skin(sheet()).filling(cloud_at(np.zeros((0, 3))), at_a_corner, 8000, seed=1)
    assert len(filling) == 2000
    nearer = filling.points[:, 1] > filling.points[:, 0]
    assert 0.75 < nearer.mean() < 0.85, "of a face twice as near there is four times as much"


def test_what_no_camera_sees_is_not_filled() -> None:
    """A mesh that somebody closed: its base faces the floor, and a lid hides half of the square."""
    base = sheet()
    flat = TexturedMesh(
        np.concatenate([base.vertices, base.vertices - [0.0, 0.0, 0.5]]),
        np.concatenate([base.faces, base.faces[:, ::-1] + 4]).astype(np.int32),
        np.concatenate([base.normals, -base.normals]),
        np.concatenate([base.uv, base.uv]),
        base.texture,
    )
    filling = Skin(flat).filling(cloud_at(grid(60, most_x=0.5)), EYES, 1600, seed=0)
    assert len(filling) > 50
    np.testing.assert_allclose(filling.points[:, 2], 0.0, atol=1e-12)
    assert ((filling.eyes - filling.points) * filling.normals).sum(axis=1).min() > 0.0
    hidden = TexturedMesh(flat.vertices, flat.faces, np.abs(flat.normals), flat.uv, flat.texture)
    filling = Skin(hidden).filling(cloud_at(grid(60, most_x=0.5)), EYES, 1600, seed=0)
    np.testing.assert_allclose(filling.points[:, 2], 0.0, atol=1e-12)
    from_below = np.array([[0.5, 0.5, -2.0]])
    assert len(Skin(sheet()).filling(cloud_at(np.zeros((0, 3))), from_below, 1600, seed=0)) == 0


@pytest.mark.parametrize("asked", [20_000, 400])
def test_a_part_is_filled_as_densely_as_its_share_of_the_cloud_asks(
    asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crop of the mesh under a cloud of all, and a crop of the cloud on a mesh of all."""
    monkeypatch.setattr(skin, "_MOST_ASKED", asked)
    even = grid(60) * [3.0, 3.0, 0.0] - [1.0, 1.0, 0.0]  # nine times the square, 400 points on it
    on_it = Cloud(even, np.full((3600, 3), 9, np.uint8), even, np.tile([0.0, 0.0, 1.0], (3600, 1)))
    assert len(Skin(sheet()).filling(on_it, EYES, 3600, seed=0)) == 0
    gone = on_it.take((even[:, 0] < 0.0) | (even[:, 0] > 1.0))
    assert len(Skin(sheet()).filling(gone, EYES, 3600, seed=0)) < 60
    few = grid(60)[::50]

    def inside(points: np.ndarray) -> np.ndarray:
        return (points[:, 0] < 0.5) & (points[:, 1] < 0.5)

    filling = Skin(fine_sheet(8)).filling(cloud_at(few), EYES, 1600, seed=0, inside=inside)
    assert inside(filling.points).all()
    assert len(filling) > 250, "all the places that there are for 1,600 points lie in the crop"


def fine_sheet(count: int) -> TexturedMesh:
    """The square of so many by so many cells."""
    mesh = sheet()
    x, y = np.meshgrid(np.linspace(0.0, 1.0, count + 1), np.linspace(0.0, 1.0, count + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (
        part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    up = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    return TexturedMesh(vertices, faces.astype(np.int32), up, vertices[:, :2].copy(), mesh.texture)


def test_it_can_be_cancelled_and_a_mesh_without_faces_is_refused() -> None:
    def stop(_: float) -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        Skin(sheet()).painted(cloud_at(grid(5)), np.ones(25, bool), stop)
    empty = sheet()
    with pytest.raises(ValueError, match="without faces"):
        Skin(
            TexturedMesh(
                empty.vertices, np.zeros((0, 3), np.int32), empty.normals, empty.uv, empty.texture
            )
        )
