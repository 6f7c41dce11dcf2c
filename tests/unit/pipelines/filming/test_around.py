"""Directions, from cameras whose places are known."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.filming.around import look_around
from tests.unit.pipelines.filming.takes import ring


def test_a_full_round_is_covered() -> None:
    around = look_around(ring(36))
    assert around is not None
    np.testing.assert_allclose(around.focus, 0.0, atol=1e-9)
    assert (around.covered_deg, around.widest_gap_deg) == (360.0, 0.0)


@pytest.mark.parametrize("arc", [60.0, 90.0, 200.0])
def test_an_arc_is_covered_as_far_as_it_goes(arc: float) -> None:
    around = look_around(ring(60, around_deg=arc))
    assert around is not None
    assert around.covered_deg == pytest.approx(arc * 59 / 60 + 20.0)
    assert around.widest_gap_deg == pytest.approx(360.0 - around.covered_deg)
    turn = np.radians(7.0)
    across = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    turned = look_around(across @ ring(60, around_deg=arc))
    assert turned is not None
    assert turned.covered_deg == pytest.approx(around.covered_deg), "whichever way +X points"


def test_two_arcs_leave_two_gaps() -> None:
    poses = ring(72)
    around = look_around(np.concatenate([poses[:10], poses[36:46]]))
    assert around is not None
    assert around.widest_gap_deg < 360.0 - around.covered_deg


def test_cameras_that_look_outwards_share_no_subject() -> None:
    poses = ring(36)
    poses[:, :, [0, 2]] *= -1.0
    assert look_around(poses) is None
    assert look_around(ring(2)) is None
