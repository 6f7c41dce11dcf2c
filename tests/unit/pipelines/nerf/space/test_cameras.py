"""Rays and projections against each other, by hand, and against OpenCV's formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.cameras import Cameras, SceneTransform, panorama_intrinsics, reduced_size
from pipelines.nerf.space.lenses import FISHEYE, MAX_STEPS, OPENCV, distort, undistort
from tests.unit.pipelines.nerf.toy_scene import look_at

IDENTITY = np.hstack([np.eye(3), np.zeros((3, 1))])
UNIT = SceneTransform((0.0, 0.0, 0.0), 1.0)


PERSPECTIVE = ((500.0, 510.0), (322.0, 238.0))
PANORAMA = panorama_intrinsics(640, 480)


def _cameras(
    models: tuple[str, ...],
    terms: tuple[tuple[float, ...], ...],
    pose: np.ndarray = IDENTITY,
    times: list[float] | None = None,
) -> Cameras:
    """Pictures of 640 x 480 px from one place."""
    num = len(models)
    lenses = [PANORAMA if model == "EQUIRECTANGULAR" else PERSPECTIVE for model in models]
    return Cameras.from_arrays(
        world_from_camera=np.stack([pose] * num),
        scene=UNIT,
        widths=[640] * num,
        heights=[480] * num,
        focal=[focal for focal, _ in lenses],
        principal=[principal for _, principal in lenses],
        models=models,
        distortion=terms,
        times=times,
    )


def _camera(
    model: str = "PINHOLE", terms: tuple[float, ...] = (0.0,) * 6, pose: np.ndarray = IDENTITY
) -> Cameras:
    return _cameras((model,), (terms,), pose)


def _double(cameras: Cameras, pose: np.ndarray) -> Cameras:
    """The same cameras in float64, with a pose that was never rounded and all Newton steps."""
    return replace(
        cameras,
        scene_from_camera=torch.from_numpy(np.stack([pose] * len(cameras))),
        focal=cameras.focal.double(),
        principal=cameras.principal.double(),
        distortion=cameras.distortion.double(),
        inverse_steps=MAX_STEPS,
    )


LENSES = (
    ("PINHOLE", (0.0,) * 6),
    ("OPENCV", (-0.12, 0.05, 0.01, -0.002, 0.003, -0.004)),
    ("OPENCV_FISHEYE", (0.03, -0.01, 0.004, -0.001, 0.0, 0.0)),
    ("EQUIRECTANGULAR", (0.0,) * 6),
)
MIXED = _cameras(tuple(model for model, _ in LENSES), tuple(terms for _, terms in LENSES))


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
    camera = _double(_camera(model, terms, pose), pose)
    generator = torch.Generator().manual_seed(0)
    span = torch.tensor([640.0, 480.0], dtype=torch.float64)
    pixels = torch.rand(1000, 2, generator=generator, dtype=torch.float64) * span
    index = torch.zeros(1000, dtype=torch.int64)
    rays = camera.generate_rays(index, pixels)
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones_like(pixels[:, 0]))
    distance = 10.0 ** (4.0 * torch.rand(1000, 1, generator=generator, dtype=torch.float64) - 1.0)
    back, depth = camera.project(rays.origins + distance * rays.directions, index)
    assert torch.allclose(back, pixels, rtol=0.0, atol=1e-8)
    axis = torch.from_numpy(-pose[:, 2])
    assert torch.allclose(depth, distance[:, 0] * (rays.directions @ axis), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("model", "terms"),
    [("OPENCV_FISHEYE", (0.01, 0.002, 0.0, 0.0, 0.0, 0.0)), ("EQUIRECTANGULAR", (0.0,) * 6)],
)
def test_directions_all_around_come_back_from_their_pixels(
    model: str, terms: tuple[float, ...]
) -> None:
    pose = look_at(np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.0, 0.2]))
    camera = _double(_camera(model, terms, pose), pose)
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    index = torch.zeros(2000, dtype=torch.int64)
    center = camera.scene_from_camera[index, :, 3]
    pixels, depth = camera.project(center + 2.0 * directions, index)
    assert 0.4 < float((depth < 0).double().mean()) < 0.6  # half of them lie behind the camera
    if model == "EQUIRECTANGULAR":
        assert bool(((pixels >= 0) & (pixels <= torch.tensor([640, 480]))).all())
    back = camera.generate_rays(index, pixels).directions
    assert torch.allclose(back, directions, rtol=0.0, atol=1e-9)
    again, _ = camera.project(center + 0.3 * back, index)
    assert torch.allclose(again, pixels, rtol=0.0, atol=1e-7)


def test_a_panorama_shows_forward_in_its_middle_and_up_on_top() -> None:
    pixels = torch.tensor([[320, 240], [480, 240], [160, 240], [0, 240], [320, 0], [320, 480]])
    rays = _camera("EQUIRECTANGULAR").generate_rays(torch.zeros(6, dtype=torch.int64), pixels)
    expected = [[0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 1, 0], [0, -1, 0]]
    assert torch.allclose(rays.directions, torch.tensor(expected).float(), atol=1e-6)


def test_a_panorama_follows_the_formula_of_longitude_and_latitude() -> None:
    generator = torch.Generator().manual_seed(3)
    pixels = torch.rand(50, 2, generator=generator) * torch.tensor([640.0, 480.0])
    rays = _camera("EQUIRECTANGULAR").generate_rays(torch.zeros(50, dtype=torch.int64), pixels)
    for (x, y), found in zip(pixels.tolist(), rays.directions.tolist(), strict=True):
        theta = -math.pi * (x - 320.0) / 320.0  # nerfstudio's angles, to the left and from the top
        phi = math.pi * (0.5 + (y - 240.0) / 480.0)
        expected = (
            -math.sin(theta) * math.sin(phi),
            math.cos(phi),
            -math.cos(theta) * math.sin(phi),
        )
        assert found == pytest.approx(expected, abs=1e-6)


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
        torch.tensor([OPENCV]),
    )
    assert torch.allclose(shown, torch.tensor([expected], dtype=torch.float64))


def test_fisheye_follows_its_formula_also_beyond_ninety_degrees() -> None:
    theta, k1 = 1.7, 0.02
    direction = torch.tensor([[math.sin(theta), 0.0, math.cos(theta)]], dtype=torch.float64)
    terms = torch.tensor([[k1, 0, 0, 0, 0, 0]], dtype=torch.float64)
    shown = distort(direction, terms, torch.tensor([FISHEYE]))
    bent = theta * (1 + k1 * theta**2)
    assert torch.allclose(shown, torch.tensor([[bent, 0.0]], dtype=torch.float64))
    assert torch.allclose(undistort(shown, terms, torch.tensor([FISHEYE])), direction, atol=1e-9)


def test_undistortion_beyond_a_lens_that_folds_over_stays_finite() -> None:
    far = torch.tensor([[3.0, 2.0], [-5.0, 1.0]])
    terms = torch.tensor([[-0.5, 0.1, 0.0, 0.0, 0.0, 0.0]]).expand(2, 6)
    assert bool(undistort(far, terms, torch.tensor([OPENCV, OPENCV])).isfinite().all())


def test_a_mixed_batch_uses_each_cameras_own_lens() -> None:
    pixels = torch.tensor([[600.0, 400.0]] * 4)
    rays = MIXED.generate_rays(torch.arange(4), pixels)
    points = torch.tensor([[0.3, -0.2, -1.0]] * 4)
    shown, _ = MIXED.project(points, torch.arange(4))
    for row, (model, terms) in enumerate(LENSES):
        alone = _camera(model, terms)
        direction = alone.generate_rays(torch.tensor([0]), pixels[:1]).directions[0]
        assert torch.allclose(rays.directions[row], direction, atol=1e-6)
        place, _ = alone.project(points[:1], torch.tensor([0]))
        assert torch.allclose(shown[row], place[0], atol=1e-4)
        picked = MIXED.select([row]).generate_rays(torch.tensor([0]), pixels[:1])
        assert torch.equal(picked.directions[0], rays.directions[row])
    assert len({tuple(direction) for direction in rays.directions.tolist()}) == 4


def test_an_opencv_lens_without_terms_takes_the_pinhole_path() -> None:
    plain, pinhole = _camera("OPENCV"), _camera()
    assert not plain.distorted
    assert _camera(*LENSES[1]).distorted
    assert torch.equal(plain.image_rays(0).directions, pinhole.image_rays(0).directions)


def test_a_pictures_rays_are_those_of_its_pixels_whatever_lens_came_before() -> None:
    small = MIXED.resized(40)
    for index in (0, 1, 2, 3, 1, 0, 3, 2):
        width, height = small.size[index].tolist()
        rows, columns = torch.meshgrid(
            torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij"
        )
        pixels = torch.stack([columns, rows], dim=-1).reshape(-1, 2)
        rows_of = torch.full((len(pixels),), index)
        one_by_one = small.generate_rays(rows_of, pixels, with_pixel_area=True)
        picture = small.image_rays(index, with_pixel_area=True)
        assert picture.pixel_area is not None
        assert one_by_one.pixel_area is not None
        assert torch.equal(picture.camera_indices, rows_of)
        assert torch.equal(picture.origins, one_by_one.origins)
        assert torch.allclose(picture.directions, one_by_one.directions, atol=1e-6)
        assert torch.allclose(picture.pixel_area, one_by_one.pixel_area, rtol=1e-3)


def test_the_time_of_a_picture_goes_to_its_rays() -> None:
    times = [0.0, 0.25, 1.0]
    cameras = _cameras(("PINHOLE",) * 3, ((0.0,) * 6,) * 3, times=times).resized(64)
    rays = cameras.generate_rays(torch.tensor([2, 1, 1]), torch.ones(3, 2))
    assert rays.times is not None
    assert rays.times.tolist() == [1.0, 0.25, 0.25]
    late = cameras.select([2]).to("cpu").image_rays(0)
    assert late.times is not None
    assert set(late.times.tolist()) == {1.0}
    assert _camera().resized(64).image_rays(0).times is None


def test_pixel_areas_of_a_panorama_are_those_of_its_zones() -> None:
    camera = _camera("EQUIRECTANGULAR").resized(128)
    width, height = camera.size[0].tolist()
    rays = camera.image_rays(0, with_pixel_area=True)
    assert rays.pixel_area is not None
    rows = rays.pixel_area.reshape(height, width)
    # Archimedes: a zone between two latitudes has the area 2 pi (sin upper - sin lower).
    latitudes = torch.linspace(math.pi / 2, -math.pi / 2, height + 1)
    zones = 2.0 * math.pi * (latitudes[:-1].sin() - latitudes[1:].sin())
    assert torch.allclose(rows.sum(dim=-1), zones, rtol=0.01)
    assert float(rows.sum()) == pytest.approx(4.0 * math.pi, rel=1e-2)


@pytest.mark.parametrize("long_side", [333, 640, 100])
def test_resizing_a_panorama_keeps_the_whole_sphere(long_side: int) -> None:
    small = _camera("EQUIRECTANGULAR").resized(long_side)
    width, height = small.size[0].tolist()
    (focal,), (principal,) = small.focal.tolist(), small.principal.tolist()
    assert focal == pytest.approx([width / 2, height])
    assert principal == pytest.approx([width / 2, height / 2])


def test_pixel_areas_add_up_to_the_solid_angle_of_the_image() -> None:
    camera = _camera().resized(64)
    width, height = camera.size[0].tolist()
    rays = camera.image_rays(0, with_pixel_area=True)
    assert torch.equal(rays.directions, camera.image_rays(0).directions)
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


@pytest.mark.parametrize("away", [2.5, 10.0, 60.0])
def test_one_camera_far_away_takes_no_detail_from_the_others(away: float) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(30)], axis=1)
    far = ring.copy()
    far[7] *= away
    scene = SceneTransform.fit(far)
    inside = np.abs(scene.scene_from_world(far)).max(axis=1) <= 1.0 + 1e-9
    if away < 3.0:
        assert inside.all()
    else:
        assert np.flatnonzero(~inside).tolist() == [7]
        assert scene.scale == pytest.approx(SceneTransform.fit(ring).scale, rel=0.05)
    with_two = np.concatenate([ring, 5.0 * ring[:4]])
    assert np.abs(SceneTransform.fit(with_two).scene_from_world(with_two)).max() <= 1.0 + 1e-9


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
        ({"models": ["EQUIRECTANGULAR"], "focal": [[300.0, 480.0]]}, "more than the sphere"),
        ({"models": ["EQUIRECTANGULAR"], "focal": [[320.0, 400.0]]}, "more than the sphere"),
        ({"times": [1.5]}, "times"),
        ({"times": [math.nan]}, "times"),
        ({"times": [0.0, 1.0]}, "times"),
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


@pytest.mark.parametrize("k1", [0.0, -0.1])
def test_a_frame_holds_what_its_rays_meet_and_nothing_from_behind(k1: float) -> None:
    """Also no point that a folding lens formula puts there from far aside."""
    cameras = Cameras.from_arrays(
        world_from_camera=np.eye(4)[None, :3],
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[80],
        heights=[60],
        focal=[(50.0, 50.0)],
        principal=[(40.0, 30.0)],
        models=["OPENCV"],
        distortion=[(k1, 0.0, 0.0, 0.0, 0.0, 0.0)],
    )
    rays = cameras.image_rays(0)
    met = rays.origins + 3.0 * rays.directions
    behind, aside = -met, torch.tensor([[9.0, 0.2, -3.0], [5.2, 0.0, -3.0]])
    which, pixels, z_depth = cameras.points_in_frame(torch.cat([met, behind, aside]), 0)
    assert which.tolist() == list(range(80 * 60))
    assert torch.allclose(z_depth, -met[:, 2], atol=1e-4)
    assert torch.allclose(pixels[:2], torch.tensor([[0.5, 0.5], [1.5, 0.5]]), atol=1e-2)
    inner, _, _ = cameras.points_in_frame(met, 0, margin_px=5.0)
    assert len(inner) == 70 * 50
