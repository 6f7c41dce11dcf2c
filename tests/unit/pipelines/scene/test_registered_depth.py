"""A sensor's depth by another lens than the image's, of a slanted plane, whose depth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.lens_places import rays_of, through
from pipelines.scene.registered_depth import registered_depth
from pipelines.scene.sensor_depth import save_sensor_depth
from pipelines.scene.stereo_views import sensor_depth

POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
SENSOR = Intrinsics(320, 240, 290.0, 288.0, 161.0, 119.0)
PICTURE = Intrinsics(320, 240, 262.0, 262.0, 158.0, 122.0, "OPENCV", k1=0.1, k2=-0.2, p1=0.002)
FISHEYE = Intrinsics(320, 240, 150.0, 150.0, 160.0, 120.0, "OPENCV_FISHEYE", k1=0.05)
NORMAL = np.array([0.2, -0.1, 0.5])
"""Of the plane n x = 1, OpenCV axes."""


def plane_depth(lens: Intrinsics, shape: tuple[int, int]) -> np.ndarray:
    """Its z-depth [h, w] where each pixel of a map of the whole picture looks."""
    height, width = shape
    u, v = np.meshgrid(
        (np.arange(width) + 0.5) * lens.width / width,
        (np.arange(height) + 0.5) * lens.height / height,
    )
    ways = rays_of(lens, np.stack([u, v], axis=-1).reshape(-1, 2))
    return (ways[:, 2] / (ways @ NORMAL)).reshape(shape)


@pytest.mark.parametrize("lens", [SENSOR, PICTURE, FISHEYE], ids=["plain", "bent", "fisheye"])
def test_places_and_rays_are_each_others_inverse(lens: Intrinsics) -> None:
    places = np.random.default_rng(0).uniform((20, 20), (300, 220), (500, 2))
    rays = rays_of(lens, places)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(through(lens, rays), places, atol=1e-5)


def test_a_map_by_another_lens_is_brought_under_the_picture(tmp_path: Path) -> None:
    stored = plane_depth(SENSOR, (120, 160))
    stored[60:, 80:100] = 0.0
    save_sensor_depth(tmp_path / "a.npz", stored)
    image = PosedImage("a.jpg", 0, POSE, depth="a.npz")
    # As it is stored where nothing else is said.
    np.testing.assert_array_equal(
        registered_depth(tmp_path, image, PICTURE), stored.astype(np.float32)
    )
    found = registered_depth(tmp_path, replace(image, depth_lens=SENSOR), PICTURE)
    wanted = plane_depth(PICTURE, (120, 160))
    known = found > 0
    assert found.shape == (120, 160)
    assert 0.6 < known.mean() < 0.95
    # The sensor sees less to all sides; the nearest of its pixels is at most one away.
    assert not known[:3].any()
    assert not known[:, :3].any()
    assert np.abs(found / wanted - 1.0)[known].max() < 0.006
    assert np.abs(stored / wanted - 1.0)[known & (stored > 0)].max() > 0.015, "lenses are alike"
    hole = through(PICTURE, rays_of(SENSOR, np.array([[180.0, 180.0]])))[0] / 2
    assert found[int(hole[1]), int(hole[0])] == 0.0


def test_stereo_has_such_a_map_where_its_own_pixels_look(tmp_path: Path) -> None:
    save_sensor_depth(tmp_path / "a.npz", plane_depth(SENSOR, (240, 320)))
    image = PosedImage("a.jpg", 0, POSE, depth="a.npz", depth_lens=SENSOR)
    pinhole = Pinhole(160, 120, 131.0, 131.0, 79.0, 61.0)
    z = sensor_depth(tmp_path, image, PICTURE, pinhole)
    assert z is not None
    ways = pinhole.directions().reshape(-1, 3) * (1.0, -1.0, -1.0)
    wanted = (ways[:, 2] / (ways @ NORMAL)).reshape(120, 160)
    known = z > 0
    assert known.mean() > 0.7
    assert np.abs(z / wanted - 1.0)[known].max() < 0.003
    other = sensor_depth(tmp_path, replace(image, depth_lens=None), PICTURE, pinhole)
    assert other is not None
    assert np.abs(other / wanted - 1.0)[other > 0].max() > 0.015


def test_cameras_json_keeps_the_lens_of_the_depth(tmp_path: Path) -> None:
    images = (
        PosedImage("a.jpg", 0, POSE, depth="a.npz", depth_lens=SENSOR),
        PosedImage("b.jpg", 0, POSE, depth="b.npz"),
    )
    CamerasFile((PICTURE,), images).save(tmp_path / "cameras.json")
    assert CamerasFile.load(tmp_path / "cameras.json").images == images
