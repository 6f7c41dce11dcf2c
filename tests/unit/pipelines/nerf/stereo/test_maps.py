"""Depth maps of a painted wall with a box before it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo import maps as maps_module
from pipelines.nerf.stereo.maps import back_project, find_depth_maps, lonely_share
from pipelines.nerf.stereo.neighbours import choose_neighbours, depth_range, spread_apart
from pipelines.nerf.stereo.views import StereoView
from tests.unit.pipelines.nerf.stereo.painted_wall import look, row_of_cameras

CONFIG = StereoConfig(num_planes=48, num_neighbours=4)


def known_points(views: list[StereoView], depths: list[np.ndarray]) -> np.ndarray:
    found = [
        back_project(v, d.astype(np.float32))[::37] for v, d in zip(views, depths, strict=True)
    ]
    return np.concatenate(found)


@pytest.mark.parametrize("gain", [1.0, 0.7], ids=["same light", "exposure drifts"])
def test_depths_are_where_the_surfaces_are(gain: float) -> None:
    views, depths = row_of_cameras()
    lit = [
        dataclasses.replace(view, picture=view.picture * np.float32(gain ** (k / 3)))
        for k, view in enumerate(views)
    ]
    maps = find_depth_maps(lit, CONFIG, known_points(views, depths))
    error = np.abs(maps[3].z / depths[3] - 1.0)[maps[3].z > 0]
    assert (maps[3].z > 0).mean() > 0.8
    assert np.mean(error < 0.02) > 0.95
    assert np.median(error) < 0.005


def test_pictures_held_upright_and_lying_are_compared() -> None:
    """Every other picture is what a narrower, or a lower, one shows of the same."""
    views, depths = row_of_cameras()
    rows, columns = views[0].picture.shape
    for k in range(len(views)):
        if k % 2:
            kept = slice(0, rows), slice(columns // 6, columns - columns // 6)
        else:
            kept = slice(rows // 8, rows - rows // 8), slice(0, columns)
        fx, fy, cx, cy = views[k].lens
        lens = (fx, fy, cx - kept[1].start, cy - kept[0].start)
        picture = np.ascontiguousarray(views[k].picture[kept])
        views[k] = StereoView(picture, lens, views[k].world_from_camera)
        depths[k] = depths[k][kept]
    assert len({view.picture.shape for view in views}) == 2
    for known in (known_points(views, depths), None):
        maps = find_depth_maps(views, CONFIG, known)
        for k in (2, 3):
            found = maps[k].z > 0
            assert maps[k].z.shape == depths[k].shape
            assert found.mean() > 0.7
            assert np.mean(np.abs(maps[k].z / depths[k] - 1.0)[found] < 0.03) > 0.9


def test_without_any_known_point_a_coarse_pass_finds_the_range() -> None:
    views, depths = row_of_cameras(9)
    maps = find_depth_maps(views, CONFIG)
    error = np.abs(maps[4].z / depths[4] - 1.0)[maps[4].z > 0]
    assert (maps[4].z > 0).mean() > 0.7
    assert np.mean(error < 0.03) > 0.9


def test_a_plain_patch_is_carried_by_its_borders() -> None:
    views, depths = row_of_cameras()
    plain = []
    for view, depth in zip(views, depths, strict=True):
        x, y = view.rays()
        place = view.center[0] + x[None, :] * depth, view.center[1] + y[:, None] * depth
        blank = (np.abs(place[0] + 0.9) < 0.35) & (np.abs(place[1]) < 0.5) & (depth > 3.0)
        plain.append(
            dataclasses.replace(view, picture=np.where(blank, 0.5, view.picture).astype(np.float32))
        )
    found = find_depth_maps(plain, CONFIG, known_points(views, depths))[3]
    x, y = views[3].rays()
    inside = np.abs(views[3].center[0] + x[None, :] * depths[3] + 0.9) < 0.25
    inside &= (np.abs(views[3].center[1] + y[:, None] * depths[3]) < 0.4) & (depths[3] > 3.0)
    assert inside.sum() > 40
    right = np.abs(found.z / depths[3] - 1.0) < 0.05
    known = inside & (found.z > 0)
    alone = dataclasses.replace(CONFIG, smooth_small=0.0, smooth_large=0.0, min_agreeing=0)
    unaided = find_depth_maps(plain, alone, known_points(views, depths))[3]
    assert known.sum() > 0.5 * inside.sum()
    assert right[known].mean() > 0.7
    assert (inside & (np.abs(unaided.z / depths[3] - 1.0) < 0.05)).sum() < 0.3 * inside.sum()


def test_a_view_that_nobody_shares_has_an_empty_map() -> None:
    views, depths = row_of_cameras(5)
    turned = np.column_stack([np.diag([-1.0, 1.0, -1.0]), [0.0, 0.0, -5.0]])
    lonely = StereoView(views[0].picture, views[0].lens, turned)
    maps = find_depth_maps([*views, lonely], CONFIG, known_points(views, depths))
    assert not maps[5].z.any()
    assert maps[2].z.any()


def test_with_few_photos_one_neighbour_is_enough_where_no_other_could_tell(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    views, depths = row_of_cameras(2, 0.3)
    points = known_points(views, depths)
    found = find_depth_maps(views, CONFIG, points)[0]
    known = found.z > 0
    assert known.mean() > 0.5
    assert (np.abs(found.z / depths[0] - 1.0)[known] < 0.03).mean() > 0.95
    assert set(found.votes[known].tolist()) == {1}
    # Others could tell in the middle of three: there two have to agree, as ever.
    views, depths = row_of_cameras(3, 0.3)
    middle = find_depth_maps(views, CONFIG, known_points(views, depths))[1]
    inner = middle.votes[:, 40:-40]
    assert set(inner[inner > 0].tolist()) == {2}
    monkeypatch.setattr(maps_module, "FEW_PHOTOS", 0)
    many = find_depth_maps(views[:2], CONFIG, known_points(views, depths))
    assert many[0].z.any(), "of what these two show one neighbour shows all"
    monkeypatch.setattr(maps_module, "_LONELY", 2.0)
    assert not find_depth_maps(views[:2], CONFIG, known_points(views, depths))[0].z.any()


def test_what_is_shown_to_one_neighbour_at_most_is_lonely() -> None:
    views, depths = row_of_cameras(4, 0.02)
    points = known_points(views, depths)
    others = [[j for j in range(4) if j != k] for k in range(4)]
    assert lonely_share(views, points, others) < 0.05
    assert lonely_share(views, points, [[1], [0], [3], [2]]) == 1.0
    assert lonely_share(views, points, [[], [], [], []]) == 1.0
    assert lonely_share(views, points + np.array([0.0, 0.0, -100.0]), others) == 0.0


def test_what_the_picture_does_not_have_has_no_depth() -> None:
    views, depths = row_of_cameras()
    cut = views[3].picture.copy()
    cut[:, :20] = -1.0
    views[3] = dataclasses.replace(views[3], picture=cut)
    found = find_depth_maps(views, CONFIG, known_points(views, depths))[3]
    assert not found.z[:, :20].any()
    assert found.z[:, 20:].any()


def test_neighbours_see_the_same_from_a_good_angle() -> None:
    views = [look(x)[0] for x in (0.0, 0.001, 0.4, 0.45, 30.0)]
    points = back_project(views[0], look(0.0)[1].astype(np.float32))[::11]
    chosen = choose_neighbours(views, points, 3, 6.0)
    assert set(chosen[0]) == {2, 3}
    near, far = depth_range(views[0], points) or (0.0, 0.0)
    assert near < 2.5
    assert far > 5.0


def test_baselines_of_many_lengths_where_nothing_is_known() -> None:
    views = [look(0.01 * 1.6**k)[0] for k in range(12)]
    chosen = spread_apart(views, 5)
    assert len(set(chosen[0])) == 5
    lengths = sorted(abs(views[k].center[0] - views[0].center[0]) for k in chosen[0])
    assert lengths[-1] > 4 * lengths[0]


def test_progress_ends_at_one_and_may_stop_the_work() -> None:
    views, depths = row_of_cameras(4)
    seen: list[float] = []
    find_depth_maps(
        views, CONFIG, known_points(views, depths), lambda fraction, text: seen.append(fraction)
    )
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)

    def stop(fraction: float, text: str) -> None:
        raise InterruptedError(text)

    with pytest.raises(InterruptedError):
        find_depth_maps(views, CONFIG, None, stop)
