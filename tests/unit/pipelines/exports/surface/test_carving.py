"""What stands before nothing is cut off a mesh, as far as several views say so."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.carving import carved
from pipelines.nerf.stereo.views import StereoView

SIDE = 40


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


def void_right_of(view: StereoView, edge: float) -> np.ndarray:
    """What lies right of x = edge on the sheet's plane is nothing."""
    column = 50.0 + 140.0 * (edge - view.world_from_camera[0, 3]) / 4.0
    return np.broadcast_to(np.arange(100) + 0.5 > column, (100, 100)).copy()


@pytest.mark.parametrize("num", [2, 5])
def test_three_views_cut_off_what_they_look_through(num: int) -> None:
    views = [looking_down(x) for x in np.linspace(-0.3, 0.3, num)]
    found = carved(sheet(), [(view, void_right_of(view, 0.4)) for view in views])
    if num == 2:
        assert len(found.faces) == len(sheet().faces)
        return
    assert 0.4 <= found.vertices[:, 0].max() < 0.6
    left = sheet().vertices[:, 0] < 0.4
    assert (found.vertices[:, 0] < 0.4).sum() == left.sum()


def test_a_hole_that_is_seen_through_is_opened() -> None:
    views = [looking_down(x) for x in np.linspace(-0.3, 0.3, 4)]
    rows, columns = np.mgrid[:100, :100]
    pairs = []
    for view in views:
        center = 50.0 - 140.0 * view.world_from_camera[0, 3] / 4.0
        pairs.append((view, (columns - center) ** 2 + (rows - 50.0) ** 2 < 15.0**2))
    found = carved(sheet(), pairs)
    away = np.linalg.norm(found.vertices[:, :2], axis=1)
    assert 0.25 < away.min() < 0.45
    assert len(found.faces) > 0.8 * len(sheet().faces)


def test_a_few_views_among_many_may_be_wrong() -> None:
    views = [looking_down(x) for x in np.linspace(-0.3, 0.3, 80)]
    nothing = np.zeros((100, 100), np.bool_)
    pairs = [(view, void_right_of(view, 0.4) if i < 3 else nothing) for i, view in enumerate(views)]
    assert len(carved(sheet(), pairs).faces) == len(sheet().faces)


def test_a_mesh_of_which_nothing_would_be_left_stays() -> None:
    everything = np.ones((100, 100), np.bool_)
    views = [(looking_down(x), everything) for x in (-0.1, 0.0, 0.1)]
    assert len(carved(sheet(), views).faces) == len(sheet().faces)
