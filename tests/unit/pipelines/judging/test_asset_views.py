"""Meshes and clouds from a camera: closed forms, real lenses, what lies in front."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.judging import asset_views
from pipelines.judging.asset_views import (
    MAX_RADIUS_PX,
    MeshCaster,
    cloud_view,
    point_spacing,
)
from tests.unit.pipelines.judging.scenes import (
    BENT,
    DISTANCE,
    SIDE,
    camera,
    color_at,
    wall,
)


def test_a_wall_is_seen_where_its_formula_says() -> None:
    vertices, faces, colors = wall()
    view = MeshCaster(vertices, faces, colors).view(camera(), 0)
    assert view.hit.all()
    steps = (np.arange(SIDE) + 0.5 - 32.0) / 64.0
    x, y = np.meshgrid(steps * DISTANCE, -steps * DISTANCE)
    assert view.color == pytest.approx(color_at(x, y), abs=1e-5)
    expected = DISTANCE * np.sqrt(1 + (x / DISTANCE) ** 2 + (y / DISTANCE) ** 2)
    assert view.distance == pytest.approx(expected, rel=1e-5)
    assert view.z_depth(camera(), 0) == pytest.approx(np.full((SIDE, SIDE), DISTANCE), rel=1e-5)


def test_rays_are_those_of_the_bent_lens() -> None:
    vertices, faces, colors = wall(half=4.0)
    cameras = camera(BENT)
    view = MeshCaster(vertices, faces, colors).view(cameras, 0)
    rays = cameras.image_rays(0)
    met = (rays.directions * (-DISTANCE / rays.directions[:, 2:])).numpy().reshape(SIDE, SIDE, 3)
    assert view.color == pytest.approx(color_at(met[..., 0], met[..., 1]), abs=1e-4)
    straight = MeshCaster(vertices, faces, colors).view(camera(), 0)
    # A pinhole would be wrong by a visible amount towards the corners.
    assert np.abs(view.color[0, 0] - straight.color[0, 0]).max() > 0.02
    assert view.color[32, 32] == pytest.approx(straight.color[32, 32], abs=1e-3)


def test_several_rays_a_pixel_show_the_mean_over_it() -> None:
    # A black stripe 2.6 px wide on white: whole pixels would make it 2 or 3 px wide.
    half = 1.3 / 64.0 * DISTANCE
    wide, faces, _ = wall()
    strip, strip_faces, _ = wall(half=half, distance=DISTANCE * 0.999)
    strip[:, 1] *= 50.0
    vertices = np.concatenate([wide, strip])
    colors = np.concatenate([np.ones((len(wide), 3)), np.zeros((len(strip), 3))])
    caster = MeshCaster(vertices, np.concatenate([faces, strip_faces + len(wide)]), colors)
    dark = [
        float((1.0 - caster.view(camera(), 0, samples).color[32, :, 0]).sum())
        for samples in (1, 2, 8)
    ]
    assert dark[0] in (2.0, 4.0)
    assert abs(dark[2] - 2.6) <= abs(dark[1] - 2.6) < abs(dark[0] - 2.6)
    assert dark[2] == pytest.approx(2.6, abs=0.15)
    fine = caster.view(camera(), 0, 2)
    assert fine.z_depth(camera(), 0)[2, 2] == pytest.approx(DISTANCE, rel=2e-2)


@pytest.mark.parametrize("samples", [1, 2])
def test_strips_show_what_the_whole_shows(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces, colors = wall(hole=0.5)
    caster = MeshCaster(vertices, faces, colors)
    whole = caster.view(camera(BENT), 0, samples)
    monkeypatch.setattr(asset_views, "_MOST_RAYS", 7 * SIDE * samples * samples)
    strips = caster.view(camera(BENT), 0, samples)
    for one, other in zip(vars(whole).values(), vars(strips).values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_pixel_is_hit_where_half_of_its_rays_are() -> None:
    for share, hit in ((0.3, False), (0.7, True)):
        # The wall ends within pixel 40.
        vertices, faces, colors = wall()
        edge = (40 + share - 32.0) / 64.0 * DISTANCE
        vertices = np.column_stack([np.minimum(vertices[:, 0], edge), vertices[:, 1:]])
        view = MeshCaster(vertices, faces, colors).view(camera(), 0, 8)
        assert view.hit[32, 39]
        assert view.hit[32, 40] == hit
        assert not view.hit[32, 41]
        assert (view.distance > 0).tolist() == view.hit.tolist()


def test_the_nearer_of_two_walls_and_its_back_are_seen_and_holes_are_not() -> None:
    near, near_faces, _ = wall(half=0.3, distance=1.0)
    far, far_faces, _ = wall(hole=0.5)
    vertices = np.concatenate([near, far])
    faces = np.concatenate([near_faces[:, ::-1], far_faces + len(near)])
    view = MeshCaster(vertices, faces, None).view(camera(), 0)
    z = view.z_depth(camera(), 0)
    assert z[32, 32] == pytest.approx(1.0, rel=1e-5)
    assert z[2, 2] == pytest.approx(DISTANCE, rel=1e-5)
    # Without the near wall one looks through the hole: 1 of 2 units wide at a distance of 2.
    through = MeshCaster(far, far_faces, None).view(camera(), 0)
    assert 1.0 - through.hit.mean() == pytest.approx(0.25, abs=0.01)
    assert (through.distance[~through.hit] == 0).all()
    with pytest.raises(ValueError, match="without faces"):
        MeshCaster(far, np.zeros((0, 3), int), None)


def test_spacing_is_the_step_of_a_lattice_and_bounded_for_lone_points() -> None:
    # Triangular lattice: six neighbours at one step.
    i, j = np.meshgrid(np.arange(30), np.arange(30))
    points = np.stack([i + 0.5 * j, np.sqrt(0.75) * j, np.zeros_like(i)], axis=-1).reshape(-1, 3)
    spacing = point_spacing(0.02 * points)
    inner = (i > 1) & (i < 28) & (j > 1) & (j < 28)
    assert spacing[inner.ravel()] == pytest.approx(0.02, rel=1e-4)
    lone = np.concatenate([0.02 * points, [[5.0, 5.0, 5.0]]])
    assert point_spacing(lone)[-1] == pytest.approx(3 * np.median(point_spacing(lone)), rel=1e-5)
    assert point_spacing(np.zeros((1, 3))).tolist() == [0.0]


def test_a_dense_cloud_covers_its_wall_and_shows_its_colours() -> None:
    random = np.random.default_rng(0)
    points = np.column_stack([random.uniform(-1.4, 1.4, (20_000, 2)), np.full(20_000, -DISTANCE)])
    colors = color_at(points[:, 0], points[:, 1])
    view = cloud_view(points, colors, point_spacing(points), camera(), 0)
    assert view.hit.mean() > 0.98
    steps = (np.arange(SIDE) + 0.5 - 32.0) / 64.0
    x, y = np.meshgrid(steps * DISTANCE, -steps * DISTANCE)
    assert np.abs(view.color - color_at(x, y))[view.hit].mean() < 0.02
    # One point in ten, as large as before, leaves holes; as large as its own spacing, few.
    few, spacing = points[::10], point_spacing(points)[::10]
    assert cloud_view(few, colors[::10], spacing, camera(), 0).hit.mean() < 0.7
    assert cloud_view(few, colors[::10], point_spacing(few), camera(), 0).hit.mean() > 0.93


def test_the_splat_equals_a_slow_loop_over_points_and_pixels() -> None:
    random = np.random.default_rng(1)
    points = random.uniform(-0.5, 0.5, (25, 3)) - [0, 0, 2.0]
    colors, radius = random.random((25, 3)), random.uniform(0.0, 0.3, 25)
    view = cloud_view(points, colors, radius, camera(), 0)
    best, owner = np.full((SIDE, SIDE), np.inf), np.full((SIDE, SIDE), -1)
    for number, (point, size) in enumerate(zip(points, radius, strict=True)):
        u, v = 32 - 64 * point[0] / point[2], 32 + 64 * point[1] / point[2]
        if not (0 <= u < SIDE and 0 <= v < SIDE):
            continue
        side = min(max(64 * size / -point[2], 0.5), MAX_RADIUS_PX)
        for row in range(SIDE):
            for column in range(SIDE):
                drawn = np.hypot(column + 0.5 - u, row + 0.5 - v) <= side
                drawn |= (int(u), int(v)) == (column, row)
                if drawn and np.linalg.norm(point) < best[row, column]:
                    best[row, column], owner[row, column] = np.linalg.norm(point), number
    assert np.array_equal(view.hit, owner >= 0)
    assert view.color[view.hit] == pytest.approx(colors[owner[view.hit]], abs=1e-6)
    assert view.distance[view.hit] == pytest.approx(best[view.hit], rel=1e-5)


def test_points_behind_the_camera_or_the_fold_of_its_lens_are_not_drawn() -> None:
    behind = np.array([[0.0, 0.0, 2.0]])
    one, radius = np.ones((1, 3)), np.full(1, 0.1)
    assert not cloud_view(behind, one, radius, camera(), 0).hit.any()
    # 62 degrees from the axis the formula of this lens has folded back into the picture.
    folding = replace(BENT, k2=0.0)
    aside = np.array([[-1.9 * 2.0, 0.0, -2.0]])
    pixel, _ = camera(folding).project(
        torch.from_numpy(aside).float(), torch.zeros(1, dtype=torch.int64)
    )
    assert 0 <= float(pixel[0, 0]) < SIDE
    assert not cloud_view(aside, one, radius, camera(folding), 0).hit.any()
