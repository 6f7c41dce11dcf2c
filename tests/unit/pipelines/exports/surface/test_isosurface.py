"""The surface of a density field, against a ball whose density is known everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.errors import Cancelled
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface import isosurface
from pipelines.exports.surface.isosurface import LEVEL, extract
from pipelines.exports.surface.shells import Shell, fuse_shells
from pipelines.exports.surface.tsdf import touched_blocks
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_color, sphere_view

CENTER = np.array([1000.0, -500.0, 7.0])
VOXEL = 2.6 / 48
LENS = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0)
BOUNDS = SceneBounds(CENTER, 3.0, 6.0, CENTER - 1.3, CENTER + 1.3)
SOFT = 0.4 * VOXEL
DENSEST = 40.0 / VOXEL


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    return [sphere_view(LENS, pose, CENTER) for pose in ring(12, CENTER)]


def away(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - CENTER, axis=-1)


def sheet(points: np.ndarray) -> np.ndarray:
    """Dense where a ball's surface is, 3 voxels deep, and empty within, as trained fields are.

    A voxel's length takes away `LEVEL` of the light at the unit ball.
    """
    depth = 1.0 - away(points)
    front = np.exp(depth / SOFT) * -np.log(1.0 - LEVEL) / VOXEL
    return np.where(depth < 3.0 * VOXEL, np.minimum(front, DENSEST), 0.0)


@pytest.fixture(scope="module")
def ball(views: list[DepthView]) -> TriangleMesh:
    return extract(sheet, views, BOUNDS, VOXEL)


def test_the_surface_is_where_so_much_light_is_taken_and_faces_out(ball: TriangleMesh) -> None:
    assert len(ball.faces) > 4000
    off = away(ball.vertices) - 1.0
    assert np.abs(off).max() < 0.25 * VOXEL
    assert abs(off.mean()) < 0.1 * VOXEL
    a, b, c = (ball.vertices[ball.faces[:, corner]] for corner in range(3))
    outward = (np.cross(b - a, c - a) * ((a + b + c) / 3.0 - CENTER)).sum(axis=1)
    assert (outward > 0).all()
    assert np.abs(ball.colors - sphere_color(ball.vertices, CENTER)).mean() < 0.02


def test_vertices_lie_between_voxels_not_at_steps(ball: TriangleMesh) -> None:
    """Of the share of light that is taken away, straight from voxel to voxel."""
    mid = (BOUNDS.box_min + BOUNDS.box_max) / 2.0
    cells = (ball.vertices - mid) / VOXEL
    steps = np.abs(cells - np.rint(cells))
    assert (np.sort(steps, axis=1)[:, :2] < 2e-3).all(), "each is on an edge between two voxels"
    axis = steps.argmax(axis=1)
    rows = np.arange(len(cells))
    low = np.rint(cells)
    low[rows, axis] = np.floor(cells[rows, axis])
    high = low.copy()
    high[rows, axis] += 1.0
    inner, outer = (1.0 - np.exp(-sheet(end * VOXEL + mid) * VOXEL) for end in (low, high))
    share = (LEVEL - inner) / (outer - inner)
    inside = (share > 0.02) & (share < 0.98)
    assert inside.sum() > 1000
    assert np.abs((cells - low)[rows, axis] - share)[inside].max() < 0.01


def test_the_sheets_back_and_what_no_two_views_see_are_left_out(views: list[DepthView]) -> None:
    everything = extract(sheet, views, BOUNDS, VOXEL)
    assert away(everything.vertices).min() > 1.0 - 1.5 * VOXEL, "the back is 3 voxels deep"
    from_one_side = [view for view in views if view.world_from_camera[0, 3] > CENTER[0] + 0.5]
    assert len(from_one_side) >= 3
    half = extract(sheet, from_one_side, BOUNDS, VOXEL)
    assert 500 < len(half.faces) < 0.8 * len(everything.faces)
    assert (half.vertices[:, 0] - CENTER[0]).min() > -0.9
    assert len(extract(sheet, views[:1], BOUNDS, VOXEL).faces) == 0


def test_what_floats_where_no_view_sees_a_surface_is_not_even_asked(
    views: list[DepthView],
) -> None:
    asked: list[np.ndarray] = []

    def with_a_floater(points: np.ndarray) -> np.ndarray:
        asked.append(points)
        near = np.linalg.norm(points - CENTER - [0.0, 0.0, 1.28], axis=-1) < 0.02
        middle = away(points) < 0.3
        return np.where(near | middle, DENSEST, sheet(points))

    mesh = extract(with_a_floater, views, BOUNDS, VOXEL)
    assert np.abs(away(mesh.vertices) - 1.0).max() < 0.25 * VOXEL
    places = np.concatenate(asked)
    assert away(places).min() > 0.4
    assert len(places) == len(touched_blocks(views, BOUNDS, VOXEL)) * 8**3, "each place once"


def test_a_lower_level_is_farther_out(views: list[DepthView], ball: TriangleMesh) -> None:
    """Where e times less dense is, SOFT farther out."""
    lower = 1.0 - (1.0 - LEVEL) ** (1.0 / np.e)
    out = extract(sheet, views, BOUNDS, VOXEL, level=float(lower))
    moved = away(out.vertices).mean() - away(ball.vertices).mean()
    assert moved == pytest.approx(SOFT, rel=0.3)


def test_a_field_without_anything_has_no_mesh(views: list[DepthView]) -> None:
    mesh = extract(lambda points: np.zeros(len(points)), views, BOUNDS, VOXEL)
    assert len(mesh.faces) == 0
    solid = extract(lambda points: np.full(len(points), DENSEST), views, BOUNDS, VOXEL)
    assert len(solid.faces) == 0


def test_it_is_asked_in_parts_which_change_nothing_and_can_be_stopped(
    views: list[DepthView], ball: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(isosurface, "_TOGETHER", 16)
    sizes: list[int] = []
    told: list[float] = []

    def counted(points: np.ndarray) -> np.ndarray:
        sizes.append(len(points))
        return sheet(points)

    again = extract(counted, views, BOUNDS, VOXEL, told.append)
    assert max(sizes) == 16 * 8**3
    assert len(sizes) > 4
    assert np.array_equal(again.vertices, ball.vertices)
    assert np.array_equal(again.faces, ball.faces)
    assert told == sorted(told)
    assert told[-1] == 1.0
    for after in (0.05, 0.4, 0.9):

        def on_progress(done: float, last: float = after) -> None:
            if done > last:
                raise Cancelled("stopped")

        with pytest.raises(Cancelled):
            extract(sheet, views, BOUNDS, VOXEL, on_progress)


def test_shells_are_cleaned_and_reduced_as_those_of_other_methods(views: list[DepthView]) -> None:
    shells = [Shell(BOUNDS, VOXEL)]
    few = fuse_shells(views, shells, 1000, method="marching_cubes", density=sheet)  # type: ignore[arg-type]
    assert len(few.faces) == pytest.approx(1000, rel=0.1)
    assert np.abs(away(few.vertices) - 1.0).max() < VOXEL
    with pytest.raises(ValueError, match="density field"):
        fuse_shells(views, shells, 1000, method="marching_cubes")  # type: ignore[arg-type]
