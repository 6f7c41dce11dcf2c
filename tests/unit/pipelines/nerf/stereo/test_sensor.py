"""A sensor's depth beside stereo's, on a wall whose depth is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.maps import DepthMap, surface_points
from pipelines.nerf.stereo.sensor import merged, sensor_maps, sensor_scale
from tests.unit.pipelines.nerf.stereo.painted_wall import BOX, HEIGHT, WIDTH, row_of_cameras

Depths = NDArray[np.float32]
CONFIG = StereoConfig()


def sensed(depths: list[NDArray[np.float64]], scale: float = 1.0) -> list[Depths | None]:
    return [(z * scale).astype(np.float32) for z in depths]


def as_maps(depths: list[NDArray[np.float64]]) -> list[DepthMap]:
    votes = np.full((HEIGHT, WIDTH), 3, np.uint8)
    return [DepthMap(z.astype(np.float32), votes) for z in depths]


def test_true_depth_is_kept_and_made_quieter() -> None:
    views, depths = row_of_cameras()
    generator = np.random.default_rng(0)
    noisy = [z * (1.0 + 0.005 * generator.standard_normal(z.shape)) for z in depths]
    maps = sensor_maps(views, sensed(noisy), CONFIG)
    known = maps[3].z > 0
    assert known.mean() > 0.95
    before = np.abs(noisy[3] / depths[3] - 1.0)[known]
    after = np.abs(maps[3].z / depths[3] - 1.0)[known]
    assert np.median(after) < 0.6 * np.median(before)


def test_a_surface_that_others_see_through_is_dropped() -> None:
    views, depths = row_of_cameras()
    wrong = [z.copy() for z in depths]
    wrong[3][30:40, 5:25] = 1.5  # a smear in the air that one camera alone sees
    found = sensor_maps(views, sensed(wrong), CONFIG)[3].z
    assert not found[30:40, 5:25].any()
    assert (found > 0).mean() > 0.85


def test_what_nobody_else_can_speak_of_is_kept() -> None:
    """Somebody walks through a corridor: half of each picture no other view has depth for."""
    views, depths = row_of_cameras()
    halves = [z.copy() for z in depths]
    for index, z in enumerate(halves):
        z[: HEIGHT // 2] *= index == 3
    found = sensor_maps(views, sensed(halves), CONFIG)[3]
    assert (found.z[: HEIGHT // 2] > 0).mean() > 0.95
    assert not found.votes[: HEIGHT // 2 - 2].any()
    assert np.abs(found.z / depths[3] - 1.0)[found.z > 0].max() < 0.04
    assert (found.votes[HEIGHT // 2 + 2 :] > 0).mean() > 0.9


def test_who_sees_something_before_it_cannot_speak_of_it() -> None:
    """Another room's camera has the wall in its picture, behind its own: neither contradicts."""
    views, depths = row_of_cameras()
    nearer = [z if index == 3 else 0.4 * z for index, z in enumerate(depths)]
    found = sensor_maps(views, sensed(nearer), CONFIG)[3]
    assert (found.z > 0).mean() > 0.95
    assert np.abs(found.z / depths[3] - 1.0)[found.z > 0].max() < 0.01


def test_an_image_without_depth_has_an_empty_map() -> None:
    views, depths = row_of_cameras()
    some = sensed(depths)
    some[3] = None
    maps = sensor_maps(views, some, CONFIG)
    assert not maps[3].z.any()
    assert (maps[2].z > 0).mean() > 0.9
    assert surface_points(views, [None] * len(views)).shape == (0, 3)


@pytest.mark.parametrize("unit", [0.001, 0.8, 1.25])
def test_a_sensor_in_another_unit_is_brought_to_the_cameras(unit: float) -> None:
    _, depths = row_of_cameras()
    scale = sensor_scale(as_maps(depths), sensed(depths, unit))
    assert scale.factor == pytest.approx(1.0 / unit, rel=1e-3)


def test_a_scale_is_only_changed_on_evidence() -> None:
    _, depths = row_of_cameras()
    maps = as_maps(depths)
    assert sensor_scale(maps, sensed(depths, 1.005)).factor == 1.0, "within what stereo is off"
    generator = np.random.default_rng(0)
    blurred = [z * np.exp(0.02 * generator.standard_normal(z.shape)) for z in depths]
    assert sensor_scale(maps, sensed(blurred, 1.015)).factor == 1.0, "no farther off than spread"
    assert sensor_scale(maps, sensed(blurred, 1.06)).factor == pytest.approx(1 / 1.06, rel=5e-3)
    scattered = [z * generator.uniform(0.5, 1.2, z.shape) for z in depths]
    assert sensor_scale(maps, sensed(scattered)).factor == 1.0, "ratios that do not hold together"
    assert sensor_scale(maps, [None] * len(maps)).spread is None


def test_stereo_is_finer_unless_it_is_far_off() -> None:
    stereo = DepthMap(
        np.array([[2.0, 2.0, 0.0, 2.0, 0.0]], np.float32), np.array([[4, 5, 0, 2, 0]], np.uint8)
    )
    sensor = DepthMap(
        np.array([[2.08, 3.0, 2.5, 0.0, 0.0]], np.float32), np.array([[6, 1, 2, 0, 0]], np.uint8)
    )
    both = merged(stereo, sensor)
    assert both.z.tolist() == [[2.0, 3.0, 2.5, 2.0, 0.0]]
    assert both.votes.tolist() == [[4, 1, 2, 2, 0]]


def test_surface_points_lie_on_what_it_saw() -> None:
    views, depths = row_of_cameras()
    points = surface_points(views, sensed(depths))
    assert len(points) == 4000
    assert points[:, 2].min() == pytest.approx(BOX, abs=1e-3)
