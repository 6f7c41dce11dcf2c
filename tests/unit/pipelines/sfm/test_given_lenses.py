"""Whether lenses that came along may be adjusted, for all at once, and what speaks against it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.given_depth import Beside
from pipelines.sfm.given_fit import Fit
from pipelines.sfm.given_lenses import (
    LensTrial,
    as_changed,
    as_first_lens,
    common_lens,
    objection,
    with_lenses,
)
from pipelines.sfm.given_refinement import as_found, refine
from pipelines.sfm.tracks import Observations
from pipelines.tools.colmap_rays import rays_through
from tests.unit.pipelines.sfm.made_corridor import at_once

LENS = Intrinsics(640, 480, 520.0, 520.0, 318.0, 243.0)
TRUE = replace(LENS, model="OPENCV", k1=0.08, k2=-0.15, p1=0.001, p2=-0.0005)
NUM = 24


def arc() -> np.ndarray:
    """Poses [N, 3, 4], OpenCV axes, on an arc of 100 degrees about the origin, 3 away."""
    poses = []
    for index, angle in enumerate(np.radians(np.linspace(0.0, 100.0, NUM))):
        center = np.array([3.0 * np.sin(angle), 0.4 * np.sin(1.3 * index), -3.0 * np.cos(angle)])
        ahead = -center / np.linalg.norm(center)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        poses.append(np.column_stack([rotation, center]))
    return np.array(poses)


def sightings(lenses: list[Intrinsics], noise_px: float = 0.2) -> Observations:
    """What such lenses show of 400 points about the origin."""
    random = np.random.default_rng(3)
    points = random.uniform(-1.2, 1.2, (400, 3))
    rows = []
    for image, (pose, lens) in enumerate(zip(arc(), lenses, strict=True)):
        local = (points - pose[:, 3]) @ pose[:, :3]
        x, y = (local[:, :2] / local[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + lens.k1 * r2 + lens.k2 * r2**2
        u = x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
        v = y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
        xy = np.stack([u * lens.fl_x + lens.cx, v * lens.fl_y + lens.cy], axis=1)
        xy += random.normal(0.0, noise_px, xy.shape)
        inside = ((xy > 0) & (xy < (lens.width, lens.height))).all(axis=1)
        rows += [(track, image, *xy[track]) for track in np.flatnonzero(inside).tolist()]
    rows.sort()
    table = np.array(rows)
    return Observations(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])


def refined_by(given: list[Intrinsics], seen: Observations, *, error_px: float = 4.0) -> Any:
    common: dict[str, Any] = {
        "error_px": error_px,
        "long_side_px": 640,
        "run": at_once,
        "num_threads": 1,
    }
    drift = np.sin(np.linspace(0.0, 6.0, NUM))[:, None] * (0.02, -0.015, 0.01)
    poses = arc()
    poses[:, :, 3] += drift
    first = refine(poses, given, seen, **common, seed=0)
    return first, with_lenses(poses, first, seen, **common, report=lambda *_: None)


def test_the_lens_of_the_pictures_is_found_beside_their_poses() -> None:
    """A nominal lens, 8 % too long and without distortion, autofocus about it."""
    zooms = [1.0 + 0.02 * np.sin(index) for index in range(NUM)]
    true = [replace(TRUE, fl_x=zoom * 520.0, fl_y=zoom * 520.0) for zoom in zooms]
    given = [replace(LENS, fl_x=zoom * 562.0, fl_y=zoom * 562.0) for zoom in zooms]
    first, found = refined_by(given, sightings(true))
    assert found is not None
    for lens, wanted in zip(found.lenses, true, strict=True):
        assert lens.fl_x == pytest.approx(wanted.fl_x, rel=0.003)
        assert lens.fl_y == pytest.approx(wanted.fl_y, rel=0.003)
        assert (lens.cx, lens.cy) == (wanted.cx, wanted.cy)
        assert lens.k1 == pytest.approx(wanted.k1, abs=0.01)
        assert lens.k2 == pytest.approx(wanted.k2, abs=0.03)
    assert first.lenses == tuple(given)
    assert found.before is first.before

    def bent(poses: np.ndarray) -> float:
        """How far camera 0 is turned against the last one, off the truth, degrees."""
        turns = [p[-1, :, :3] @ p[0, :, :3].T for p in (poses, arc())]
        cosine = (np.trace(turns[0] @ turns[1].T) - 1) / 2
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

    assert bent(found.poses) < 0.2
    assert bent(first.poses) > 5 * bent(found.poses)


def test_a_right_lens_stays_what_it_is() -> None:
    _, found = refined_by([TRUE] * NUM, sightings([TRUE] * NUM))
    assert found is not None
    assert found.lenses[0].fl_x == pytest.approx(520.0, rel=0.002)
    assert found.lenses[0].k1 == pytest.approx(TRUE.k1, abs=0.01)


@pytest.mark.parametrize(
    "other",
    [
        replace(LENS, fl_x=700.0, fl_y=700.0),
        replace(LENS, width=480, height=640),
        replace(LENS, model="OPENCV", k1=0.01),
        replace(LENS, model="OPENCV_FISHEYE"),
    ],
    ids=["another zoom", "turned", "other distortion", "fisheye"],
)
def test_lenses_of_several_devices_stay(other: Intrinsics) -> None:
    assert common_lens([LENS] * 3) == LENS
    assert common_lens([LENS, LENS, other]) is None
    assert common_lens([other] * 3) == (None if other.model == "OPENCV_FISHEYE" else other)


def test_one_change_is_that_of_all() -> None:
    """What a changed lens shows of a place is what the changed first one shows of it there."""
    lenses = [LENS, replace(LENS, fl_x=530.0, fl_y=531.0, cx=310.0)]
    changed = replace(TRUE, fl_x=470.0, fl_y=475.0)
    places = np.random.default_rng(1).uniform((0, 0), (640, 480), (50, 2))
    seen = Observations(np.arange(50), np.ones(50, np.int64), places)
    own = as_changed(lenses[1], LENS, changed)
    np.testing.assert_allclose(
        rays_through(own, places), rays_through(changed, as_first_lens(lenses, seen)), atol=1e-9
    )


def fit(error_px: float, agreement: float = 0.98) -> Fit:
    none = np.zeros(0)
    return Fit(error_px, error_px, agreement, 1000, NUM, np.zeros((0, 2), np.int64), none, none)


def beside(spread: float) -> Beside:
    return Beside(1.0, spread, 2.0, 500, NUM)


@pytest.mark.parametrize(
    ("lens", "after", "spread", "words"),
    [
        (TRUE, fit(0.3), 0.01, None),
        (TRUE, fit(0.3), None, None),
        (TRUE, None, 0.01, "too few matches"),
        (TRUE, fit(0.39), 0.01, "set aside miss"),
        (TRUE, fit(0.3, 0.97), 0.01, "set aside miss"),
        (TRUE, fit(0.3), 0.03, "measured depth"),
        (replace(TRUE, fl_y=530.0), fit(0.3), 0.01, "do not tell"),
        (replace(TRUE, fl_x=650.0, fl_y=650.0), fit(0.3), 0.01, "do not tell"),
    ],
)
def test_what_speaks_against_another_lens(
    lens: Intrinsics, after: Fit | None, spread: float | None, words: str | None
) -> None:
    seen = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    nothing = np.zeros((0, 3)), np.zeros(0, bool)
    given = as_found(arc(), [LENS] * NUM, *nothing, seen)
    trial = replace(as_found(arc(), [lens] * NUM, *nothing, seen), before=given)
    now = None if spread is None else beside(spread)
    against = objection(fit(0.4), after, (beside(0.02), now), trial)
    assert (against is None) == (words is None)
    assert words is None or words in str(against)
    told = LensTrial(LENS, lens, against, after, now).as_dict()
    assert told["taken"] == (words is None)
    assert told["focal"] == pytest.approx(np.sqrt(lens.fl_x * lens.fl_y) / 520.0, abs=1e-4)
