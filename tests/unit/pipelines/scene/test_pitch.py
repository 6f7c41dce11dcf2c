"""How far cameras that all look one way are tipped, by what they see."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene.orientation import normalise
from pipelines.scene.pitch import Array
from tests.unit.pipelines.scene.test_orientation import angle_deg, moved, rotation_about
from tests.unit.pipelines.scene.test_orientation import random_rotation as rotation

UP = np.array([0.0, 0.0, 1.0])


def tipped(places: Array, pitch_deg: float, seed: int = 0) -> Array:
    """[N, 3, 4] cameras that look along +X, tipped up by so much, in a hand that shakes."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    axes = np.array([[0.0, -s, -c], [-1.0, 0.0, 0.0], [0.0, c, -s]])
    poses = [
        np.column_stack([rotation_about(rng.normal(scale=0.03, size=3)) @ axes, place])
        for place in places
    ]
    return np.stack(poses)


def plane(
    rng: np.random.Generator, num: int, low: tuple[float, ...], high: tuple[float, ...]
) -> Array:
    """Points between two corners, a centimetre off."""
    return np.asarray(rng.uniform(low, high, (num, 3)) + rng.normal(scale=0.01, size=(num, 3)))


def corridor(rng: np.random.Generator) -> Array:
    """12 m, with most of its points on the walls to both sides, which say nothing."""
    return np.concatenate(
        [
            plane(rng, 900, (0.0, -0.7, 0.0), (14.0, 0.7, 0.0)),
            plane(rng, 300, (0.0, -0.7, 2.5), (14.0, 0.7, 2.5)),
            plane(rng, 1200, (0.0, -0.7, 0.0), (14.0, -0.7, 2.5)),
            plane(rng, 1200, (0.0, 0.7, 0.0), (14.0, 0.7, 2.5)),
            plane(rng, 200, (14.0, -0.7, 0.0), (14.0, 0.7, 2.5)),
        ]
    )


def shelf(rng: np.random.Generator) -> Array:
    """Five boards and what stands on them, before a wall."""
    boards = [plane(rng, 150, (1.5, 0.0, z), (1.9, 3.0, z)) for z in np.arange(5) * 0.4]
    things = [plane(rng, 150, (1.5, 0.0, z), (1.7, 3.0, z + 0.3)) for z in np.arange(5) * 0.4]
    return np.concatenate([*boards, *things, plane(rng, 300, (1.9, 0.0, 0.0), (1.9, 3.0, 2.0))])


def facade(rng: np.random.Generator) -> Array:
    """Windows and cornices of a front, and the street before it."""
    front = plane(rng, 1500, (12.0, -8.0, 0.0), (12.0, 8.0, 12.0))
    sills = plane(rng, 300, (12.0, -8.0, 0.0), (12.4, 8.0, 12.0))
    return np.concatenate([front, sills, plane(rng, 200, (4.0, -8.0, 0.0), (12.0, 8.0, 0.0))])


def table(rng: np.random.Generator) -> Array:
    """A thing on a table."""
    thing = 0.15 * rng.normal(size=(400, 3)) + np.array([1.2, 0.0, 0.9])
    return np.concatenate([thing, plane(rng, 600, (0.8, -0.6, 0.75), (2.0, 0.6, 0.75))])


def along(direction: tuple[float, float, float], reach: float, height: float) -> Array:
    steps = np.linspace(0.0, reach, 40)[:, None]
    return np.asarray(steps * np.asarray(direction) + np.array([0.0, 0.0, height]))


@pytest.mark.parametrize(
    ("points", "places", "pitches"),
    [
        (corridor, along((1.0, 0.0, 0.0), 11.0, 1.5), (-30.0, -20.0, -10.0, 0.0, 15.0)),
        (shelf, along((0.0, 1.0, 0.0), 3.0, 1.5), (-25.0, -10.0, 0.0, 10.0)),
        (facade, along((0.0, 1.0, 0.0), 6.0, 1.6), (0.0, 10.0, 20.0)),
        (table, along((0.0, 1.0, 0.0), 0.3, 1.5), (-35.0, -20.0)),
    ],
)
def test_a_floor_or_a_front_tells_how_far_cameras_are_tipped(
    points: object, places: Array, pitches: tuple[float, ...]
) -> None:
    for number, pitch in enumerate(pitches):
        rng = np.random.default_rng(number)
        seen = points(rng)  # type: ignore[operator]
        cameras = tipped(places, pitch, number)
        turn = rotation(number)
        turned = np.concatenate(
            [turn @ cameras[:, :, :3], (cameras[:, :, 3] @ turn.T)[:, :, None]], axis=2
        )
        found = normalise(turned, points=seen @ turn.T)
        assert found.up_from == "planes"
        assert angle_deg(found.similarity.rotation.T @ UP, turn @ UP) < 3.0, pitch


@pytest.mark.parametrize("pitch", [-25.0, 0.0, 20.0])
def test_a_heap_says_nothing(pitch: float) -> None:
    rng = np.random.default_rng(3)
    cameras = tipped(along((0.0, 1.0, 0.0), 2.0, 1.5), pitch)
    for heap in (
        np.array([3.0, 1.0, 0.5]) + rng.normal(size=(2000, 3)),
        rng.uniform((2.0, -1.0, 0.0), (4.0, 3.0, 2.0), (2000, 3)) + rng.normal(scale=0.3, size=3),
        np.array([3.0, 1.0, 0.5]) + 0.1 * rng.normal(size=(50, 3)),
    ):
        found = normalise(cameras, points=heap)
        assert found.up_from == "camera_up"


def test_cameras_that_turn_know_without() -> None:
    rng = np.random.default_rng(4)
    cameras = moved(np.concatenate([tipped(along((1.0, 0.0, 0.0), 5.0, 1.5), -10.0)] * 2), 2)
    quarter = rotation_about(np.array([0.0, 0.0, np.pi / 2]))
    cameras[40:, :, :3] = quarter @ cameras[40:, :, :3]
    assert normalise(cameras, points=corridor(rng)).up_from == "vertical"
