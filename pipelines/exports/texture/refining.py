"""A texture brought nearer to what all photos show of it, not only the one that it was copied from.

A photo is not quite where its pose says and the surface not quite where it was found; a glossy
place looks otherwise from elsewhere. So a patch that is exact in its own photo is off in the
others, by more than what they have in common is. Here a *step* is added to the texture, which
lessens

    sum over pixels p of the photos   w_p | photo_p - (A (texture + step))_p |^2

A asks a copy of the texture, as fine as the pixel, between its texels, as viewers do, and is
linear. The step has texels of twice the size: what is finer stays as the sharpest photo has it.
Pixels far from what the others agree on, as a passer-by's, count less (Huber, "Robust estimation of
a location parameter", 1964). Solved by a few rounds of SIRT (Gilbert 1972): each texel moves by the
mean of what the pixels that see it miss, which from a good beginning needs few.

Faces that no photo shows whole have no patch, but their vertices' colours; these get their step
from the pixels that show a part of such a face, in the same way.

Left out are pixels at jumps of depth and at holes, where a pose that is off shows something else,
masked ones, and what is seen from behind or at a glance.

Symbols: N pixels, H and W height and width of the texture, M texels of all the copies, one row
after another; V vertices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from pipelines.exports.each_view import each_view
from pipelines.exports.texture.charts import Charts, Layout
from pipelines.exports.texture.choice import NOBODY, Surface
from pipelines.exports.texture.photos import Photos
from pipelines.exports.texture.texels import moving, spread

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

_ROUNDS, _VERTEX_ROUNDS = 3, 12
_FAR_OFF = 0.06
"""A pixel that is farther off, root mean square of its channels, counts as if it were so far."""
_KEEP = 0.05
"""Pixels' worth of what was there before: a texel that hardly anything sees stays."""
_JUMP = 0.03
"""Neighbouring pixels whose distances differ by a larger share see two surfaces."""
_LEAST_COSINE = 0.05
"""Less than a photo must have to be copied: of what all see at a glance alone, a glance says more
than the field."""
_COPIES = 3
"""Copies of the texture, of a half, a quarter and an eighth of its side."""
_LEAST_SIDE = 1 << (_COPIES + 1)
_SIDE = 960
"""Of the photos as they are looked at, px at most."""
_PIXELS = 16_000_000
"""Looked at in all, at some 40 bytes each; of more an even choice."""
_GOLDEN = 0.618
"""Of the pixels left out between two, about so far the next row's lie aside."""
_CHUNK = 2_000_000
_SPREAD_PASSES = 2
_ROWS = 256
_LOOK_SHARE, _SOLVE_SHARE, _SPREAD_SHARE = 0.5, 0.9, 0.94


class _Looks(NamedTuple):
    """Some pixels of the photos. seen: [N, M or V], texels or vertices as each pixel mixes them.
    color: [N, 3]."""

    seen: csr_array
    color: Bytes


def refine(
    picture: Bytes,
    colors: NDArray[np.floating[Any]],
    surface: Surface,
    charts: Charts,
    layout: Layout,
    photos: Photos,
    on_progress: Callable[[float], None] = lambda done: None,
) -> Floats:
    """Move a texture [H, W, 3] towards what the photos show, in place; and vertices' colours
    [V, 3] in [0, 1] where faces have nothing else: returned.

    surface: whose faces are those of the charts, in order. on_progress: told the share that is
    done; may raise.
    """
    if min(layout.size) < _LEAST_SIDE:
        return colors.astype(np.float32)
    of_texels, of_vertices = _looks(
        surface, charts, layout, photos, lambda done: on_progress(_LOOK_SHARE * done)
    )
    if of_texels:
        _refine_picture(picture, of_texels, on_progress)
    return refined_colors(
        colors.astype(np.float32),
        of_vertices,
        lambda done: on_progress(_SPREAD_SHARE + (1.0 - _SPREAD_SHARE) * done),
    )


def _refine_picture(
    picture: Bytes, looks: list[_Looks], on_progress: Callable[[float], None]
) -> None:
    """Move the texture. looks: emptied, as they are large."""
    half, width = (side // 2 for side in picture.shape[:2])
    begun = np.empty((half, width, 3), np.float32)
    for top in range(0, half, _ROWS):
        rows = picture[2 * top : 2 * min(top + _ROWS, half)].astype(np.float32)
        begun[top : top + _ROWS] = _halved(rows) / np.float32(255.0)
    step, known = solved(
        begun,
        looks,
        lambda done: on_progress(_LOOK_SHARE + (_SOLVE_SHARE - _LOOK_SHARE) * done),
    )
    looks.clear()
    del begun
    told = moving(on_progress, _SOLVE_SHARE, _SPREAD_SHARE, 4 * _SPREAD_PASSES)
    spread(step, known, _SPREAD_PASSES, told)
    _add(picture, step)


def solved(
    begun: Floats,
    looks: Sequence[tuple[csr_array, Bytes]],
    on_progress: Callable[[float], None] = lambda done: None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """What to add to a texture [H, W, 3] in [0, 1], and where that is known, [H, W].

    looks: pixels in several parts, each a matrix [N, M] with rows that sum to 1, and colours
    [N, 3]; M texels of the texture and its copies, as `copies_of` has them.
    """
    shape = len(begun), begun.shape[1]
    texture = begun.copy()
    known = np.zeros(shape, np.bool_)
    for turn in range(_ROUNDS):
        texels = copies_of(texture)
        missed = np.zeros((len(texels), 4), np.float32)
        for done, (seen, color) in enumerate(looks):
            missed += _missed(seen, color, texels)
            on_progress((turn + (done + 1) / len(looks)) / _ROUNDS)
        mean = _gathered(missed, shape)
        held = mean[..., :3] + np.float32(_KEEP) * (begun - texture)
        texture += held / (mean[..., 3:] + np.float32(_KEEP))
        known |= mean[..., 3] > 0.0
    return texture - begun, known


def refined_colors(
    begun: Floats,
    looks: Sequence[tuple[csr_array, Bytes]],
    on_progress: Callable[[float], None] = lambda done: None,
) -> Floats:
    """Vertices' colours [V, 3] in [0, 1], moved towards what pixels show.

    looks: as those of `solved`, of vertices instead of texels: matrices [N, V].
    """
    colors = begun.copy()
    for turn in range(_VERTEX_ROUNDS if looks else 0):
        missed = np.zeros((len(colors), 4), np.float32)
        for done, (seen, color) in enumerate(looks):
            missed += _missed(seen, color, colors)
            on_progress((turn + (done + 1) / len(looks)) / _VERTEX_ROUNDS)
        held = missed[:, :3] + np.float32(_KEEP) * (begun - colors)
        colors += held / (missed[:, 3:] + np.float32(_KEEP))
    return colors


def _missed(seen: csr_array, color: Bytes, texels: Floats) -> Floats:
    """By how much pixels [N, 3] are missed, summed over those that see each texel, and how much
    they count in all, [M, 4]."""
    off = color.astype(np.float32) / np.float32(255.0) - seen @ texels
    size = np.sqrt(np.einsum("nc,nc->n", off, off) / np.float32(3.0))
    weight = np.float32(_FAR_OFF) / np.maximum(size, np.float32(_FAR_OFF))
    sums: Floats = seen.T @ np.column_stack([weight[:, None] * off, weight])
    return sums


def copies_of(texture: Floats) -> Floats:
    """Texels of a texture [H, W, 3] and of its smaller copies, [M, 3], as viewers make these."""
    levels = [texture]
    while len(levels) < _COPIES:
        levels.append(_halved(levels[-1]))
    return np.concatenate([level.reshape(-1, 3) for level in levels])


def mixing(
    places: NDArray[np.float64], level: NDArray[np.integer], shape: tuple[int, int]
) -> csr_array:
    """Pixels as mixtures of four texels each, [N, M].

    places: [N, 2], in texels of the finest of the copies, of shape (H, W). level: [N], from 0, the
    copy that each pixel asks.
    """
    sizes = np.array(shape[::-1]) >> level[:, None]
    at = np.clip(places / (1 << level)[:, None] - 0.5, 0.0, sizes - 1.0)
    first = np.minimum(at.astype(np.int64), sizes - 2)
    right, down = (at - first).T.astype(np.float32)
    begins, wide = _begins(shape), sizes[:, 0]
    corner = begins[level] + first[:, 1] * wide + first[:, 0]
    columns = np.stack([corner, corner + 1, corner + wide, corner + wide + 1], axis=1)
    left, up = np.float32(1.0) - right, np.float32(1.0) - down
    values = np.stack([left * up, right * up, left * down, right * down], axis=1)
    return csr_array(
        (
            values.reshape(-1),
            columns.astype(np.int32).reshape(-1),
            np.arange(0, 4 * len(places) + 1, 4, dtype=np.int32),
        ),
        shape=(len(places), int(begins[-1])),
    )


def _looks(
    surface: Surface,
    charts: Charts,
    layout: Layout,
    photos: Photos,
    on_progress: Callable[[float], None],
) -> tuple[list[_Looks], list[_Looks]]:
    """What the photos see of the texture, and of vertices of faces without a photo, some photos at
    a time."""
    density = _density(surface, charts, layout)
    painted = charts.photo[charts.face_chart] != NOBODY
    sizes = [photos.glance_size(index, _SIDE) for index in range(len(photos))]
    stride = max(1, -(-sum(width * height for width, height in sizes) // _PIXELS))
    half = layout.size[1] // 2, layout.size[0] // 2
    texels = _Waiting(lambda places, level: mixing(places, level, half))
    vertices = _Waiting(lambda which, weights: _of_corners(which, weights, len(surface.vertices)))

    def look(index: int) -> tuple[tuple[Any, Any, Bytes], tuple[Any, Any, Bytes]]:
        glance, share = photos.glance(index, _SIDE)
        width, height = glance.size
        kept, distance, face, weights = _met(surface, photos, index, (width, height))
        kept &= _even_choice(width, height, stride, index)
        if kept.any():
            rows, columns = np.divmod(np.flatnonzero(kept), width)
            pixels = (np.stack([columns, rows], axis=1) + 0.5) / share
            kept[kept] = photos.usable(index, pixels)
        colors = np.asarray(glance).reshape(-1, 3)
        alone = kept & ~painted[face]
        bare = surface.faces[face[alone]], weights[alone], colors[alone]
        kept &= painted[face]
        face, distance = face[kept], distance[kept]
        places = np.einsum("nc,ncd->nd", weights[kept], layout.uv[charts.faces[face]])
        angle = photos.pixel_angle(index) / share.mean()
        wanted = np.maximum(density[face] * distance * angle, 1.0)
        level = np.clip(np.rint(np.log2(wanted)).astype(np.int64), 1, _COPIES) - 1
        return (0.5 * places, level, colors[kept]), bare

    for index, (shown, bare) in enumerate(each_view(look, range(len(photos)))):
        texels.add(*shown)
        vertices.add(*bare)
        on_progress((index + 1) / len(photos))
    return texels.all(), vertices.all()


class _Waiting:
    """Pixels of photos until there are enough of them for one matrix."""

    def __init__(self, matrix: Callable[[Any, Any], csr_array]) -> None:
        self._matrix = matrix
        self._parts: list[tuple[NDArray[Any], NDArray[Any], Bytes]] = []
        self._looks: list[_Looks] = []

    def add(self, first: NDArray[Any], second: NDArray[Any], color: Bytes) -> None:
        """Some pixels: what the matrix is made of, and their colours."""
        if len(color):
            self._parts.append((first, second, color))
        if sum(len(part[2]) for part in self._parts) >= _CHUNK:
            self._join()

    def all(self) -> list[_Looks]:
        """All that came in."""
        if self._parts:
            self._join()
        return self._looks

    def _join(self) -> None:
        first, second, color = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        self._looks.append(_Looks(self._matrix(first, second), color))
        self._parts = []


def _of_corners(vertices: NDArray[np.int32], weights: Floats, num_vertices: int) -> csr_array:
    """Pixels as mixtures of three vertices each, [N, V]. vertices, weights: [N, 3]."""
    ends = np.arange(0, 3 * len(vertices) + 1, 3, dtype=np.int32)
    values = weights.astype(np.float32).reshape(-1)
    return csr_array((values, vertices.reshape(-1), ends), shape=(len(vertices), num_vertices))


def _even_choice(width: int, height: int, stride: int, first: int) -> NDArray[np.bool_]:
    """[H * W], one pixel of so many, along rows and columns alike: were they one below the other in
    every row, as each third of 960 is, a texture would be moved in stripes.
    """
    rows, columns = np.arange(height)[:, None], np.arange(width)
    aside = range(max(round(_GOLDEN * stride), 1), stride + 1)
    step = next(step for step in aside if math.gcd(step, stride) == 1)
    chosen: NDArray[np.bool_] = (columns + step * rows + first) % stride == 0
    return chosen.ravel()


def _met(
    surface: Surface, photos: Photos, index: int, size: tuple[int, int]
) -> tuple[NDArray[np.bool_], Floats, NDArray[np.int64], Floats]:
    """Of all pixels of a glance of some size: whether it counts [N], distance [N], face [N], where
    in the face [N, 3].
    """
    width, height = size
    eye, ways = photos.rays(index, _SIDE)
    distance, face, weights = surface.met(eye, ways)
    facing = -np.einsum("nd,nd->n", ways, surface.face_normals[face].astype(np.float32))
    kept = np.isfinite(distance) & (facing > _LEAST_COSINE)
    kept &= _even(distance.reshape(height, width)).reshape(-1)
    return kept, distance, face, weights


def _even(distance: Floats) -> NDArray[np.bool_]:
    """Where a pixel and its four neighbours see one surface, [H, W]."""
    near = np.nan_to_num(distance, posinf=0.0)
    even = near > 0.0
    for axis in (0, 1):
        one, two = (np.moveaxis(near, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        same = np.abs(one - two) <= _JUMP * np.minimum(one, two)
        across = np.moveaxis(even, axis, 0)
        across[:-1] &= same
        across[1:] &= same
    return even


def _density(surface: Surface, charts: Charts, layout: Layout) -> Floats:
    """Texels per unit of length on each face, [F]."""
    a, b = (layout.uv[charts.faces[:, k]] - layout.uv[charts.faces[:, 0]] for k in (1, 2))
    texels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    density: Floats = np.sqrt(texels / np.maximum(surface.twice_area, 1e-30)).astype(np.float32)
    return density


def _begins(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Where the texels of each copy begin among those of all, and where they end."""
    height, width = shape
    counts = [(height >> k) * (width >> k) for k in range(_COPIES)]
    return np.concatenate([[0], np.cumsum(counts)])


def _gathered(sums: Floats, shape: tuple[int, int]) -> Floats:
    """Sums at the texels of all copies [M, 4], brought to the finest ones' [H, W, 4].

    A texel of a copy is the mean of four, so each of these has a quarter of what it has.
    """
    height, width = shape
    begins = _begins(shape)
    parts = [
        sums[begins[k] : begins[k + 1]].reshape(height >> k, width >> k, 4) for k in range(_COPIES)
    ]
    total = parts[-1]
    for part in reversed(parts[:-1]):
        total = part + np.float32(0.25) * total.repeat(2, axis=0).repeat(2, axis=1)
    return total


def _halved(picture: Floats) -> Floats:
    """[H, W, 3] with 2 x 2 texels as one."""
    mean: Floats = picture[::2, ::2] + picture[1::2, ::2]
    mean += picture[::2, 1::2]
    mean += picture[1::2, 1::2]
    mean *= np.float32(0.25)
    return mean


def _add(picture: Bytes, step: Floats) -> None:
    """Add a step [H / 2, W / 2, 3], between its texels what lies between."""
    height, width = picture.shape[:2]
    for top in range(0, height, 2 * _ROWS):
        bottom = min(top + 2 * _ROWS, height)
        rows = np.arange(top, bottom)
        between = _between(_between(step, rows, 0), np.arange(width), 1)
        moved = picture[top:bottom] + np.float32(255.0) * between
        picture[top:bottom] = np.rint(np.clip(moved, 0.0, 255.0)).astype(np.uint8)


def _between(step: Floats, texels: NDArray[np.int64], axis: int) -> Floats:
    """A step along one axis at texels of half the size: a quarter of the one beside."""
    inner = texels // 2
    beside = np.clip(inner + np.where(texels % 2 == 0, -1, 1), 0, step.shape[axis] - 1)
    mixed = np.float32(0.75) * step.take(inner, axis) + np.float32(0.25) * step.take(beside, axis)
    between: Floats = mixed
    return between
