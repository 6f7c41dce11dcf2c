"""What views say of vertices: who sees them from the front, and in what colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.tsdf import fuse
from pipelines.exports.surface.view_colors import seen_colors
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_color, sphere_view

CENTER = np.array([1000.0, -500.0, 7.0])
VOXEL = 2.6 / 48
LENS = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0)
BOUNDS = SceneBounds(CENTER, 3.0, 6.0, CENTER - 1.3, CENTER + 1.3)


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    return [sphere_view(LENS, pose, CENTER) for pose in ring(12, CENTER)]


@pytest.fixture(scope="module")
def ball(views: list[DepthView]) -> TriangleMesh:
    """The unit ball, in grey."""
    made = fuse(views, BOUNDS, VOXEL)
    return replace(made, colors=np.full_like(made.vertices, 0.5))


def test_vertices_have_the_mean_of_the_colours_in_which_they_are_seen(
    ball: TriangleMesh, views: list[DepthView]
) -> None:
    told: list[float] = []
    count, colors = seen_colors(ball, views, 3.0 * VOXEL, told.append)
    assert count.min() >= 2
    assert count.max() < len(views), "no vertex is seen from behind"
    assert np.abs(colors - sphere_color(ball.vertices, CENTER)).mean() < 0.01
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_view_says_nothing_of_what_is_behind_or_beside_what_it_sees(
    ball: TriangleMesh, views: list[DepthView]
) -> None:
    one = views[:1]
    count, colors = seen_colors(ball, one, 3.0 * VOXEL)
    toward = one[0].world_from_camera[:, 3] - CENTER
    facing = (ball.vertices - CENTER) @ toward / np.linalg.norm(toward)
    assert count[facing > 0.6].all()
    assert not count[facing < 0.2].any()
    assert not colors[count == 0].any()
    apart = replace(ball, vertices=CENTER + 1.2 * (ball.vertices - CENTER))
    assert not seen_colors(apart, one, VOXEL)[0][facing > 0.9].any()
