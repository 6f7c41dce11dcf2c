"""Plain patches laid on the planes that all views show: a wall, blank but for its borders."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.completing import completed
from pipelines.nerf.stereo.maps import DepthMap, MapShelf
from pipelines.nerf.stereo.planes import planes_and_samples, roundness
from pipelines.nerf.stereo.views import StereoView
from tests.unit.pipelines.nerf.stereo.painted_wall import BOX, SLOPE, WALL, row_of_cameras

CONFIG = StereoConfig(num_neighbours=4)
WALL_PLANE = np.array([-SLOPE, 0.0, 1.0, WALL]) / np.hypot(SLOPE, 1.0)
Mask = NDArray[np.bool_]


def blank_wall() -> tuple[list[StereoView], list[np.ndarray], list[Mask]]:
    """Views of a wall that is blank between x = -1.2 and -0.4, y = -0.8 and 0.8; the depths; and
    the middle of the blank in each, two thirds of its width.
    """
    views, depths = row_of_cameras(size=2)
    blank_views, middles = [], []
    for view, depth in zip(views, depths, strict=True):
        x, y = view.rays()
        place_x = view.center[0] + x[None, :] * depth
        place_y = view.center[1] + y[:, None] * depth
        on_wall = depth > 3.0
        blank = on_wall & (np.abs(place_x + 0.8) < 0.4) & (np.abs(place_y) < 0.8)
        middles.append(blank & (np.abs(place_x + 0.8) < 0.26))
        picture = np.where(blank, 0.9, view.picture).astype(np.float32)
        blank_views.append(dataclasses.replace(view, picture=picture))
    return blank_views, depths, middles


def maps_without(depths: list[np.ndarray], unknown: list[Mask]) -> list[DepthMap]:
    return [
        DepthMap(
            np.where(hidden, 0.0, depth).astype(np.float32),
            np.where(hidden, 0, 4).astype(np.uint8),
        )
        for depth, hidden in zip(depths, unknown, strict=True)
    ]


def test_planes_of_the_scene_are_found_largest_first() -> None:
    views, depths, middles = blank_wall()
    planes = planes_and_samples(views, maps_without(depths, middles))[0]
    planes *= np.sign(planes[:, 2:3])
    assert np.abs(planes[0] - WALL_PLANE).max() < 2e-3
    assert np.abs(planes[1] - [0.0, 0.0, 1.0, BOX]).max() < 5e-3
    assert np.allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0)


def test_a_blank_patch_lies_on_the_plane_of_its_borders() -> None:
    views, depths, middles = blank_wall()
    maps = maps_without(depths, middles)
    found = completed(views, MapShelf.of(maps), CONFIG)
    for before, after, depth, middle in zip(maps, found, depths, middles, strict=True):
        assert middle.sum() > 100
        assert (after.z[middle] > 0).mean() > 0.9
        assert np.abs(after.z / depth - 1.0)[middle & (after.z > 0)].max() < 0.01
        assert (after.votes[middle & (after.z > 0)] > 0).mean() > 0.5
        kept = before.z > 0
        assert np.abs(after.z[kept] / before.z[kept] - 1.0).max() <= 0.0101


@pytest.mark.parametrize(("known", "is_laid"), [("one side", False), ("two sides", True)])
def test_what_is_known_along_one_line_says_nothing_of_a_patch(known: str, is_laid: bool) -> None:
    """In the corner of two walls some of the one seems to be known on the other."""
    views, depths, _ = blank_wall()
    blank = [view.picture == np.float32(0.9) for view in views]
    unknown = []
    for patch in blank:
        rows, columns = np.nonzero(patch)
        left = np.arange(patch.shape[1])[None, :] < columns.min() + 5
        top = np.arange(patch.shape[0])[:, None] < rows.min() + 5
        unknown.append(patch & ~(left | top if known == "two sides" else left))
    found = completed(views, MapShelf.of(maps_without(depths, unknown)), CONFIG)
    shares = [(after.z[hidden] > 0).mean() for after, hidden in zip(found, unknown, strict=True)]
    assert (np.mean(shares) > 0.8) if is_laid else (max(shares) < 0.06)


def test_places_on_a_line_are_not_round() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    labels = np.repeat([0, 1, 3], 60)
    x = np.concatenate([np.cos(turn), turn, 5.0 + 3.0 * np.cos(turn)])
    y = np.concatenate([np.sin(turn), 2.0 - turn, 7.0 + np.sin(turn)])
    assert np.allclose(roundness(labels, x, y, 5), [1.0, 0.0, 0.0, 1.0 / 3.0, 0.0], atol=1e-6)


def test_depths_near_their_plane_become_flat_and_others_stay() -> None:
    views, depths, middles = blank_wall()
    noise = np.random.default_rng(1).normal(0.0, 0.003, depths[3].shape)
    noisy = [depth * (1.0 + noise) for depth in depths]
    step = np.zeros(noise.shape, bool)
    step[60:68, 20:40] = True
    noisy = [np.where(step & (depth > 3.0), 0.97 * depth, depth) for depth in noisy]
    found = completed(views, MapShelf.of(maps_without(noisy, middles)), CONFIG)[3]
    patch = (views[3].picture == np.float32(0.9)) & ~step & ~middles[3]
    before = np.abs(noisy[3] / depths[3] - 1.0)[patch].mean()
    after = np.abs(found.z / depths[3] - 1.0)[patch].mean()
    assert after < 0.4 * before
    raised = step & (depths[3] > 3.0) & ~middles[3]
    assert np.allclose(found.z[raised], noisy[3][raised], rtol=1e-6)


@pytest.mark.parametrize("case", ["rough", "few", "no votes", "nothing"])
def test_what_no_plane_tells_stays_unknown(case: str) -> None:
    views, depths, middles = blank_wall()
    patches = [view.picture == np.float32(0.9) for view in views]
    rng = np.random.default_rng(2)
    if case == "rough":
        bumps = [rng.uniform(0.8, 1.2, depth.shape) for depth in depths]
        depths = [np.where(p, d * b, d) for p, d, b in zip(patches, depths, bumps, strict=True)]
    if case == "few":
        middles = [patch & (rng.random(patch.shape) > 0.005) for patch in patches]
    if case == "nothing":
        middles = [np.ones(depth.shape, bool) for depth in depths]
    maps = maps_without(depths, middles)
    if case == "no votes":
        maps = [DepthMap(found.z, np.minimum(found.votes, 1)) for found in maps]
    for after, middle in zip(completed(views, MapShelf.of(maps), CONFIG), middles, strict=True):
        assert (after.z[middle] > 0).mean() < 0.03


def test_a_patch_that_others_see_through_stays_unknown() -> None:
    views, depths, middles = blank_wall()
    maps = maps_without(depths, middles)
    # In view 3 the patch is a hole: the others know what is far behind it.
    seen = [
        DepthMap(
            np.where((k != 3) & middle, 3.0 * depth, found.z).astype(np.float32),
            np.where(middle & (k != 3), 4, found.votes).astype(np.uint8),
        )
        for k, (found, depth, middle) in enumerate(zip(maps, depths, middles, strict=True))
    ]
    found = completed(views, MapShelf.of(seen), CONFIG)
    assert (found[3].z[middles[3]] > 0).mean() < 0.1
    assert (completed(views, MapShelf.of(maps), CONFIG)[3].z[middles[3]] > 0).mean() > 0.9
