"""A mesh laid out flat: all of it, none of it twice, and nothing too near to anything else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from pipelines.errors import Cancelled
from pipelines.exports.texture.packing import TextureFull
from pipelines.exports.texture.texels import texels_of
from pipelines.exports.texture.unwrap import GUTTER_PX, Atlas, unwrap
from tests.unit.pipelines.exports.texture import painted_ball

TEXELS = 60.0


def ball(resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
    mesh = painted_ball.ball(resolution)
    return mesh.vertices - painted_ball.CENTER, mesh.faces


def helix(turns: int = 3, steps: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A ramp that winds up: it faces up everywhere, hangs together, and lies over itself."""
    turn = np.linspace(0.0, 2.0 * np.pi * turns, turns * steps + 1)
    inner = np.stack([np.cos(turn), np.sin(turn), 0.05 * turn], axis=1)
    outer = inner * [2.0, 2.0, 1.0]
    vertices = np.stack([inner, outer], axis=1).reshape(-1, 3)
    first = 2 * np.arange(len(turn) - 1)
    faces = np.concatenate(
        [
            np.stack([first, first + 1, first + 3], axis=1),
            np.stack([first, first + 3, first + 2], axis=1),
        ]
    )
    return vertices, faces.astype(np.int32)


def plate_and_chip(height: float) -> tuple[np.ndarray, np.ndarray]:
    """A large triangle, a tiny one above or below its inside, and what joins them."""
    vertices = np.array(
        [[0, 0, 0], [10, 0, 0], [0, 10, 0], [2.0, 1.0, 0], [2.4, 1, 0], [2, 1.4, 0]]
    )
    vertices[3:, 2] = height
    return vertices, np.array([[0, 1, 2], [0, 1, 3], [3, 4, 5], [3, 1, 4]], np.int32)


def of_density(vertices: np.ndarray, faces: np.ndarray, side: int = 2048) -> Atlas:
    return unwrap(vertices, faces, np.full(len(faces), TEXELS), side)


def flat_area(atlas: Atlas) -> np.ndarray:
    """Texels that each face takes up, [F]; negative where it is turned over."""
    a, b, c = (atlas.uv[atlas.faces[:, corner]] for corner in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def chart_picture(atlas: Atlas) -> np.ndarray:
    """The chart of each texel, -1 where none is."""
    picture = np.full(atlas.size[::-1], -1)
    for texels in texels_of(atlas.uv, atlas.faces, atlas.size):
        picture[texels.rows][texels.covered] = atlas.face_chart[texels.face]
    return picture


@pytest.mark.parametrize("shape", [ball, helix])
def test_nothing_lies_over_anything_else(
    shape: Callable[[], tuple[np.ndarray, np.ndarray]],
) -> None:
    """What lies over something covers fewer texels than both have."""
    atlas = of_density(*shape())
    assert atlas.scale == 1.0
    covered = (chart_picture(atlas) >= 0).sum()
    assert covered == pytest.approx(np.abs(flat_area(atlas)).sum(), rel=0.01)
    turned = flat_area(atlas)
    assert (turned > 0).all() or (turned < 0).all(), "none is seen from its back"


@pytest.mark.parametrize("height", [0.7, -0.7])
def test_a_chip_over_or_under_the_middle_of_a_plate_is_apart_from_it(height: float) -> None:
    """None of the places that the plate is looked at in is covered by it."""
    atlas = of_density(*plate_and_chip(height))
    assert atlas.face_chart[2] != atlas.face_chart[0]
    shown = (chart_picture(atlas) == atlas.face_chart[0]).sum()
    assert shown == pytest.approx(0.5 * (10.0 * TEXELS) ** 2 * atlas.scale**2, rel=0.02)


def test_faces_keep_their_corners_and_most_of_their_size() -> None:
    vertices, faces = ball()
    atlas = of_density(vertices, faces)
    assert np.array_equal(atlas.vertex[atlas.faces], faces)
    assert (atlas.chart[atlas.faces] == atlas.face_chart[:, None]).all()
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wanted = 0.5 * np.linalg.norm(across, axis=1) * TEXELS**2
    share = np.abs(flat_area(atlas)) / wanted
    assert share.max() < 1.0 + 1e-6
    assert share.min() > 0.3
    assert np.median(share) > 0.85


def test_a_round_thing_has_few_charts() -> None:
    vertices, faces = ball(60)
    assert len(faces) > 10_000
    assert of_density(vertices, faces).num_charts <= 40


def test_noise_tears_no_plane_to_pieces() -> None:
    i, j = np.meshgrid(np.arange(60), np.arange(60), indexing="ij")
    height = 0.3 * np.random.default_rng(0).normal(size=i.shape)
    vertices = np.stack([i, j, height], axis=-1).reshape(-1, 3).astype(float)
    first = (60 * i + j)[:-1, :-1].reshape(-1)
    faces = np.concatenate(
        [
            np.stack([first, first + 60, first + 1], axis=1),
            np.stack([first + 1, first + 60, first + 61], axis=1),
        ]
    ).astype(np.int32)
    atlas = unwrap(vertices, faces, np.full(len(faces), 8.0), 2048)
    assert np.bincount(atlas.face_chart).max() > 0.9 * len(faces)


def test_charts_stay_apart_and_off_the_rim() -> None:
    atlas = of_density(*ball())
    assert atlas.num_charts > 5
    assert atlas.uv.min() >= GUTTER_PX
    assert (atlas.uv <= np.array(atlas.size) - GUTTER_PX).all()
    picture = chart_picture(atlas)
    window = 2 * GUTTER_PX - 1
    highest = maximum_filter(picture, window)
    lowest = minimum_filter(np.where(picture < 0, atlas.num_charts, picture), window)
    there = highest >= 0
    assert (highest[there] == lowest[there]).all()


def test_a_picture_too_small_has_all_faces_smaller_and_says_so() -> None:
    vertices, faces = ball()
    large, small = of_density(vertices, faces), of_density(vertices, faces, 256)
    assert small.size == (256, 256)
    assert max(large.size) > 256
    assert small.scale < 1.0
    ratio = np.abs(flat_area(small)).sum() / np.abs(flat_area(large)).sum()
    assert ratio == pytest.approx(small.scale**2, rel=0.01)
    assert small.uv.max() <= 256 - GUTTER_PX


def test_more_pieces_than_the_picture_has_room_for_are_refused() -> None:
    corners = np.random.default_rng(0).normal(size=(1500, 3, 3)) + np.arange(1500)[:, None, None]
    faces = np.arange(4500).reshape(-1, 3).astype(np.int32)
    with pytest.raises(TextureFull, match="1500 charts"):
        unwrap(corners.reshape(-1, 3), faces, np.full(1500, TEXELS), 256)


def test_faces_without_area_do_no_harm() -> None:
    vertices, faces = ball()
    faces = np.concatenate([faces, [[0, 0, 1], [2, 3, 2]], faces[:1, [0, 1, 1]]]).astype(np.int32)
    atlas = of_density(vertices, faces)
    assert np.isfinite(atlas.uv).all()
    assert np.array_equal(atlas.vertex[atlas.faces], faces)


def test_it_is_the_same_each_time_and_can_be_stopped() -> None:
    vertices, faces = ball()
    one, two = of_density(vertices, faces), of_density(vertices, faces)
    assert np.array_equal(one.uv, two.uv)

    def stop() -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        unwrap(vertices, faces, np.full(len(faces), TEXELS), 2048, stop)
