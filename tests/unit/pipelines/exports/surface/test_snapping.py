"""Points of noisy views on a surface that is known exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.cloud import Cloud
from pipelines.exports.surface.shells import Shell
from pipelines.exports.surface.snapping import snapped
from pipelines.exports.surface.surface_file import (
    SURFACE,
    KeptSurface,
    load_surface,
    save_surface,
)
from pipelines.scene.bounds import SceneBounds

FAR = np.array([4.0e6, -2.0e6, 300.0])
"""Where geo-referenced captures lie: float32 knows such places to half a unit."""
VOXEL = 0.1


def _sheet(height: float, up: bool = True) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A level square of side 4 around the origin, 20 x 20 cells."""
    across = np.linspace(-2.0, 2.0, 21)
    x, y = np.meshgrid(across, across, indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])
    first = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([first, first + 21, first + 22]),
            np.column_stack([first, first + 22, first + 1]),
        ]
    )
    return vertices, (faces if up else faces[:, ::-1]).astype(np.int32)


def _kept(folder: Path, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> KeptSurface:
    def shell(radius: float, voxel: float) -> Shell:
        return Shell(SceneBounds(FAR, 1.0, radius, FAR - radius, FAR + radius), voxel)

    nothing = np.zeros_like(vertices)
    mesh = TriangleMesh(vertices + FAR, faces, nothing, nothing)
    save_surface(folder, mesh, [shell(1.0, VOXEL), shell(10.0, 3.0 * VOXEL)])
    kept = load_surface(folder)
    assert kept is not None
    return kept


def _cloud(points: NDArray[np.float64], eye: tuple[float, float, float]) -> Cloud:
    eyes = np.broadcast_to(FAR + np.asarray(eye), points.shape)
    return Cloud.seen(points + FAR, np.zeros((len(points), 3), np.uint8), eyes)


def test_noise_goes_and_normals_are_the_surfaces(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (500, 2)), rng.normal(0.0, 0.04, 500)])
    found = snapped(_cloud(points, (0.0, 1.0, 3.0)), _kept(tmp_path, *_sheet(0.0)))
    local = found.points - FAR
    assert np.abs(local[:, 2]).max() < 1e-6
    # Along the rays, so that each keeps the colour that its pixel saw.
    eye = np.array([0.0, 1.0, 3.0])
    ways, then = points - eye, local - eye
    aside = then - (then * ways).sum(axis=1, keepdims=True) / (ways**2).sum(axis=1)[:, None] * ways
    assert np.abs(aside).max() < 1e-6
    np.testing.assert_allclose(found.normals, np.tile([0.0, 0.0, 1.0], (500, 1)), atol=1e-6)


def test_what_is_farther_than_the_voxels_there_allow_stays(tmp_path: Path) -> None:
    heights = np.array([0.19, 0.21, 0.21, 0.59, 0.61])
    points = np.column_stack([[0.0, 0.0, 1.5, 1.5, 1.5], np.zeros(5), heights])
    found = snapped(_cloud(points, (0.0, 0.0, 3.0)), _kept(tmp_path, *_sheet(0.0)))
    moved = found.normals.any(axis=1)
    # Beyond the inner shell voxels are three times as large.
    np.testing.assert_array_equal(moved, [True, False, True, True, False])
    np.testing.assert_array_equal(found.points[~moved], points[~moved] + FAR)


def test_points_beyond_a_border_are_not_drawn_to_it(tmp_path: Path) -> None:
    aside = np.array([[2.05, 0.0, 0.0], [2.1, 0.0, 0.02], [1.95, 0.0, 0.05]])
    found = snapped(_cloud(aside, (0.0, 0.0, 3.0)), _kept(tmp_path, *_sheet(0.0)))
    np.testing.assert_array_equal(found.normals.any(axis=1), [False, False, True])


def test_something_thin_keeps_both_of_its_sides(tmp_path: Path) -> None:
    above, faces = _sheet(0.05)
    below, turned = _sheet(-0.05, up=False)
    vertices = np.concatenate([above, below])
    surface = _kept(tmp_path, vertices, np.concatenate([faces, turned + len(above)]))
    # Seen from below, and by its noise nearer to the upper side: the lower one is what was seen.
    found = snapped(_cloud(np.array([[0.0, 0.0, 0.02]]), (0.0, 0.0, -3.0)), surface)
    np.testing.assert_allclose((found.points - FAR)[0], [0.0, 0.0, -0.05], atol=1e-6)
    np.testing.assert_allclose(found.normals[0], [0.0, 0.0, -1.0], atol=1e-6)
    # Of what lies above its upper side nobody saw anything from below.
    beyond = np.array([[0.0, 0.0, 0.2]])
    found = snapped(_cloud(beyond, (0.0, 0.0, -3.0)), surface)
    np.testing.assert_array_equal(found.points, beyond + FAR)
    assert not found.normals.any()


def test_what_a_ray_passes_by_goes_to_the_nearest_place(tmp_path: Path) -> None:
    low, high = np.array([[-0.3, 0.0, 0.05]]), (3.0, 0.0, 0.1)
    surface = _kept(tmp_path, *_sheet(0.0))
    found = snapped(_cloud(low, high), surface)
    # At that glance the ray meets the sheet three units farther on.
    np.testing.assert_allclose((found.points - FAR)[0], [-0.3, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.normals[0], [0.0, 0.0, 1.0], atol=1e-6)


def test_it_tells_and_can_be_stopped(tmp_path: Path) -> None:
    def stop(done: float) -> None:
        raise InterruptedError(done)

    with pytest.raises(InterruptedError):
        snapped(_cloud(np.zeros((3, 3)), (0.0, 0.0, 3.0)), _kept(tmp_path, *_sheet(0.0)), stop)


def test_a_folder_without_a_surface_has_none(tmp_path: Path) -> None:
    assert load_surface(tmp_path) is None


def test_the_same_surface_is_the_same_file(tmp_path: Path) -> None:
    files = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        _kept(tmp_path / name, *_sheet(0.0))
        files.append((tmp_path / name / SURFACE).read_bytes())
    assert files[0] == files[1]
