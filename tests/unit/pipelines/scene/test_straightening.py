"""Up where people held their cameras aslant, by what is level in the scene."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene.orientation import Array, Similarity, normalise
from tests.unit.pipelines.scene.test_orientation import angle_deg, rotation_about
from tests.unit.pipelines.scene.test_orientation import random_rotation as rotation
from tests.unit.pipelines.scene.test_pitch import plane

UP = np.array([0.0, 0.0, 1.0])


def around(arc_deg: float, aslant_deg: float, num: int = 60) -> Array:
    """[N, 3, 4] cameras in an arc around what they look down at, all turned about their gaze."""
    rng = np.random.default_rng(3)
    poses = []
    for angle in np.radians(np.linspace(0.0, arc_deg, num)):
        place = 2.0 * np.array([np.cos(angle), np.sin(angle), 0.5])
        back = place / np.linalg.norm(place)
        right = np.cross(UP, back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back], axis=1)
        held = rotation_about(back * np.radians(aslant_deg)) @ axes
        shaking = rotation_about(rng.normal(scale=0.03, size=3))
        poses.append(np.column_stack([shaking @ held, place]))
    return np.stack(poses)


def table(rng: np.random.Generator) -> Array:
    """A box on a table, a heap beside it."""
    return np.concatenate(
        [
            plane(rng, 800, (-1.0, -1.0, 0.0), (1.0, 1.0, 0.0)),
            plane(rng, 300, (-0.3, -0.2, 0.3), (0.3, 0.2, 0.3)),
            plane(rng, 300, (-0.3, -0.2, 0.0), (0.3, -0.2, 0.3)),
            rng.normal((0.6, 0.6, 0.15), 0.15, (500, 3)),
        ]
    )


def heap(rng: np.random.Generator) -> Array:
    """No plane at all."""
    return np.asarray(rng.normal(0.0, 0.4, (2000, 3)))


def slope(rng: np.random.Generator) -> Array:
    """A figure on a lawn that falls by nine degrees."""
    lawn = plane(rng, 1200, (-1.5, -1.5, 0.0), (1.5, 1.5, 0.0))
    lawn[:, 2] += np.tan(np.radians(9.0)) * lawn[:, 0]
    return np.concatenate([lawn, rng.normal((0.0, 0.0, 0.4), (0.1, 0.1, 0.2), (600, 3))])


def off_deg(poses: Array, points: Array | None, seed: int) -> tuple[float, float]:
    """By how much the world leans, and by how much it was straightened; in any frame."""
    frame = Similarity(rotation(seed), np.array([5.0, -3.0, 2.0]), 3.7)
    there = None if points is None else frame.apply_to_points(points)
    world = normalise(frame.apply_to_cameras(poses), points=there)
    assert world.up_from == "vertical"
    up = world.similarity.rotation @ frame.rotation @ UP
    return angle_deg(up, UP), world.straightened_deg


@pytest.mark.parametrize(("arc_deg", "aslant_deg"), [(60.0, 8.0), (90.0, 5.0), (150.0, -4.0)])
def test_a_table_filmed_aslant_is_level(arc_deg: float, aslant_deg: float) -> None:
    poses, points = around(arc_deg, aslant_deg), table(np.random.default_rng(1))
    before, _ = off_deg(poses, None, 4)
    after, by = off_deg(poses, points, 4)
    assert before > 3.0
    assert after < 0.7
    assert by == pytest.approx(before, abs=0.7)


@pytest.mark.parametrize("made", [heap, slope])
def test_what_says_nothing_or_slopes_changes_nothing(made: object) -> None:
    """A lawn is not made level by who has gone all round it."""
    poses = around(360.0, 1.0)
    points = made(np.random.default_rng(1))  # type: ignore[operator]
    assert off_deg(poses, points, 5) == (pytest.approx(off_deg(poses, None, 5)[0]), 0.0)


def test_few_points_say_nothing() -> None:
    points = table(np.random.default_rng(1))[::40]
    assert off_deg(around(60.0, 8.0), points, 6)[1] == 0.0


def test_what_devices_measured_is_not_straightened() -> None:
    """A ramp that is filmed by who knows which way is up stays a ramp."""
    poses, points = around(60.0, 8.0), slope(np.random.default_rng(1))
    measured = [pose[:, :3].T @ UP for pose in poses]
    world = normalise(poses, measured=measured, points=points)
    assert (world.up_from, world.straightened_deg) == ("measured", 0.0)
    assert angle_deg(world.similarity.rotation @ UP, UP) < 0.1
