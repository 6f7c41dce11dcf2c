"""A model that is wrong as a whole is told from a right one by the matches that it had to drop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.options import PosesOptions
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.panoramas import panorama_lens
from pipelines.sfm.agreement import (
    LITTLE,
    Matches,
    agreement,
    agreement_of_model,
    contradicted_images,
    fitting,
)
from pipelines.sfm.report import Attempt, Outcome, check_usable, doubts_of
from pipelines.sfm.rungs import RUNGS, Standing, too_few_registered
from pipelines.sfm.source import Source
from pipelines.tools.colmap_rays import rays_through
from pipelines.tools.colmap_results import PairStatistics, SparseModel, best_model

NUM = 30
LENS = Intrinsics(960, 720, 800.0, 800.0, 480.0, 360.0, "OPENCV", k1=0.05)
FISHEYE = Intrinsics(960, 720, 380.0, 380.0, 480.0, 360.0, "OPENCV_FISHEYE", k1=0.02)
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform(-1.0, 1.0, (500, 3))
Poses = np.ndarray


def ring(azimuths_deg: np.ndarray, height: float = 1.0) -> Poses:
    """[N, 3, 4] world_from_camera, OpenCV axes: cameras 4 away that look at the origin."""
    poses = []
    for azimuth in np.radians(azimuths_deg):
        center = np.array([4 * np.cos(azimuth), 4 * np.sin(azimuth), height])
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        poses.append(np.stack([x, np.cross(z, x), z, center], axis=1))
    return np.array(poses)


ALL_AROUND = np.linspace(0.0, 348.0, NUM)
RIGHT = ring(ALL_AROUND)
TWISTED = ring(ALL_AROUND * (150.0 / 348.0))
"""All cameras stand in a row as they should, over less than half of the way around."""
FOLDED = RIGHT.copy()
FOLDED[NUM // 2 :] = ring(ALL_AROUND[NUM // 2 :] + 70.0)
"""Two halves, each right by itself, that do not stand to each other as they should."""


def seen(pose: Poses, lens: Intrinsics, noise_px: float = 0.5) -> np.ndarray:
    """Places of all points in pixels, [P, 2], found by turning the lens's own rays about."""
    local = (POINTS - pose[:, 3]) @ pose[:, :3]
    rays = local / np.linalg.norm(local, axis=1, keepdims=True)
    places = np.full((len(POINTS), 2), (lens.cx, lens.cy))
    for _ in range(30):
        now = rays_through(lens, places)
        px = lens.width / (2 * np.pi) if lens.model == "EQUIRECTANGULAR" else lens.fl_x
        places = places + 0.9 * px * (rays - now)[:, :2]
    assert np.abs(rays_through(lens, places) - rays).max() < 1e-5
    noisy: np.ndarray = places + np.random.default_rng(1).normal(0, noise_px, places.shape)
    return noisy


def matches_of(poses: Poses, lens: Intrinsics, reach_deg: float = 60.0) -> Matches:
    """Of pairs that see the same side, 40 points each; fewer the further they are apart."""
    places = [seen(pose, lens) for pose in poses]
    found = {}
    for i in range(len(poses)):
        for j in range(i + 1, len(poses)):
            apart = np.degrees(np.arccos(np.clip(poses[i][:, 2] @ poses[j][:, 2], -1, 1)))
            if apart < reach_deg:
                some = RANDOM.permutation(len(POINTS))[: int(120 - 1.5 * apart)]
                found[i, j] = places[i][some], places[j][some]
    return found


MATCHES = matches_of(RIGHT, LENS)


def model(
    poses: Poses, num_points: int, error_px: float, indices: range | None = None
) -> SparseModel:
    """As COLMAP gives it; what matches say of it comes on top."""
    indices = range(len(poses)) if indices is None else indices
    found = SparseModel(
        indices=tuple(indices),
        cameras=(LENS,),
        camera_of=(0,) * len(poses),
        world_from_camera=poses,
        points=np.zeros((num_points, 3)),
        colors=np.zeros((num_points, 3), np.uint8),
        track_lengths=np.full(num_points, 4),
        error_px=error_px,
        angle_deg=12.0,
    )
    return replace(found, agreement=agreement_of_model(found, MATCHES))


@pytest.mark.parametrize("lens", [LENS, FISHEYE])
def test_matches_fit_the_poses_that_they_were_seen_from(lens: Intrinsics) -> None:
    found = agreement(range(NUM), RIGHT, [lens] * NUM, matches_of(RIGHT, lens))
    assert found is not None
    assert found > 0.99
    turned = agreement(range(NUM), np.roll(RIGHT, 1, axis=0), [lens] * NUM, matches_of(RIGHT, lens))
    assert turned is not None
    assert turned > 0.99, "a ring that is turned as a whole is the same ring"
    mixed = agreement(range(NUM), RIGHT[RANDOM.permutation(NUM)], [lens] * NUM, MATCHES)
    assert mixed is not None
    assert mixed < 0.3


def test_panoramas_are_asked_too() -> None:
    lens = panorama_lens(1024, 512)
    poses = ring(np.linspace(0, 90, 6))
    rays = [(6.0 * POINTS - pose[:, 3]) @ pose[:, :3] for pose in poses]
    places = [
        np.stack(
            [
                (np.arctan2(ray[:, 0], ray[:, 2]) / (2 * np.pi) + 0.5) * 1024,
                (np.arcsin(ray[:, 1] / np.linalg.norm(ray, axis=1)) / np.pi + 0.5) * 512,
            ],
            axis=1,
        )
        for ray in rays
    ]
    found = {(i, j): (places[i], places[j]) for i in range(6) for j in range(i + 1, 6)}
    assert agreement(range(6), poses, [lens] * 6, found) == pytest.approx(1.0)
    wrong = agreement(range(6), poses[[0, 3, 1, 5, 2, 4]], [lens] * 6, found)
    assert wrong is not None
    assert wrong < 0.4


def test_points_behind_the_cameras_fit_nothing() -> None:
    """The same lines, seen from the other side: a mirrored model has fine epipolar errors."""
    pair = (RIGHT[0], RIGHT[2])
    places = (seen(pair[0], LENS, 0.0), seen(pair[1], LENS, 0.0))
    assert fitting(pair, (LENS, LENS), places).all()
    swapped = pair[1].copy()
    swapped[:, 3] = 2 * pair[0][:, 3] - pair[1][:, 3]
    assert not fitting((pair[0], swapped), (LENS, LENS), places).any()


def test_cameras_in_one_place_fit_where_they_see_the_same() -> None:
    places = seen(RIGHT[0], LENS, 0.0)
    assert fitting((RIGHT[0], RIGHT[0]), (LENS, LENS), (places, places)).all()
    assert not fitting((RIGHT[0], RIGHT[0]), (LENS, LENS), (places, places + 20.0)).any()


def test_too_few_pairs_say_nothing() -> None:
    few = dict(list(MATCHES.items())[:2])
    assert agreement(range(NUM), RIGHT, [LENS] * NUM, few) is None
    thin = {pair: (a[:5], b[:5]) for pair, (a, b) in MATCHES.items()}
    assert agreement(range(NUM), RIGHT, [LENS] * NUM, thin) is None


def attempt(rung: int, *models: SparseModel) -> Attempt:
    return Attempt(RUNGS[rung], "exhaustive", models, 1.0)


def test_a_twisted_model_is_never_chosen_where_a_right_one_is() -> None:
    """It comes first, holds as many images, more points, and has the smaller reprojection error."""
    twisted, right = model(TWISTED, 900, 0.5), model(RIGHT, 600, 0.8)
    assert twisted.agreement is not None
    assert right.agreement is not None
    assert twisted.agreement < LITTLE < 0.95 < right.agreement
    assert best_model([twisted, right]) is right
    outcome = Outcome((attempt(0, twisted), attempt(1, right)), PairStatistics.nothing(NUM))
    assert outcome.chosen.best is right
    part = model(RIGHT[:20], 400, 0.8, range(20))
    assert best_model([twisted, part]) is part, "fewer images that hold are worth more"


def test_a_contradicted_model_is_not_the_end_of_the_climb_and_is_told_where_there_is_no_other() -> (
    None
):
    twisted = attempt(0, model(TWISTED, 900, 0.5))
    assert twisted.is_contradicted
    assert not attempt(0, model(RIGHT, 900, 0.5)).is_contradicted
    assert too_few_registered(Standing(NUM, NUM, 0.8, is_contradicted=True))
    assert not too_few_registered(Standing(NUM, NUM, 0.8))
    outcome = Outcome((twisted,), PairStatistics.nothing(NUM))
    files = tuple(f"images/{n}.jpg" for n in range(NUM))
    source = Source(Path(), files, (None,) * NUM, is_video=False)
    chosen = check_usable(outcome, source, PosesOptions())
    (warning,) = doubts_of(chosen)
    assert warning["code"] == "poses_contradicted"


def test_of_two_halves_folded_onto_each_other_the_unfolded_are_chosen() -> None:
    """Most pairs lie within a half, and are right: only what lies between the halves tells."""
    folded, right = model(FOLDED, 900, 0.5), model(RIGHT, 600, 0.8)
    assert folded.agreement is not None
    assert LITTLE < folded.agreement < 0.95
    assert best_model([folded, right]) is right


def test_of_attempts_about_as_good_the_first_is_taken() -> None:
    first, second = (replace(model(RIGHT, 600, 0.8), agreement=value) for value in (0.95, 0.96))
    outcome = Outcome((attempt(0, first), attempt(1, second)), PairStatistics.nothing(NUM))
    assert outcome.chosen.best is first


def test_an_image_that_stands_elsewhere_is_told_from_a_model_that_is_wrong() -> None:
    astray = RIGHT.copy()
    astray[[4, 20]] = ring(ALL_AROUND[[4, 20]] + 25.0)
    assert contradicted_images(model(astray, 600, 0.8), MATCHES) == (4, 20)
    assert contradicted_images(model(RIGHT, 600, 0.8), MATCHES) == ()
    assert contradicted_images(model(TWISTED, 600, 0.8), MATCHES) == (), "who knows which"
    few = {pair: found for pair, found in MATCHES.items() if 4 not in pair or pair == (4, 5)}
    assert contradicted_images(model(astray, 600, 0.8), few) == (20,), "one pair says little"
