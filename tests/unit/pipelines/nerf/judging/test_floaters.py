"""Floater measures in a scene traced in closed form, see `floating_scene`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.floaters import (
    FloaterReport,
    floater_measures,
    inconsistent_points,
    near_distance,
    near_mass,
    opacity_of_density,
    surface_depth,
)
from pipelines.nerf.judging.off_path import off_path_cameras, view_targets
from pipelines.nerf.space.cameras import Cameras
from tests.unit.pipelines.nerf.judging.floating_scene import (
    FOCAL,
    FOG,
    HEIGHT,
    LN2,
    RING,
    RISE,
    SCENE,
    WIDTH,
    Picture,
    Scene,
    cameras_of,
    look_at,
    planted,
    ring_cameras,
)


@pytest.fixture(scope="module")
def ring() -> Cameras:
    return ring_cameras()


@pytest.fixture(scope="module")
def off_path(ring: Cameras) -> Cameras:
    return off_path_cameras(ring, view_targets(ring), 6, seed=0)


def measured(scene: Scene, views: Cameras, training: Cameras) -> FloaterReport:
    targets = view_targets(training)
    return floater_measures(
        scene.render_rays, views, training, targets, scene.opacity_before, SCENE.scale
    )


def expected_inconsistency(scene: Scene, views: Cameras, num_rays: int = 5000) -> float:
    """The measure without pictures: random rays, and the exact depth along each line of sight."""
    generator = torch.Generator().manual_seed(1)
    free = counted = 0
    for b in range(len(views)):
        pixels = torch.rand((num_rays, 2), generator=generator) * torch.tensor([WIDTH, HEIGHT])
        rays = views.generate_rays(torch.full((num_rays,), b), pixels)
        origins, ways = rays.origins.double(), rays.directions.double()
        depth = scene.median_depth(origins, ways)[:, None]
        points, behind = origins + ways * depth, origins + 1.01 * ways * depth
        for a in range(len(views)):
            if a == b:
                continue
            pose = views.scene_from_camera[a].double()
            toward = points - pose[:, 3]
            local = toward @ pose[:, :3]
            ahead = local[:, 2] < 0.0
            x, y = local[:, 0] / -local[:, 2] * FOCAL, local[:, 1] / -local[:, 2] * FOCAL
            inside = ahead & (x.abs() < WIDTH / 2) & (y.abs() < HEIGHT / 2)
            both = torch.ones(int(inside.sum()), dtype=torch.bool)
            for place in (points[inside], behind[inside]):
                distance = (place - pose[:, 3]).norm(dim=-1)
                line = (place - pose[:, 3]) / distance[:, None]
                both &= distance < 0.95 * scene.median_depth(pose[:, 3].expand_as(place), line)
            free += int(both.sum())
            counted += int(inside.sum())
    return free / counted


def disc_share(radius: float, ahead: float) -> float:
    """Share of a picture that an opaque ball on its axis covers: a disc of radius f tan(alpha)."""
    tangent = radius / math.sqrt(ahead**2 - radius**2)
    return math.pi * (FOCAL * tangent) ** 2 / (WIDTH * HEIGHT)


def fog_share(radius: float, ahead: float, kappa: float) -> float:
    """Mean opacity over the picture of a ball of fog on its axis, integrated over the angle."""
    theta = np.linspace(0.0, math.asin(radius / ahead), 20_001)
    half = np.sqrt(np.clip(1.0 - (ahead * np.sin(theta) / radius) ** 2, 0.0, None))
    ring_area = 2.0 * np.pi * FOCAL**2 * np.tan(theta) / np.cos(theta) ** 2
    return float(np.trapezoid((1.0 - np.exp(-kappa * half)) * ring_area, theta)) / (WIDTH * HEIGHT)


def test_solid_scene_has_neither_however_much_its_parts_hide_each_other(
    ring: Cameras, off_path: Cameras
) -> None:
    columns = [(0.9, 0.5, 0.0, 0.3), (-0.8, 0.7, 0.2, 0.15), (0.1, -1.0, -0.2, 0.25)]
    crowded = Scene(solids=[(0.0, 0.0, 0.0, 0.4), *columns])
    views = [off_path.image_rays(index) for index in range(len(off_path))]
    depths = [crowded.render_rays(view.origins, view.directions).depth for view in views]
    bare = [Scene().render_rays(view.origins, view.directions).depth for view in views]
    hidden = np.mean([(d < 0.95 * e).mean() for d, e in zip(depths, bare, strict=True)])
    assert hidden > 0.03, "the columns hide something"
    for scene in (Scene(), crowded):
        report = measured(scene, off_path, ring)
        assert report.depth_inconsistency is not None
        assert report.depth_inconsistency <= 1e-4
        assert report.near_mass == 0.0
        assert report.details["num_points"] > 30_000


def test_soft_outlines_are_no_floaters(ring: Cameras, off_path: Cameras) -> None:
    """A thing whose light is half gone only after 0.014: a trained surface, not a solid."""
    soft = Scene(solids=[], floaters=[(0.0, 0.0, 0.0, 0.4)], kappa=40.0)
    report = measured(soft, off_path, ring)
    assert report.depth_inconsistency is not None
    assert report.depth_inconsistency <= 1e-4


def test_fog_makes_both_worse_as_its_geometry_says(ring: Cameras, off_path: Cameras) -> None:
    inconsistencies, masses = [0.0], [0.0]
    for radius in (0.08, 0.12, 0.16):
        scene = Scene(floaters=planted(radius))
        report = measured(scene, off_path, ring)
        assert report.depth_inconsistency is not None
        inconsistencies.append(report.depth_inconsistency)
        masses.append(report.near_mass)
        exact = expected_inconsistency(scene, off_path)
        assert exact > 1e-3
        # Some seventy points of the smallest are seen through: an eighth is one deviation.
        assert math.isclose(inconsistencies[-1], exact, rel_tol=0.25)
        assert math.isclose(masses[-1], fog_share(radius, 0.45, FOG), rel_tol=0.05)
    assert inconsistencies == sorted(inconsistencies)
    assert masses == sorted(masses)
    assert inconsistencies[-1] > 3.0 * inconsistencies[1]
    assert masses[-1] > 3.9 * masses[1]


def test_solid_floaters_are_for_the_near_mass_to_find(ring: Cameras, off_path: Cameras) -> None:
    """What every view sees alike is a thing like any other to depth consistency."""
    scene = Scene(floaters=planted(0.08), kappa=1e5)
    report = measured(scene, off_path, ring)
    assert report.depth_inconsistency is not None
    assert report.depth_inconsistency <= 1e-4
    assert math.isclose(report.near_mass, disc_share(0.08, 0.45), rel_tol=0.05)
    for radius in (0.04, 0.16):
        solid = Scene(floaters=planted(radius), kappa=1e5)
        mass = near_mass(ring, solid.opacity_before, near_distance(view_targets(ring)), lattice=64)
        expected = disc_share(radius, 0.45)
        assert math.isclose(float(mass.mean()), expected, rel_tol=0.02)


def seen_through_share(kappa: float, away: float) -> float:
    """Of the pixels that a fog ball of radius 1 covers, the share that counts from a right angle.

    Parallel rays. B looks along w and A along u, from `away`. In a chord of half-length h the
    median lies at -h + 2 ln 2 / kappa, where kappa h >= ln 2; else the ray goes through.
    """
    grid = np.linspace(-1.0, 1.0, 2001)
    u, v = np.meshgrid(grid, grid)
    half = np.sqrt(np.clip(1.0 - u**2 - v**2, 0.0, None))
    w = -half + 2.0 * LN2 / kappa
    free = np.ones_like(w, dtype=bool)
    for place in (w, w + 0.01 * (away + w)):
        other = np.sqrt(np.clip(1.0 - v**2 - place**2, 0.0, None))
        median = np.where(kappa * other >= LN2, away - other + 2.0 * LN2 / kappa, np.inf)
        free &= away + u < 0.95 * median
    return float((free & (kappa * half >= LN2))[u**2 + v**2 <= 1.0].mean())


@pytest.mark.parametrize("kappa", [0.8, 1.0, 1.5, 2.5])
def test_share_of_one_ball_at_right_angles_follows_from_its_thickness(kappa: float) -> None:
    radius, away = 0.2, 2.5
    scene = Scene(solids=[], floaters=[(0.0, 0.0, 0.0, radius)], kappa=kappa, ground=-5.0)
    poses = [look_at(np.array(p), np.zeros(3)) for p in ([away, 0.0, 0.0], [0.0, away, 0.0])]
    tight = cameras_of(poses, focal=300.0)
    depth_of = surface_depth(scene.render_rays, SCENE.scale)
    seen_through, _ = inconsistent_points(tight, depth_of)
    pixels = math.pi * (300.0 * radius / math.sqrt(away**2 - radius**2)) ** 2
    expected = pixels * seen_through_share(kappa, away / radius)
    for count in (int(seen_through[0, 1]), int(seen_through[1, 0])):
        assert math.isclose(count, expected, rel_tol=0.1, abs_tol=8.0)


def test_near_mass_ends_at_its_distance(ring: Cameras) -> None:
    """Half a ball of fog: the chord up to the plane through its middle is half the whole one."""
    scene = Scene(solids=[], floaters=[(0.0, 0.0, 0.0, 0.02)], kappa=2.0)
    looking = cameras_of([look_at(np.array([1.0, 0.0, 0.0]), np.zeros(3))], focal=4000.0)
    for distance, kappa in ((0.9, 0.0), (1.0, 1.0), (1.1, 2.0)):
        mass = float(near_mass(looking, scene.opacity_before, distance, lattice=1))
        assert math.isclose(mass, 1.0 - math.exp(-kappa), abs_tol=1e-3)


def test_points_behind_a_camera_do_not_count() -> None:
    """Back to back in the middle of the shell: whatever one shows lies behind the other."""
    scene = Scene(solids=[], ground=-5.0)
    center = np.zeros(3)
    away = [look_at(center, np.array(p)) for p in ([5.0, 0.0, 0.0], [-5.0, 0.0, 0.0])]
    depth_of = surface_depth(scene.render_rays, SCENE.scale)
    _, counted = inconsistent_points(cameras_of(away), depth_of)
    assert counted.tolist() == [[0, 0], [0, 0]]
    twice = cameras_of([away[0], away[0]])
    seen_through, counted = inconsistent_points(twice, depth_of)
    assert counted.tolist() == [[0, WIDTH * HEIGHT], [WIDTH * HEIGHT, 0]]
    assert seen_through.sum() == 0


def test_rays_without_a_surface_show_no_point_and_see_through_all_that_others_show() -> None:
    """A camera that sees nothing sees through every point that the other shows."""
    pose = look_at(np.array([2.0, 0.0, 0.0]), np.zeros(3))
    near = look_at(np.array([1.9, 0.0, 0.0]), np.zeros(3))
    views = cameras_of([pose, near])
    blind = views.scene_from_camera[1, :, 3]

    def render_rays(origins: Tensor, ways: Tensor) -> Picture:
        seen = Scene().render_rays(origins, ways)
        nothing = ((origins - blind).norm(dim=-1) < 1e-6).numpy()
        return Picture(seen.depth, np.where(nothing, 0.3, 1.0).astype(np.float32))

    seen_through, counted = inconsistent_points(views, surface_depth(render_rays, SCENE.scale))
    assert counted[0, 1] == 0
    assert counted[1, 0] > 2000
    assert seen_through[1, 0] == counted[1, 0]


def test_world_units_change_nothing_but_the_reported_distance(
    ring: Cameras, off_path: Cameras
) -> None:
    scene = Scene(floaters=planted(0.1))

    def tenfold(origins: Tensor, ways: Tensor) -> Picture:
        picture = scene.render_rays(origins, ways)
        return Picture(picture.depth * np.float32(10.0), picture.accumulation)

    one = measured(scene, off_path, ring)
    ten = floater_measures(
        tenfold, off_path, ring, view_targets(ring), scene.opacity_before, SCENE.scale / 10.0
    )
    assert ten.depth_inconsistency == pytest.approx(one.depth_inconsistency, rel=0.02)
    assert ten.near_mass == one.near_mass
    world = 0.3 * math.hypot(RING, RISE) / SCENE.scale
    assert math.isclose(one.details["near_distance_world"], world, rel_tol=1e-5)
    assert math.isclose(ten.details["near_distance_world"], 10.0 * world, rel_tol=1e-5)


def test_one_view_is_refused(ring: Cameras) -> None:
    with pytest.raises(NerfError, match="compares views"):
        measured(Scene(), ring.select([0]), ring)


def test_opacity_of_a_density_is_that_of_its_integral() -> None:
    """Density 3 x along the ray from the origin in +X: thickness 3 (t^2 - near^2) / 2."""
    origins = torch.zeros(2, 3, dtype=torch.float64)
    ways = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    before = opacity_of_density(lambda places: 3.0 * places[:, 0], near=0.2, num_samples=16)
    found = before(origins, ways, 0.8)
    # Midpoints are exact for a density that is linear along the ray.
    assert torch.allclose(found, torch.tensor([1.0 - math.exp(-0.9), 0.0]).double(), atol=1e-12)
    assert torch.equal(before(origins, ways, 0.1), torch.zeros(2).double())
