"""Patches found again in pictures that are known functions of position: plain twin and kernel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pipelines.sfm.alignment import Alignments, Arena, Floats, align
from pipelines.sfm.alignment_kernel import align_fast

SIDE = 96
FROM = np.array([48.3, 47.6])
Align = Callable[[Arena, Alignments], tuple[Floats, Floats]]
BOTH: list[Align] = [align, lambda arena, wanted: align_fast(arena, wanted, 2)]
both = pytest.mark.parametrize("find", BOTH, ids=["plain", "kernel"])


def pattern(xy: Floats, seed: int = 0) -> Floats:
    """Grey values in about [60, 200] at places [..., 2]: waves of 7 to 25 pixels."""
    random = np.random.default_rng(seed)
    angles = random.uniform(0.0, np.pi, 12)
    waves = np.stack([np.cos(angles), np.sin(angles)], -1) * (
        2.0 * np.pi / random.uniform(7.0, 25.0, (12, 1))
    )
    values: Floats = np.cos(xy @ waves.T + random.uniform(0.0, 6.0, 12)).sum(-1)
    return 128.0 + 18.0 * values


def picture(pull: Callable[[Floats], Floats], seed: int = 0, gain: float = 1.0) -> np.ndarray:
    """[SIDE, SIDE] uint8: each pixel shows the pattern at pull(its place)."""
    u, v = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    values = gain * pattern(pull(np.stack([u, v], -1)), seed)
    return np.clip(values.round(), 0, 255).astype(np.uint8)


def arena_of(*pictures: np.ndarray) -> Arena:
    grey = np.zeros((len(pictures), max(one.size for one in pictures)), np.uint8)
    for slot, one in enumerate(pictures):
        grey[slot, : one.size] = one.ravel()
    return Arena(grey, np.array([one.shape for one in pictures], np.int64))


def wanted_at(places: Floats, warps: Floats | None = None, start: Floats = FROM) -> Alignments:
    """The patch at `start` of slot 0, looked for near each of places [N, 2] in slot 1."""
    num = len(places)
    return Alignments(
        slots=np.tile(np.array([[0, 1]], np.int64), (num, 1)),
        references=np.zeros(num, np.int64),
        from_xy=np.tile(start, (num, 1)),
        to_xy=places,
        warps=np.tile(np.eye(2), (num, 1, 1)) if warps is None else warps,
    )


@both
def test_a_patch_is_found_through_shift_affine_map_and_exposure(find: Align) -> None:
    warp = np.array([[1.12, 0.10], [-0.06, 0.93]])
    to = FROM + np.array([2.37, -1.81])
    inverse = np.linalg.inv(warp)
    arena = arena_of(
        picture(lambda xy: xy),
        picture(lambda xy: (xy - to) @ inverse.T + FROM, gain=0.7)[8:, :80],
    )
    truth = to - (0.0, 8.0)
    starts = truth + np.array([[0.0, 0.0], [0.9, -0.6], [-1.1, 0.4], [0.3, 1.2]])
    found, alike = find(arena, wanted_at(starts))
    np.testing.assert_allclose(found, np.tile(truth, (4, 1)), atol=0.03)
    assert (alike > 0.99).all()
    exact, _ = find(arena, wanted_at(starts, np.tile(warp, (4, 1, 1))))
    np.testing.assert_allclose(exact, np.tile(truth, (4, 1)), atol=0.03)


@both
def test_what_shows_something_else_is_not_alike(find: Align) -> None:
    arena = arena_of(picture(lambda xy: xy), picture(lambda xy: xy, seed=5))
    _, alike = find(arena, wanted_at(FROM + np.random.default_rng(0).normal(0, 6, (30, 2))))
    assert np.median(alike) < 0.7
    _, same = find(arena_of(picture(lambda xy: xy), picture(lambda xy: xy)), wanted_at(FROM[None]))
    assert same[0] > 0.99


@both
def test_flat_patches_and_such_that_leave_the_picture_are_not_found(find: Align) -> None:
    textured, flat = picture(lambda xy: xy), np.full((SIDE, SIDE), 90, np.uint8)
    edge = np.array([3.0, 40.0])
    for arena, wanted in (
        (arena_of(textured, flat), wanted_at(FROM[None])),
        (arena_of(flat, textured), wanted_at(FROM[None])),
        (arena_of(textured, textured), wanted_at(edge[None], start=edge)),
        (arena_of(textured, textured), wanted_at(edge[None])),
    ):
        found, alike = find(arena, wanted)
        assert alike[0] == -1.0
        np.testing.assert_array_equal(found, wanted.to_xy)


def test_the_kernel_gives_what_the_plain_twin_gives() -> None:
    random = np.random.default_rng(1)
    num = 300
    turn = np.array([[0.98, -0.12], [0.12, 0.98]])
    arena = arena_of(
        picture(lambda xy: xy),
        picture(lambda xy: (xy - 48.0) @ turn.T + 47.0, gain=1.2),
        picture(lambda xy: xy + 0.4)[:70],
    )
    start = random.uniform(0.0, SIDE, (num // 3, 2)).repeat(3, axis=0)
    wanted = Alignments(
        slots=np.column_stack([np.zeros(num, np.int64), random.integers(1, 3, num)]),
        references=np.arange(num // 3).repeat(3),
        from_xy=start,
        to_xy=start + random.normal(0.0, 1.0, (num, 2)),
        warps=np.eye(2) + random.normal(0.0, 0.05, (num, 2, 2)),
    )
    plain, kernel = align(arena, wanted), align_fast(arena, wanted, 2)
    assert 50 < (plain[1] > 0.9).sum() < 250
    np.testing.assert_allclose(kernel[0], plain[0], atol=1e-5)
    np.testing.assert_allclose(kernel[1], plain[1], atol=1e-6)
