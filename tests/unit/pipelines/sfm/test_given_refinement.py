"""Corrections of given poses, on made tracks and paths."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.given_fit import fit_of, suspects
from pipelines.sfm.given_pairs import overlapping_pairs, sampled_pairs
from pipelines.sfm.given_refinement import carried, onto, refine, settled, shared, tolerances
from pipelines.sfm.tracks import Observations, build_tracks, thinned, triangulate
from pipelines.tools.colmap_results import Correspondences
from tests.unit.pipelines.sfm import made_corridor

RANDOM = np.random.default_rng(3)
LENS = Intrinsics(960, 720, 800.0, 800.0, 480.0, 360.0)


def path(num: int) -> np.ndarray:
    """[num, 3, 4], OpenCV axes: along a line past things 4 ahead, turning a little."""
    turns = Rotation.from_rotvec(RANDOM.normal(0, 0.05, (num, 3))).as_matrix()
    centers = np.stack([np.linspace(0, 3, num), 0.2 * np.sin(np.arange(num)), np.zeros(num)], 1)
    return np.concatenate([turns, centers[:, :, None]], axis=2)


def seen_points(poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [N, P, 2] and unit rays [N, P, 3] of points."""
    local = np.einsum("nji,npj->npi", poses[:, :, :3], points[None] - poses[:, None, :, 3])
    pixels = local[..., :2] / local[..., 2:] * LENS.fl_x + (LENS.cx, LENS.cy)
    return pixels, local / np.linalg.norm(local, axis=2, keepdims=True)


POINTS = RANDOM.uniform((-1, -1, 3), (4, 1, 5), (60, 3))
POSES = path(6)
PIXELS, RAYS = seen_points(POSES, POINTS)
ALL = Observations(np.repeat(np.arange(60), 6), np.tile(np.arange(6), 60), np.zeros((360, 2)))


def test_tracks_are_triangulated_and_what_misses_them_is_left_out() -> None:
    rays = RAYS.transpose(1, 0, 2).reshape(-1, 3).copy()
    rays[7] = rays[7] + (0.0, 0.1, 0.0)
    rays[7] /= np.linalg.norm(rays[7])
    rays[13] = np.nan
    points, fits = triangulate(ALL, rays, POSES, np.full(6, 0.003))
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    assert np.flatnonzero(~fits).tolist() == [7, 13]


def test_a_point_behind_the_cameras_is_none() -> None:
    rays = -RAYS.transpose(1, 0, 2).reshape(-1, 3)
    assert not triangulate(ALL, rays, POSES, np.full(6, 0.003))[1].any()


def test_tracks_join_pairs_and_leave_out_what_contradicts_itself() -> None:
    places = tuple(np.arange(6.0).reshape(3, 2) + 10 * image for image in range(3))
    matches = {
        (0, 1): np.array([[0, 0], [1, 1]]),
        (1, 2): np.array([[0, 2], [1, 1]]),
        (0, 2): np.array([[2, 1]]),  # features 1 and 2 of image 0 would be one
    }
    seen, held = build_tracks(Correspondences(places, matches), 0.0, 0)
    assert [seen.image[seen.track == track].tolist() for track in (0, 1)] == [[0, 1, 2], [1, 2]]
    np.testing.assert_array_equal(seen.xy[2], places[2][2])
    assert all(len(both[0]) == 0 for both in held.values())


def test_held_out_matches_are_of_no_track() -> None:
    places = tuple(np.tile(np.arange(400.0)[:, None], 2) for _ in range(2))
    rows = np.tile(np.arange(400)[:, None], 2)
    seen, held = build_tracks(Correspondences(places, {(0, 1): rows}), 0.25, 1)
    apart = held[0, 1][0][:, 0]
    assert 60 < len(apart) < 140
    assert not set(apart) & set(seen.xy[:, 0])
    assert len(apart) + len(np.unique(seen.track)) == 400


def test_long_tracks_are_kept_first() -> None:
    kept = np.ones(360, bool)
    kept[ALL.track >= 30] = ALL.image[ALL.track >= 30] < 2
    chosen = thinned(ALL, kept, 20)
    assert set(ALL.track[chosen]) < set(range(30))
    assert np.bincount(ALL.image[chosen]).min() >= 20


def test_a_moved_path_comes_back_whatever_one_wrong_pose_says() -> None:
    turn = Rotation.from_rotvec((0.3, -0.2, 0.5)).as_matrix()
    moved = POSES.copy()
    moved[:, :, :3] = turn @ POSES[:, :, :3]
    moved[:, :, 3] = 2.5 * POSES[:, :, 3] @ turn.T + (1, 2, 3)
    given = POSES.copy()
    given[2, :, 3] += (5.0, 0.0, 0.0)
    np.testing.assert_allclose(onto(given, moved, moved), POSES, atol=1e-9)


def test_corrections_are_carried_from_both_sides_and_beyond_the_ends() -> None:
    given, result = POSES.copy(), POSES.copy()
    result[1, :, 3] += (0.0, 0.0, 0.1)
    result[3, :, 3] += (0.0, 0.0, 0.3)
    turn = Rotation.from_rotvec((0.0, 0.02, 0.0)).as_matrix()
    result[3, :, :3] = turn @ result[3, :, :3]
    sure = np.array([1, 3])
    half = Rotation.from_rotvec((0.0, 0.01, 0.0)).as_matrix()
    middle = carried(given, result, sure, 2)
    np.testing.assert_allclose(middle[:, 3], given[2, :, 3] + (0, 0, 0.2), atol=1e-12)
    np.testing.assert_allclose(middle[:, :3], half @ given[2, :, :3], atol=1e-9)
    np.testing.assert_allclose(carried(given, result, sure, 5)[:, 3] - given[5, :, 3], (0, 0, 0.3))


def test_an_image_that_flies_off_goes_with_its_neighbours() -> None:
    moved = POSES.copy()
    moved[3, :, 3] += (0.0, 1.0, 0.0)
    poses, told = settled(POSES, moved, ALL, np.zeros(6, bool), (0.1, 0.1))
    assert told.tolist() == [True, True, True, False, True, True]
    np.testing.assert_allclose(poses, POSES, atol=0.02)


def test_a_point_that_one_image_is_left_to_see_is_none() -> None:
    kept = ALL.image < 2
    kept[ALL.track == 5] = ALL.image[ALL.track == 5] == 0
    assert np.flatnonzero(kept & ~shared(ALL, kept)).tolist() == [30]


def test_images_apart_from_all_others_stay() -> None:
    seen = ALL.where(ALL.image < 5)
    moved = POSES + np.array([0, 0, 0, 0.01])
    poses, told = settled(POSES, moved, seen, np.zeros(6, bool), (1.0, 1.0))
    assert told.tolist() == [True] * 5 + [False]
    np.testing.assert_allclose(poses, POSES, atol=1e-9)


def test_fit_counts_pixels_as_they_are_looked_at_and_names_the_wrong_image() -> None:
    noise = RANDOM.normal(0, 1.0, PIXELS.shape)
    pairs = [(i, j) for i in range(6) for j in range(i + 1, 6)]
    matches = {(i, j): (PIXELS[i] + noise[i], PIXELS[j] + noise[j]) for i, j in pairs}
    lenses = [LENS] * 6
    full, half = (fit_of(POSES, lenses, matches, side) for side in (960, 480))
    assert full is not None
    assert half is not None
    assert 0.4 < full.error_px < 1.2
    assert abs(half.error_px - full.error_px / 2) < 1e-9
    wrong = POSES.copy()
    wrong[4, :, :3] = Rotation.from_rotvec((0.1, 0, 0)).as_matrix() @ wrong[4, :, :3]
    found = fit_of(wrong, lenses, matches, 960)
    assert found is not None
    assert found.of_image().argmin() == 4
    assert fit_of(POSES, lenses, dict(list(matches.items())[:2]), 960) is None


def test_who_mostly_looks_at_pictures_with_wrong_poses_is_not_named_with_them() -> None:
    poses = path(8)
    pixels, _ = seen_points(poses, POINTS)
    wrong = poses.copy()
    turned = Rotation.from_rotvec((0.15, 0, 0)).as_matrix()
    wrong[[1, 4], :, :3] = turned @ wrong[[1, 4], :, :3]
    wrong[[1, 4], :, 3] += (0.0, 0.5, 0.3)
    good = [(0, 2), (0, 5), (2, 5), (2, 6), (5, 6), (6, 7), (5, 7), (0, 7), (3, 5), (3, 7)]
    # Four in five of 3's matches are with 1 and 4.
    bad = [(1, 3), (3, 4), (0, 1), (4, 5)]
    few = slice(0, 15)
    matches = {pair: (pixels[pair[0]], pixels[pair[1]]) for pair in good + bad}
    for pair in [(3, 5), (3, 7)]:
        matches[pair] = (pixels[pair[0]][few], pixels[pair[1]][few])
    fit = fit_of(wrong, [LENS] * 8, matches, 960)
    assert fit is not None
    assert fit.of_image()[3] < 0.5 * np.nanmedian(fit.of_image())
    assert suspects(fit) == [1, 4]
    assert suspects(fit_of(poses, [LENS] * 8, matches, 960)) == []


def test_tolerance_goes_down_to_that_of_right_poses() -> None:
    assert tolerances(0.3) == [4.0, 4.0]
    assert tolerances(10.0) == [30.0, 12.0, 4.8, 4.0, 4.0]


def test_pairs_of_a_long_capture_stay_few_and_close_its_loop() -> None:
    angles = np.radians(np.linspace(0, 720, 300))
    poses = np.array(
        [
            np.column_stack(
                [
                    Rotation.from_rotvec((0, 0, a)).as_matrix()[:, [1, 2, 0]],
                    (np.cos(a), np.sin(a), 0),
                ]
            )
            for a in angles
        ]
    )
    sample, pairs = sampled_pairs(poses), overlapping_pairs(poses)
    assert len({i for pair in sample for i in pair}) <= 64
    assert len(pairs) < 15 * 300
    assert sum(j - i > 100 for i, j in pairs) > 300
    assert any(j - i > 100 for i, j in sample)
    assert all(i < j for i, j in pairs)


def test_a_path_that_matches_leave_loose_stays_where_it_was_given() -> None:
    """Without priors on the given centres it ends 0.30 off."""
    true, _, seen = made_corridor.corridor()
    given = made_corridor.wavering(true, 0.03)
    found = refine(
        given,
        [made_corridor.LENS] * made_corridor.NUM,
        Observations(seen.point, seen.image, seen.xy),
        error_px=3.0,
        long_side_px=640,
        run=made_corridor.at_once,
        num_threads=1,
        seed=0,
    )
    assert found.is_seen.all()
    assert np.linalg.norm(found.poses[:, :, 3] - true[:, :, 3], axis=1).max() < 0.1
