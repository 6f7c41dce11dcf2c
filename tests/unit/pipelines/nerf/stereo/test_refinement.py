"""Points of a painted wall are moved onto it by what photos agree on; kernel and twin alike."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.nerf.stereo.refinement import Offsets, Pictures, photo_offsets, plain_search
from pipelines.nerf.stereo.views import StereoView
from tests.unit.pipelines.nerf.stereo.painted_wall import SLOPE, WALL, Floats, look

ORIGIN = np.array([10.0, -4.0, 7.0])
TOWARD = np.array([SLOPE, 0.0, -1.0]) / np.hypot(SLOPE, 1.0)


def views() -> list[StereoView]:
    """Six cameras before the wall, 18 degrees apart at most."""
    places = ((-0.6, 0.0), (0.0, -0.5), (0.6, 0.1), (0.3, 0.5), (-0.3, 0.4), (0.0, 0.0))
    return [look(x, y, with_box=False, size=2)[0] for x, y in places]


def points(count: int = 12) -> Floats:
    """On the wall, where all cameras see it."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, count), np.linspace(-0.5, 0.5, count))
    return np.stack([x, y, WALL + SLOPE * x], axis=-1).reshape(-1, 3)


def offsets_of(
    shift: float, seen_by: list[StereoView], *, plain: bool = False, hidden: int = 0
) -> Offsets:
    """What is said of points that lie before the wall by `shift`; `hidden` views see none."""
    places = points(6 if plain else 12)
    seen = np.ones((len(seen_by), len(places)), np.uint8)
    seen[:hidden] = 0
    moved = [
        StereoView(
            view.picture,
            view.lens,
            np.column_stack([view.world_from_camera[:, :3], view.center + ORIGIN]),
        )
        for view in seen_by
    ]
    return photo_offsets(
        places + shift * TOWARD,
        np.tile(TOWARD, (len(places), 1)),
        seen,
        Pictures.of(moved, ORIGIN),
        5,
        plain_search if plain else None,
    )


@pytest.mark.parametrize("shift", [0.0, 0.04, -0.05])
def test_points_find_the_wall_again(shift: float) -> None:
    found = offsets_of(shift, views())
    sure = found.trust > 0.5
    assert sure.mean() > 0.8
    # Half a pixel at the widest angle is 0.04 here: a tenth of it is a twentieth of a pixel.
    assert 0.03 < np.median(found.step) < 0.06
    assert np.median(np.abs(found.length[sure] + shift)) < 0.1 * np.median(found.step)


def test_the_kernel_equals_its_plain_twin() -> None:
    shown = views()
    picture = shown[2].picture.copy()
    picture[60:80, 90:120] = -1.0
    shown[2] = StereoView(picture, shown[2].lens, shown[2].world_from_camera)
    places = points(6) + 0.03 * TOWARD
    rng = np.random.default_rng(1)
    tilted = np.tile(TOWARD, (len(places), 1)) + 0.2 * rng.standard_normal((len(places), 3))
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    seen = (rng.random((len(shown), len(places))) < 0.8).astype(np.uint8)
    pictures = Pictures.of(shown, np.zeros(3))
    fast = photo_offsets(places, tilted, seen, pictures, 4)
    plain = photo_offsets(places, tilted, seen, pictures, 4, plain_search)
    assert (plain.trust > 0).sum() > 10
    np.testing.assert_allclose(fast.step, plain.step, rtol=1e-4)
    np.testing.assert_allclose(fast.trust, plain.trust, atol=2e-3)
    np.testing.assert_allclose(fast.length, plain.length, atol=2e-3 * float(plain.step.max()))


def test_a_plain_wall_says_nothing() -> None:
    grey = [
        StereoView(np.full_like(view.picture, 0.5), view.lens, view.world_from_camera)
        for view in views()
    ]
    found = offsets_of(0.04, grey)
    assert not found.trust.any()
    assert not found.length.any()


def test_two_views_are_too_few() -> None:
    assert offsets_of(0.04, views(), hidden=3).trust.any()
    assert not offsets_of(0.04, views(), hidden=4).trust.any()


def test_what_lies_beyond_the_steps_is_not_believed() -> None:
    far = offsets_of(1.0, views())
    assert np.mean(far.trust > 0.5) < 0.1


def test_progress_is_told_and_may_stop_it() -> None:
    class Stop(Exception):
        pass

    told: list[float] = []

    def stop(done: float) -> None:
        told.append(done)
        raise Stop

    seen = np.ones((6, 20_000), np.uint8)
    places = np.tile(points(1), (20_000, 1))
    pictures = Pictures.of(views(), np.zeros(3))
    with pytest.raises(Stop):
        photo_offsets(places, np.tile(TOWARD, (20_000, 1)), seen, pictures, 1, on_progress=stop)
    assert len(told) == 1
    assert told[0] < 0.5
