"""Quaternions and matrices, each against the other and against a rotation's definition."""

from __future__ import annotations

import numpy as np

from pipelines.scene.rotations import quaternions, rotation_between, rotation_matrices


def unit(num: int, size: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(num, size))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def test_quaternions_invert_rotation_matrices() -> None:
    q = np.random.default_rng(1).normal(size=(50, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((quaternions(rotation_matrices(q)) * q).sum(1)), 1.0)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    half = np.sqrt(0.5)
    turn = rotation_matrices(np.array([[half, 0.0, 0.0, half]]))[0]
    np.testing.assert_allclose(turn @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


def test_a_quaternion_need_not_have_length_one() -> None:
    q = unit(5, 4, 2)
    np.testing.assert_allclose(rotation_matrices(1.7 * q), rotation_matrices(q), atol=1e-14)


def test_the_rotation_between_two_vectors_is_the_smallest_one() -> None:
    start, end = unit(50, 3, 3), unit(50, 3, 4)
    end[0], end[1] = start[0], -start[1]
    turns = rotation_between(start, end)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turns, start), end, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    angles = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    wanted = np.arccos(np.clip((start * end).sum(axis=1), -1.0, 1.0))
    np.testing.assert_allclose(angles, wanted, atol=1e-7)
