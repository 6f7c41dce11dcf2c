"""Crops: what is inside, and what is told when nothing is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipelines.errors import ExportError
from pipelines.exports.crop import crop_of, cropped, narrowed, surface_in
from pipelines.exports.formats.ply import read_ply
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.options import CropShapeOptions
from pipelines.manifest import RunHooks
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView, Pinhole
from pipelines.workspace import Workspace
from tests.unit.pipelines.exports.formats import solids
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_view
from tests.unit.pipelines.stages import tiny_job

CENTER = np.array([3.0, -2.0, 1.0])
BOUNDS = SceneBounds(CENTER, 3.0, 6.0, CENTER - 1.5, CENTER + 1.5)


def crop(**values: Any) -> Any:
    made = crop_of(CropShapeOptions(**values))
    assert made is not None
    return made


def views() -> list[DepthView]:
    lens = Pinhole(64, 64, 64.0, 64.0, 32.0, 32.0)
    return [sphere_view(lens, pose, CENTER) for pose in ring(6, CENTER)]


@pytest.mark.parametrize(
    ("values", "inside", "outside"),
    [
        ({"shape": "sphere", "radius": 2.0}, (1.9, 0, 0), (1.5, 1.5, 0)),
        ({"shape": "box", "size": (4, 2, 1)}, (1.9, 0.9, 0.4), (1.9, 1.1, 0.4)),
        # Long along x; turned by a quarter about z it is long along y.
        ({"shape": "box", "size": (4, 1, 1), "rotation_deg": (0, 0, 90)}, (0, 1.9, 0), (1.9, 0, 0)),
        # Long along y; about x it comes up, and then about y it stays, about z, too.
        (
            {"shape": "box", "size": (1, 4, 1), "rotation_deg": (90, 0, 90)},
            (0, 0, 1.9),
            (0, 1.9, 0),
        ),
        # x first, then y: long along y comes up to z, and from there to x.
        (
            {"shape": "box", "size": (1, 4, 1), "rotation_deg": (90, 90, 0)},
            (1.9, 0, 0),
            (0, 0, 1.9),
        ),
        # Counter-clockwise: x goes towards y.
        (
            {"shape": "box", "size": (4, 0.2, 1), "rotation_deg": (0, 0, 30)},
            (1.5 * np.cos(np.pi / 6), 1.5 * np.sin(np.pi / 6), 0),
            (1.5 * np.cos(np.pi / 6), -1.5 * np.sin(np.pi / 6), 0),
        ),
    ],
)
def test_what_is_inside(values: dict[str, Any], inside: Any, outside: Any) -> None:
    made = crop(center=tuple(CENTER), **values)
    points = CENTER + np.array([inside, outside, -np.asarray(inside)])
    np.testing.assert_array_equal(made.contains(points), [True, False, True])
    low, high = made.corners()
    assert np.all((low <= points[0]) & (points[0] <= high))


def test_distances_are_those_to_the_nearest_point_inside() -> None:
    box = crop(shape="box", size=(2, 2, 2), rotation_deg=(10, 20, 30), center=(1, 1, 1))
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 5, (60, 3))
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 3, indexing="ij"), -1).reshape(-1, 3)
    filled = box.center + grid @ box.axes.T
    slow = np.sqrt(((points[:, None] - filled[None]) ** 2).sum(-1)).min(axis=1)
    np.testing.assert_allclose(box.distance(points), np.where(slow < 0.045, 0, slow), atol=0.05)
    ball = crop(shape="sphere", radius=2.0, center=(1, 1, 1))
    assert ball.distance(np.array([4.0, 1.0, 1.0])) == pytest.approx(1.0)


def test_no_shape_is_no_crop() -> None:
    assert crop_of(CropShapeOptions(center=(1, 2, 3), radius=0.1)) is None
    assert narrowed(BOUNDS, None) is BOUNDS
    assert len(surface_in(None, views(), BOUNDS, "mesh")) > 1000


def test_bounds_shrink_to_the_crop_and_end_where_it_is_elsewhere() -> None:
    smaller = narrowed(BOUNDS, crop(shape="sphere", center=tuple(CENTER + 1.0), radius=0.75))
    assert smaller is not None
    np.testing.assert_allclose(smaller.box_min, CENTER + 0.25)
    np.testing.assert_allclose(smaller.box_max, CENTER + 1.5)
    assert narrowed(BOUNDS, crop(shape="sphere", center=(90, 0, 0), radius=1.0)) is None


def test_a_mesh_keeps_the_faces_that_are_inside() -> None:
    mesh = solids.coloured()
    low = cropped(mesh, crop(shape="box", center=(0, 0, 0), size=(8, 8, 2)))
    np.testing.assert_array_equal(low.faces, [[0, 2, 1]])
    np.testing.assert_array_equal(low.vertices, solids.VERTICES[:3])
    np.testing.assert_array_equal(low.colors, solids.COLORS[:3])
    none = cropped(mesh, crop(shape="sphere", center=(50, 0, 0)))
    assert isinstance(none, TriangleMesh)
    assert len(none.faces) == len(none.vertices) == 0


def test_a_crop_beside_the_surface_says_how_much_lies_outside_and_where() -> None:
    beside = crop(shape="sphere", center=tuple(CENTER + np.array([2.0, 0, 0])), radius=0.5)
    with pytest.raises(ExportError) as caught:
        surface_in(beside, views(), BOUNDS, "mesh")
    error = caught.value
    assert error.code == "export.empty"
    assert error.details["num_outside"] == error.details["num_points"] > 1000
    assert error.details["nearest_outside"] == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(error.details["surface_max"], CENTER + 1.0, atol=0.2)
    assert "mesh.crop" in error.hint


def test_a_crop_finer_than_the_small_views_is_not_taken_for_empty() -> None:
    on_it = crop(shape="sphere", center=tuple(CENTER + np.array([1.0, 0, 0])), radius=0.004)
    assert len(surface_in(on_it, views(), BOUNDS, "mesh")) > 1000


@pytest.mark.parametrize("kind", ["mesh", "pointcloud"])
def test_an_export_keeps_to_its_crop(job: Workspace, kind: str) -> None:
    focus = np.asarray(tiny_job.run(job, kind)["summary"]["bounds"]["focus"])
    before = _points(job, kind)
    shape = {"shape": "box", "center": focus.tolist(), "size": [1.2, 0.8, 3.0]}
    turned = {**shape, "rotation_deg": [0.0, 0.0, 40.0]}
    summary = tiny_job.run(job, kind, crop=turned)["summary"]
    kept = _points(job, kind)
    assert crop(**turned).distance(kept).max() < 1e-5
    assert crop(**turned).contains(before).mean() < 0.9
    assert len(kept) > 20
    assert summary["bounds"]["box_max"][0] < before[:, 0].max()
    if kind == "pointcloud":
        inside = crop(**turned).contains(before).sum()
        assert len(kept) > 1.5 * inside, "the points that are wanted are looked for in the crop"


@pytest.mark.parametrize("kind", ["mesh", "pointcloud"])
def test_an_export_of_nothing_ends_before_anything_is_rendered(job: Workspace, kind: str) -> None:
    elsewhere = {"shape": "sphere", "center": [0.0, 0.0, 300.0], "radius": 1.0}
    told: list[str] = []
    hooks = RunHooks(on_progress=lambda fraction, message, eta_s: told.append(message))
    with pytest.raises(ExportError) as caught:
        tiny_job.run_with(job, kind, hooks, crop=elsewhere)
    assert caught.value.code == "export.empty"
    assert caught.value.details["nearest_outside"] > 200
    assert not [message for message in told if message.startswith("view ")]
    assert not job.stage(kind).exists()


def _points(job: Workspace, kind: str) -> np.ndarray:
    return read_ply(job.stage(kind) / f"{kind}.ply").points.astype(np.float64)
