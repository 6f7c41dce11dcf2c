"""Photos without EXIF that mix lenses: told apart by focal lengths of images by themselves."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.lens_groups import (
    Lenses,
    OwnLenses,
    Settled,
    grouped,
    told_apart,
)
from pipelines.sfm.mending import Mapping
from pipelines.sfm.report import Attempt, Outcome, mixed_lens_warnings
from pipelines.sfm.rungs import RUNGS
from pipelines.sfm.source import Source, unknown_lenses
from pipelines.tools.colmap_results import PairStatistics, SparseModel
from tests.unit.pipelines.sfm.synthetic_room import FOCAL, arc_poses, render, save_photos
from tests.unit.pipelines.sfm.test_tears import LENS, OPENCV, Matches, climbed, turns_off_deg
from tests.unit.pipelines.sfm.test_zooms import zoomed

Floats = npt.NDArray[np.float64]
LOGGER = logging.getLogger(__name__)
NUM = 12
ZOOMED = frozenset({2, 5, 8})


def alone(num: int, zoom: Sequence[float], spread: float = 0.02) -> dict[int, float]:
    """Focal lengths in pixels of images by themselves, each a little off."""
    off = np.exp(np.random.default_rng(4).uniform(-spread, spread, num))
    return {i: float(500.0 * zoom[i % len(zoom)] * off[i]) for i in range(num)}


def test_one_lens_stays_one() -> None:
    assert grouped(alone(30, [1.0]), [range(30)]) == ()
    assert grouped(alone(30, [1.0], spread=0.09), [range(30)]) == (), "a capture that tells little"
    assert grouped({}, [range(30)]) == ()


def test_lenses_of_a_phone_are_groups_however_uneven() -> None:
    told = grouped(alone(30, [1.0, 1.0, 0.5, 1.0, 2.0, 1.0]), [range(30)])
    sizes = sorted((round(scale, 1), len(images)) for images, scale in told)
    assert sizes == [(0.5, 5), (2.0, 5)]
    focals = {**alone(30, [1.0]), 3: 1010.0, 11: 995.0, 20: 1020.0}
    ((images, scale),) = grouped(focals, [range(30)])
    assert images == (3, 11, 20)
    assert scale == pytest.approx(2.0, rel=0.03)


def test_photos_cropped_otherwise_each_get_a_camera_each() -> None:
    focals = dict(enumerate(500.0 * np.linspace(1.0, 2.2, 24)))
    told = grouped(focals, [range(24)])
    assert all(len(images) == 1 for images, _ in told)
    assert len(told) == 23, "the first keeps the camera that all had"


def test_pictures_of_two_sizes_are_not_compared() -> None:
    upright = alone(20, [1.0])
    wide = {20 + i: 1.8 * focal for i, focal in alone(10, [1.0]).items()}
    assert grouped({**upright, **wide}, [range(20), range(20, 30)]) == ()


def test_an_image_without_a_pose_gets_a_camera_of_its_own_beside_its_like() -> None:
    told = grouped(alone(10, [1.0]), [range(12)], others=[11])
    assert told == (((11,), 1.0),)


def model_of(poses: Floats, focal_px: Sequence[float]) -> SparseModel:
    """Each image with a lens of its own."""
    return SparseModel(
        indices=tuple(range(len(poses))),
        cameras=tuple(Intrinsics(400, 300, f, f, 200.0, 150.0) for f in focal_px),
        camera_of=tuple(range(len(poses))),
        world_from_camera=poses,
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        track_lengths=np.zeros(0, np.int64),
        error_px=0.5,
        angle_deg=10.0,
    )


def true_poses() -> Floats:
    """[NUM, 3, 4], OpenCV axes."""
    poses = arc_poses(NUM)
    return np.concatenate([poses[:, :, :3] @ OPENCV, poses[:, :, 3:]], axis=2)


def matches_of(focal_px: Sequence[float]) -> Matches:
    """What all pairs of images show of points in the room."""
    random = np.random.default_rng(6)
    points, poses = random.uniform(0.0, 1.2, (40, 3)), true_poses()
    places = []
    for pose, focal in zip(poses, focal_px, strict=True):
        local = (points - pose[:, 3]) @ pose[:, :3]
        places.append(focal * local[:, :2] / local[:, 2:] + [200.0, 150.0])
    return {(i, j): (places[i], places[j]) for i in range(NUM) for j in range(i + 1, NUM)}


TRUE = [LENS.fl_x * (2.0 if i in ZOOMED else 1.0) for i in range(NUM)]
FLAT = [LENS.fl_x] * NUM


def own(focal_px: Sequence[float], share: float = 0.0, num_held: int = 240) -> OwnLenses:
    """Focal lengths by themselves, which lower the held-out error of those aside by that share."""
    told = dict(enumerate(focal_px))
    aside = tuple(image for images, _ in grouped(told, [range(NUM)]) for image in images)
    image_of = np.arange(num_held) % NUM
    shared = 1.0 + 0.1 * np.random.default_rng(7).random(num_held)
    return OwnLenses(told, aside, shared, shared * np.sqrt(1.0 - share), image_of)


def parted(
    before: OwnLenses, after: OwnLenses, second: Sequence[float]
) -> tuple[Mapping, Lenses, Settled, list[Lenses]]:
    """Told apart, of a first mapping by one focal length and a second one by others."""
    asked: list[Lenses] = []
    first = Mapping([model_of(true_poses(), FLAT)], None)  # type: ignore[arg-type]
    anew = replace(first, models=[model_of(true_poses(), second)])

    def mapped(lenses: Lenses) -> Mapping:
        asked.append(lenses)
        return anew

    found, lenses, settled = told_apart(
        first,
        mapped,
        [range(NUM)],
        matches_of(TRUE),
        lambda mapping, _: before if mapping is first else after,
        [200] * NUM,
        LOGGER,
    )
    return found, lenses, settled, asked


def test_lenses_told_apart_are_taken_where_matches_agree_better() -> None:
    half_way = [focal * (0.8 if focal > LENS.fl_x else 1.0) for focal in TRUE]
    found, lenses, settled, asked = parted(own(half_way, 0.3), own(TRUE), TRUE)
    assert [images for images, _ in lenses] == [tuple(sorted(ZOOMED))]
    assert found.models[0].cameras[2].fl_x == pytest.approx(2.0 * LENS.fl_x)
    assert (settled, len(asked)) == ("several", 1)


def test_lenses_that_make_nothing_better_are_not_taken_and_that_is_told() -> None:
    found, lenses, settled, asked = parted(own(TRUE, 0.3), own(TRUE, 0.3), FLAT)
    assert (lenses, settled, len(asked)) == ((), "doubtful", 1)
    assert found.models[0].cameras[2].fl_x == LENS.fl_x


def test_lenses_that_are_joined_though_they_differ_stay_apart() -> None:
    cropped = [focal * (1.0 + 0.02 * (i % 4)) for i, focal in enumerate(TRUE)]
    first = Mapping([model_of(true_poses(), TRUE)], None)  # type: ignore[arg-type]
    each = tuple(((i,), 1.0) for i in range(NUM))
    _, lenses, settled = told_apart(
        first,
        lambda _: replace(first),
        [range(NUM)],
        {pair: places for pair, places in matches_of(TRUE).items() if pair != (0, 1)},
        lambda mapping, _: own(cropped, 0.0 if mapping is first else 0.3),
        [200] * NUM,
        LOGGER,
        each,
    )
    assert (lenses, settled) == (each, "several")


def test_of_a_model_in_pieces_each_image_gets_a_camera_where_that_places_more() -> None:
    piece = model_of(true_poses()[:4], FLAT[:4])
    first = Mapping([piece], None)  # type: ignore[arg-type]
    whole = replace(first, models=[model_of(true_poses(), TRUE)])
    zooms = [LENS.fl_x * 1.3 ** (i % 6) for i in range(NUM)]

    def found(focal_px: Sequence[float]) -> tuple[Mapping, Lenses, Settled]:
        return told_apart(
            first,
            lambda _: whole,
            [range(NUM)],
            matches_of(TRUE),
            lambda _mapping, _model: own(focal_px),
            [200] * NUM,
            LOGGER,
        )

    mapping, lenses, settled = found(zooms)
    assert (mapping, settled) == (whole, "several")
    assert sum(len(images) for images, _ in lenses) >= NUM - 2
    assert found(FLAT) == (first, (), "unsuspected"), "of one lens it stays as it was"


def test_one_lens_is_not_mapped_again() -> None:
    assert parted(own(FLAT), own(FLAT), FLAT)[1:] == ((), "unsuspected", [])
    spoilt = own([2.0 * FLAT[0], *FLAT[1:]], share=-0.4, num_held=NUM * 70)
    assert parted(spoilt, own(FLAT), FLAT)[1:] == ((), "unsuspected", [])


def test_what_was_not_settled_is_told_with_what_to_do() -> None:
    def told(lenses: Settled, agreement: float) -> list[str]:
        model = replace(model_of(true_poses(), FLAT), agreement=agreement)
        attempt = Attempt(RUNGS[0], "exhaustive", (model,), 1.0, lenses=lenses)
        outcome = Outcome((attempt,), PairStatistics.nothing(NUM))
        warnings = mixed_lens_warnings(outcome)
        assert all("originals" in warning["hint"] for warning in warnings)
        return [warning["code"] for warning in warnings]

    assert told("doubtful", 0.9) == told("unsuspected", 0.7) == ["lenses_unsettled"]
    assert told("unsuspected", 0.9) == told("several", 0.7) == told("known", 0.6) == []


def test_lenses_are_unknown_of_photos_whose_exif_is_silent(tmp_path: Path) -> None:
    save_photos(tmp_path, [render(pose) for pose in arc_poses(3)])
    files = tuple(f"images/{i:02d}.jpg" for i in range(3))
    photos = Source(tmp_path / "ingest", files, (None,) * 3, is_video=False)
    assert unknown_lenses(photos, "SIMPLE_RADIAL") == [(0, 1, 2)]
    assert unknown_lenses(photos, "OPENCV_FISHEYE") == []
    assert unknown_lenses(replace(photos, is_video=True), "SIMPLE_RADIAL") == []
    told = replace(photos, exif=({"focal_35mm": 26.0}, {}, {"focal_35mm": 26.0}))
    assert unknown_lenses(told, "SIMPLE_RADIAL") == [(1,)]
    millimetres = replace(photos, exif=({"focal_mm": 20.0}, {}, {"focal_mm": 20.0}))
    assert unknown_lenses(millimetres, "SIMPLE_RADIAL") == [(1,)], "of which sensor nobody knows"


def test_photos_of_two_zooms_have_two_cameras_and_true_poses(tmp_path: Path) -> None:
    poses = arc_poses(NUM)
    pictures = [render(pose) for pose in poses]
    pictures = [zoomed(one, 1.6) if i in ZOOMED else one for i, one in enumerate(pictures)]
    save_photos(tmp_path, pictures)
    outcome, _ = climbed(tmp_path, tuple(rung for rung in RUNGS if rung.name == "quick"))
    model = outcome.chosen.best
    assert model is not None
    assert outcome.chosen.num_registered == NUM
    assert outcome.chosen.lenses == "several"
    focal = np.array([model.cameras[camera].fl_x for camera in model.camera_of])
    aside = np.array([i in ZOOMED for i in range(NUM)])
    assert np.median(focal[~aside]) == pytest.approx(FOCAL, rel=0.05)
    assert focal[aside] / np.median(focal[~aside]) == pytest.approx(1.6, rel=0.04)
    true = np.concatenate([poses[:, :, :3] @ OPENCV, poses[:, :, 3:]], axis=2)
    assert turns_off_deg(model, true).max() < 0.6
