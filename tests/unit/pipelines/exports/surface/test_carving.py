"""What stands before nothing is cut off a mesh, as far as several views say so."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.carving import Seen, carved
from pipelines.nerf.stereo.views import StereoView

SIDE = 40
PIXEL = 4.0 / 140.0
"""Of the pictures, on the sheet."""


def sheet() -> TriangleMesh:
    """Of 2 x 2 at z = 0, [-1, 1]."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE))
    corners = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (
        part.ravel()
        for part in (corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.int32)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(SIDE * SIDE)], axis=1)
    return TriangleMesh(
        points, faces, np.zeros_like(points), np.tile([0.0, 0.0, 1.0], (len(points), 1))
    )


def looking_down(x: float) -> StereoView:
    """From 4 above, OpenCV axes: the picture's right is +x, its down -y."""
    pose = np.column_stack([np.diag([1.0, -1.0, -1.0]), [x, 0.0, 4.0]])
    return StereoView(np.zeros((100, 100), np.float32), (140.0, 140.0, 50.0, 50.0), pose)


NOTHING_KNOWN = np.zeros((100, 100), np.float32)


def void_right_of(view: StereoView, edge: float) -> np.ndarray:
    """What lies right of x = edge on the sheet's plane is nothing."""
    column = 50.0 + 140.0 * (edge - view.world_from_camera[0, 3]) / 4.0
    return np.broadcast_to(np.arange(100) + 0.5 > column, (100, 100)).copy()


def area(mesh: TriangleMesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def border_of(mesh: TriangleMesh) -> np.ndarray:
    """The ends of all edges that a single face has, [2 E]."""
    edges = np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    found, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    return found[count == 1].reshape(-1)


@pytest.mark.parametrize("num", [2, 5])
def test_three_views_cut_off_what_they_look_through(num: int) -> None:
    views = [looking_down(x) for x in np.linspace(-0.3, 0.3, num)]
    found = carved(sheet(), [Seen(view, void_right_of(view, 0.4), NOTHING_KNOWN) for view in views])
    if num == 2:
        assert len(found.faces) == len(sheet().faces)
        return
    # The border is cut, not the triangles: straight, a pixel and its rounding from what is void.
    right = found.vertices[border_of(found), 0].max()
    assert 0.4 <= right < 0.4 + 2.5 * PIXEL
    assert (found.vertices[:, 0] > right - PIXEL).sum() > SIDE
    assert area(found) == pytest.approx(2.0 * (1.0 + right), rel=2e-3)
    left = sheet().vertices[:, 0] < 0.4
    assert (found.vertices[:, 0] < 0.4).sum() == left.sum()
    assert np.allclose(found.normals, [0.0, 0.0, 1.0])


def test_a_hole_that_is_seen_through_is_opened() -> None:
    views = [looking_down(x) for x in np.linspace(-0.3, 0.3, 4)]
    rows, columns = np.mgrid[:100, :100]
    pairs = []
    for view in views:
        center = 50.0 - 140.0 * view.world_from_camera[0, 3] / 4.0
        circle = (columns - center) ** 2 + (rows - 50.0) ** 2 < 15.0**2
        pairs.append(Seen(view, circle, NOTHING_KNOWN))
    found = carved(sheet(), pairs)
    away = np.linalg.norm(found.vertices[:, :2], axis=1)
    assert 12.5 * PIXEL < away.min() < 15.0 * PIXEL
    assert area(found) == pytest.approx(4.0 - np.pi * (14.0 * PIXEL) ** 2, rel=0.01)
    # Cut triangles share their new corners: nothing opens but the hole, and the sheet's own rim.
    rim = np.abs(found.vertices[:, :2]).max(axis=1) > 1.0 - 1e-9
    edges = border_of(found).reshape(-1, 2)
    assert (rim[edges].all(axis=1) | (away[edges] < 16.0 * PIXEL).all(axis=1)).all()
    # Corners go round as they did, seen from above.
    a, b, c = (found.vertices[found.faces[:, corner]] for corner in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()


@pytest.mark.parametrize("hidden", [False, True])
def test_a_few_views_among_many_may_be_wrong(hidden: bool) -> None:
    """Unless the others do not see it, for what stands nearer to them."""
    views = [looking_down(x) for x in np.linspace(-0.3, 0.3, 80)]
    nothing = np.zeros((100, 100), np.bool_)
    known = np.full((100, 100), 2.0 if hidden else 4.0, np.float32)
    photos = [
        Seen(view, void_right_of(view, 0.4), NOTHING_KNOWN)
        if index % 30 == 1
        else Seen(view, nothing, known)
        for index, view in enumerate(views)
    ]
    assert (len(carved(sheet(), photos).faces) < len(sheet().faces)) == hidden


def test_a_mesh_of_which_nothing_would_be_left_stays() -> None:
    everything = np.ones((100, 100), np.bool_)
    views = [Seen(looking_down(x), everything, NOTHING_KNOWN) for x in (-0.1, 0.0, 0.1)]
    assert len(carved(sheet(), views).faces) == len(sheet().faces)
