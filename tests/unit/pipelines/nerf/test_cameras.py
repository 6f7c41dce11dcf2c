"""Rays and projections against each other, by hand, and against OpenCV's formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.cameras import Cameras, SceneTransform, reduced_size
from pipelines.nerf.errors import NerfError
from pipelines.nerf.lenses import distort, undistort
from tests.unit.pipelines.nerf.toy_scene import look_at

IDENTITY = np.hstack([np.eye(3), np.zeros((3, 1))])
UNIT = SceneTransform((0.0, 0.0, 0.0), 1.0)


def _camera(
    model: str = "PINHOLE",
    terms: tuple[float, ...] = (0.0,) * 6,
    pose: np.ndarray = IDENTITY,
    scene: SceneTransform = UNIT,
) -> Cameras:
    return Cameras.from_arrays(
        world_from_camera=pose[None],
        scene=scene,
        widths=[640],
        heights=[480],
        focal=[[500.0, 510.0]],
        principal=[[322.0, 238.0]],
        models=[model],
        distortion=[terms],
    )


LENSES = (
    ("PINHOLE", (0.0,) * 6),
    ("OPENCV", (-0.12, 0.05, 0.01, -0.002, 0.003, -0.004)),
    ("OPENCV_FISHEYE", (0.03, -0.01, 0.004, -0.001, 0.0, 0.0)),
)


def test_the_axis_points_along_minus_z_and_pixels_follow_opengl() -> None:
    rays = _camera().generate_rays(
        torch.zeros(3, dtype=torch.int64),
        torch.tensor([[322.0, 238.0], [822.0, 238.0], [322.0, 748.0]]),
    )
    root = math.sqrt(0.5)
    expected = torch.tensor([[0.0, 0.0, -1.0], [root, 0.0, -root], [0.0, -root, -root]])
    assert torch.allclose(rays.directions, expected, atol=1e-6)


@pytest.mark.parametrize(("model", "terms"), LENSES)
def test_projecting_points_on_rays_gives_the_pixels_back(
    model: str, terms: tuple[float, ...]
) -> None:
    pose = look_at(np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.0, 0.2]))
    camera = _camera(model, terms, pose)
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(300, 2, generator=generator) * torch.tensor([640.0, 480.0])
    index = torch.zeros(300, dtype=torch.int64)
    rays = camera.generate_rays(index, pixels)
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(300), atol=1e-6)
    distance = 0.5 + 3.0 * torch.rand(300, 1, generator=generator)
    back, depth = camera.project(rays.origins + distance * rays.directions, index)
    assert torch.allclose(back, pixels, atol=2e-2)
    assert bool((depth > 0).all())


def test_opencv_distortion_follows_its_formula() -> None:
    x, y, k1, k2, k3, p1, p2 = 0.3, -0.2, -0.12, 0.05, 0.01, 0.003, -0.004
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    shown = distort(
        torch.tensor([[x, y, 1.0]], dtype=torch.float64),
        torch.tensor([[k1, k2, k3, 0.0, p1, p2]], dtype=torch.float64),
        torch.tensor([False]),
    )
    assert torch.allclose(shown, torch.tensor([expected], dtype=torch.float64))


def test_fisheye_follows_its_formula_also_beyond_ninety_degrees() -> None:
    theta, k1 = 1.7, 0.02
    direction = torch.tensor([[math.sin(theta), 0.0, math.cos(theta)]], dtype=torch.float64)
    terms = torch.tensor([[k1, 0, 0, 0, 0, 0]], dtype=torch.float64)
    shown = distort(direction, terms, torch.tensor([True]))
    bent = theta * (1 + k1 * theta**2)
    assert torch.allclose(shown, torch.tensor([[bent, 0.0]], dtype=torch.float64))
    assert torch.allclose(undistort(shown, terms, torch.tensor([True])), direction, atol=1e-9)


def test_undistortion_beyond_a_lens_that_folds_over_stays_finite() -> None:
    far = torch.tensor([[3.0, 2.0], [-5.0, 1.0]])
    terms = torch.tensor([[-0.5, 0.1, 0.0, 0.0, 0.0, 0.0]]).expand(2, 6)
    assert bool(undistort(far, terms, torch.tensor([False, False])).isfinite().all())


def test_a_mixed_batch_uses_each_cameras_own_lens() -> None:
    pixels = torch.tensor([[600.0, 400.0]] * 3)
    mixed = Cameras.from_arrays(
        world_from_camera=np.stack([IDENTITY] * 3),
        scene=UNIT,
        widths=[640] * 3,
        heights=[480] * 3,
        focal=[[500.0, 510.0]] * 3,
        principal=[[322.0, 238.0]] * 3,
        models=[model for model, _ in LENSES],
        distortion=[terms for _, terms in LENSES],
    )
    rays = mixed.generate_rays(torch.arange(3), pixels)
    for row, (model, terms) in enumerate(LENSES):
        alone = _camera(model, terms).generate_rays(torch.tensor([0]), pixels[:1])
        assert torch.allclose(rays.directions[row], alone.directions[0], atol=1e-6)


def test_pixel_areas_add_up_to_the_solid_angle_of_the_image() -> None:
    camera = _camera().resized(64)
    grid = camera.image_rays(0)
    width, height = camera.size[0].tolist()
    x, y = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    pixels = torch.stack([x, y], -1).reshape(-1, 2)
    rays = camera.generate_rays(grid.camera_indices, pixels, with_pixel_area=True)
    assert torch.equal(rays.directions, grid.directions)
    assert rays.pixel_area is not None
    # Solid angle of the rectangle between the four image edges.
    (fx, fy), (cx, cy) = camera.focal[0].tolist(), camera.principal[0].tolist()
    total = 0.0
    for a, sign_a in (((width - cx) / fx, 1), (-cx / fx, -1)):
        for b, sign_b in (((height - cy) / fy, 1), (-cy / fy, -1)):
            total += sign_a * sign_b * math.atan(a * b / math.sqrt(1 + a * a + b * b))
    assert math.isclose(float(rays.pixel_area.sum()), total, rel_tol=0.02)


def test_resizing_keeps_the_directions_of_image_corners() -> None:
    camera = _camera()
    small = camera.resized(100)
    assert small.size.tolist() == [[100, 75]]
    index = torch.zeros(2, dtype=torch.int64)
    corners = torch.tensor([[0.0, 0.0], [640.0, 480.0]])
    shrunk = torch.tensor([[0.0, 0.0], [100.0, 75.0]])
    assert torch.allclose(
        camera.generate_rays(index, corners).directions,
        small.generate_rays(index, shrunk).directions,
        atol=1e-6,
    )
    assert camera.resized(5000).size.tolist() == [[640, 480]]


def test_reduced_size_never_enlarges() -> None:
    assert reduced_size(1080, 1920, 480) == (270, 480)
    assert reduced_size(300, 200, 480) == (300, 200)


def test_scene_transform_keeps_millimetres_at_geographic_offsets() -> None:
    offset = np.array([4_500_000.0, 600_000.0, 300.0])
    centers = offset + np.array([[0.0, 0, 0], [2.0, 0, 0], [0, 4.0, 0], [0, 0, 1.0]])
    scene = SceneTransform.fit(centers)
    poses = np.stack([np.hstack([np.eye(3), center[:, None]]) for center in centers])
    cameras = Cameras.from_arrays(
        world_from_camera=poses,
        scene=scene,
        widths=[64] * 4,
        heights=[48] * 4,
        focal=[[50.0, 50.0]] * 4,
        principal=[[32.0, 24.0]] * 4,
    )
    origins = cameras.scene_from_camera[:, :, 3]
    assert float(origins.abs().max()) == pytest.approx(1.0, abs=1e-6)
    back = scene.world_from_scene(origins.numpy())
    assert np.abs(back - centers).max() < 1e-3
    assert np.allclose(scene.world_from_scene(scene.scene_from_world(centers)), centers)


def test_scene_of_cameras_in_one_place_keeps_its_scale() -> None:
    assert SceneTransform.fit(np.ones((3, 3))) == SceneTransform((1.0, 1.0, 1.0), 1.0)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"models": ["THIN_PRISM"]}, "THIN_PRISM"),
        ({"focal": [[500.0, 0.0]]}, "not positive"),
        ({"world_from_camera": 2.0 * IDENTITY[None]}, "rotation"),
        ({"world_from_camera": np.full((1, 3, 4), np.nan)}, "not finite"),
        ({"principal": [[1.0, 2.0, 3.0]]}, "principal"),
    ],
)
def test_unusable_cameras_are_refused(change: dict[str, object], problem: str) -> None:
    values: dict[str, object] = {
        "world_from_camera": IDENTITY[None],
        "scene": UNIT,
        "widths": [640],
        "heights": [480],
        "focal": [[500.0, 500.0]],
        "principal": [[320.0, 240.0]],
    }
    with pytest.raises(NerfError, match=problem):
        Cameras.from_arrays(**{**values, **change})  # type: ignore[arg-type]
