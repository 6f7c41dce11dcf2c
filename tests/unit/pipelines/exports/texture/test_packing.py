"""Charts in a picture: close together, and no larger a picture than they need."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.texture.packing import Outlines, outlines_of, pack, packed

MARGIN = 3


def triangles(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [U, 2] of charts of a triangle each, most of them small, faces and charts."""
    random = np.random.default_rng(seed)
    size = np.exp(random.uniform(np.log(2.0), np.log(60.0), count))
    corners = random.random((count, 3, 2)) * size[:, None, None]
    faces = np.arange(3 * count).reshape(-1, 3).astype(np.int32)
    return corners.reshape(-1, 2), faces, np.repeat(np.arange(count), 3)


def shape_of(outlines: Outlines, chart: int) -> np.ndarray:
    """[h, w], what a chart takes up, by its columns."""
    low, high = outlines.columns.of(chart)
    rows = np.arange(outlines.size[chart, 1])[:, None]
    taken: np.ndarray = (rows >= low) & (rows < high)
    return taken


def test_an_outline_holds_all_that_is_within_the_margin_and_little_else() -> None:
    """Against every texel asked for its distance to points all over the triangle."""
    place, faces, chart = triangles(20)
    outlines = outlines_of(place, faces, chart, MARGIN)
    weights = np.random.default_rng(1).dirichlet(np.ones(3), 4000)
    for index in range(20):
        points = weights @ place[faces[index]] - outlines.origin[index]
        columns, rows = np.floor(points).astype(int).T
        wanted = np.zeros(outlines.size[index, ::-1], bool)
        for dx in range(-MARGIN, MARGIN + 1):
            for dy in range(-MARGIN, MARGIN + 1):
                wanted[rows + dy, columns + dx] = True
        shape = shape_of(outlines, index)
        assert not (wanted & ~shape).any()
        assert shape.sum() < 1.1 * wanted.sum() + 2 * sum(shape.shape)


def test_charts_lie_apart_and_their_patches_with_them() -> None:
    place, faces, chart = triangles(300)
    outlines = outlines_of(place, faces, chart, MARGIN)
    packing = pack(outlines, 1024, 1024)
    assert packing is not None
    assert packing.turned.any()
    assert not packing.turned.all()
    picture = np.zeros((1024, 1024, 3), np.uint8)
    used = np.zeros((1024, 1024), int)
    moved = packing.moved(place, chart)
    for index in range(300):
        used[packing.texels(index)] += 1
        # A patch that says of each of its texels where it is.
        y, x = np.indices((64, 64))
        patch = np.stack([x, y, np.full_like(x, 100)], axis=2).astype(np.uint8)
        packing.lay(index, patch, picture)
    assert used.max() == 1
    assert (moved > MARGIN).all()
    inside = np.einsum("kc,fcd->fkd", np.full((1, 3), 1 / 3), place[faces])[:, 0]
    columns, rows = np.floor(packing.moved(inside, np.arange(300))).astype(int).T
    assert np.abs(picture[rows, columns, :2] + 0.5 - inside).max() <= 0.5 + 1e-9
    # A copy of half the size mixes no two of them.
    owner = np.zeros((1024, 1024), int)
    for index in range(300):
        owner[packing.texels(index)] = index + 1
    blocks = owner.reshape(512, 2, 512, 2).transpose(0, 2, 1, 3).reshape(512, 512, 4)
    least = np.where(blocks > 0, blocks, 1000).min(axis=2)
    assert (least[blocks.any(axis=2)] == blocks.max(axis=2)[blocks.any(axis=2)]).all()


@pytest.mark.parametrize("count", [10, 200, 2000])
def test_a_picture_is_no_larger_than_needed_and_well_filled(count: int) -> None:
    place, faces, chart = triangles(count)
    scale, packing = packed(lambda s: outlines_of(s * place, faces, chart, MARGIN), 4096)
    assert scale == 1.0
    width, height = packing.size
    assert width in (height, 2 * height)
    assert packing.outlines.area > 0.37 * width * height, "half of it would not have held them"


def test_one_long_chart_has_a_long_picture() -> None:
    place = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 20.0]])
    faces = np.array([[0, 1, 2]], np.int32)
    outlines = outlines_of(place, faces, np.zeros(3, int), MARGIN)
    _, packing = packed(lambda scale: outlines, 4096)
    assert packing.size == (1024, 64)


def test_what_is_too_much_is_made_smaller_until_it_fits() -> None:
    place, faces, chart = triangles(400)
    scale, packing = packed(lambda s: outlines_of(s * place, faces, chart, MARGIN), 256)
    assert packing.size == (256, 256)
    assert 0.1 < scale < 0.9
    assert packing.outlines.area > 0.6 * 256 * 256
