"""Edges are found between two colours to a tenth of a pixel, and not where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.surface.color_edges import STEP_PX, STEPS, Floats, edge_between

FRONT, BACK = np.array([0.8, 0.4, 0.2]), np.array([0.2, 0.4, 0.7])


def profiles(edges: Floats, front: Floats = FRONT, back: Floats = BACK) -> Floats:
    """[P, T, 3]: one colour up to each edge, the other one behind; samples are a step wide."""
    share = np.clip((edges[:, None] - STEPS) / STEP_PX + 0.5, 0.0, 1.0)[..., None]
    mixed: Floats = share * front + (1.0 - share) * back
    return mixed


def found(photo: Floats, own: Floats, begin: float = 0.5) -> tuple[Floats, Floats]:
    """The edges, where the model ends at 0."""
    before = np.broadcast_to(STEPS < 0.0, photo.shape[:2])
    return edge_between(photo, own, before, ~before, begin)


def test_an_edge_is_found_to_a_fraction_of_a_pixel() -> None:
    edges = np.linspace(-4.5, 4.5, 37)

    places, trust = found(profiles(edges), profiles(np.zeros(37)))

    assert np.abs(places - edges).max() < 0.15
    assert trust.min() > 0.3


def test_a_highlight_moves_nothing() -> None:
    photo = profiles(np.array([1.0]))
    photo[0, 20:22] = 1.0

    places, trust = found(photo, profiles(np.zeros(1)))

    assert abs(places[0] - 1.0) < 0.3
    assert trust[0] > 0.0


def test_a_flap_needs_a_deeper_look() -> None:
    own = profiles(np.array([-3.5]))
    photo = profiles(np.array([-3.5]))

    just, deeper = found(photo, own, 0.5), found(photo, own, 3.0)

    assert just[1][0] == 0.0
    assert abs(deeper[0][0] + 3.5) < 0.6
    assert deeper[1][0] > 0.5


@pytest.mark.parametrize(
    "photo",
    [
        pytest.param(profiles(np.array([7.0])), id="too far before"),
        pytest.param(profiles(np.array([-7.0])), id="too far behind"),
        pytest.param(profiles(np.array([0.0]), BACK, FRONT), id="the other way round"),
        pytest.param(np.full((1, len(STEPS), 3), 0.5), id="neither colour"),
    ],
)
def test_what_is_no_edge_is_not_trusted(photo: Floats) -> None:
    _, trust = found(photo, profiles(np.zeros(1)))

    assert trust[0] < 0.05


def test_like_colours_say_nothing() -> None:
    alike = profiles(np.zeros(1), FRONT, FRONT + 0.03)

    _, trust = found(alike, alike)

    assert trust[0] == 0.0


def test_a_side_that_is_not_seen_says_nothing() -> None:
    own = profiles(np.zeros(1))
    seen = np.broadcast_to(STEPS < 0.0, own.shape[:2])

    _, trust = edge_between(own, own, seen, np.zeros_like(seen), 0.5)

    assert trust[0] == 0.0
