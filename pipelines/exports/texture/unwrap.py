"""A mesh unwrapped without photos: charts of faces that look one way, flat in one picture.

Each face is put to one of 18 directions, the same as its neighbours where that costs little; what
hangs together is a chart, projected along its direction, so that nothing is stretched by more than
the bend that one direction may have. Where a chart would lie over itself, the lower faces become
charts of their own. All charts keep a gutter around them that smaller copies of the picture do not
cross. Symbols: V vertices, F faces, U corners (a vertex, once for each chart it is in), C charts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.texture.charts import corners_of, pieces
from pipelines.exports.texture.choice import neighbours_of
from pipelines.exports.texture.packing import Outlines, outlines_of, packed

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

GUTTER_PX = 6
"""Around each chart. What lies between two is not mixed in copies of a half and a quarter of the
size, a texel of which, between its neighbours, reaches six texels beyond a face."""
_AXES = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], float)
_AXES = _AXES[np.isin(np.abs(_AXES).sum(axis=1), (1, 2))]
DIRECTIONS: Floats = _AXES / np.linalg.norm(_AXES, axis=1, keepdims=True)
_LEAST_COSINE = 0.35
"""Between a face's normal and the direction of its chart: at most three times narrower there."""
_LEAST_COSINE_IN_LARGER = 0.1
_SMOOTHINGS, _ROUNDS, _NEIGHBOURS_WEIGHT = 6, 12, 0.5
_FEW, _ABSORBING_ROUNDS = 24, 4
"""Charts of fewer faces go to what is around them, where that is not seen from its back."""
_LAYERS = 6
_OVER_TEXELS = 0.25
"""Faces nearer above each other have the same colours anyway."""
_INSIDE = np.array([[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8]], float)
_INSIDE /= _INSIDE.sum(axis=1, keepdims=True)
_ANGLES = np.radians(np.arange(0.0, 90.0, 11.25))

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


@dataclass(frozen=True)
class Atlas:
    """Where a mesh lies in a picture. size: width and height of it, px.

    faces: [F, 3], corners. vertex: [U], the mesh's vertex of each. uv: [U, 2], px in the picture
    from its top left corner. chart: [U]. face_chart: [F]. scale: texels of the picture for one that
    was wanted, at most 1.
    """

    size: tuple[int, int]
    faces: Ints
    vertex: Ints
    uv: Floats
    chart: Ints
    face_chart: Ints
    scale: float

    @property
    def num_charts(self) -> int:
        """C."""
        return int(self.chart.max(initial=-1)) + 1


@dataclass(frozen=True)
class Flat:
    """Charts that lie flat, each in its own corner of the plane.

    place: [U, 2], texels, from 0 in both directions. depth: [U], texels toward who looks at the
    chart. size: [C, 2].
    """

    faces: Ints
    vertex: Ints
    chart: Ints
    face_chart: Ints
    place: Floats
    depth: Floats
    size: Floats


def unwrap(
    vertices: Floats,
    faces: Ints,
    density: Floats,
    largest_side: int,
    poll: Callable[[], None] = lambda: None,
) -> Atlas:
    """Lay out a mesh in the smallest picture that holds it, or make it fit the largest.

    density: [F], texels wanted for a unit of length on each face. largest_side: px, a power of two.
    poll: called every second or so; may raise. Raises TextureFull where not even a hundredth of the
    density fits.
    """
    flat = laid_flat(vertices, faces, density, poll)

    def outlines_at(scale: float) -> Outlines:
        return outlines_of(flat.place * scale, flat.faces, flat.chart, GUTTER_PX)

    scale, packing = packed(outlines_at, largest_side, poll)
    uv = packing.moved(flat.place * scale, flat.chart)
    return Atlas(packing.size, flat.faces, flat.vertex, uv, flat.chart, flat.face_chart, scale)


def laid_flat(
    vertices: Floats, faces: Ints, density: Floats, poll: Callable[[], None] = lambda: None
) -> Flat:
    """Charts of faces that look one way, each by itself. density, poll: as of `unwrap`."""
    across = neighbours_of(faces)
    normals, area = _normals(vertices, faces)
    poll()
    direction = _facing(normals, area, across, poll)
    layer = np.zeros(len(faces), np.int32)
    alone = _LAYERS * len(DIRECTIONS) + np.arange(len(faces))
    for turn in range(len(faces)):
        split = np.where(layer < _LAYERS, layer * len(DIRECTIONS) + direction, alone)
        flat = _flattened(vertices, faces, across, split.astype(np.int32), direction, density)
        poll()
        hidden = _hidden(flat)
        poll()
        if not hidden.any():
            break
        # After some turns what is hidden has a chart to itself, in which nothing lies above it.
        layer[hidden] = min(turn + 1, _LAYERS)
    return flat


def _normals(vertices: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Unit normals [F, 3], zero of a face without area, and areas [F]."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    twice = np.linalg.norm(across, axis=1)
    return across / np.maximum(twice, 1e-300)[:, None], 0.5 * twice


def _facing(normals: Floats, area: Floats, across: Ints, poll: Callable[[], None]) -> Ints:
    """The direction of each face, [F]."""
    there = across >= 0
    smooth = normals * (area / max(float(area.mean()), 1e-300))[:, None]
    for _ in range(_SMOOTHINGS):
        smooth = smooth + np.where(there[..., None], smooth[across], 0.0).sum(axis=1)
        poll()
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)
    own = (normals @ DIRECTIONS.T).astype(np.float32)
    score = np.where(own >= _LEAST_COSINE, smooth @ DIRECTIONS.T, own - 4.0).astype(np.float32)
    label = score.argmax(axis=1)
    rows = np.arange(len(label))
    generator = np.random.default_rng(0)
    for _ in range(_ROUNDS):
        liked = score.copy()
        for side in range(3):
            mine = rows[there[:, side]]
            liked[mine, label[across[mine, side]]] += _NEIGHBOURS_WEIGHT
        turn = generator.random(len(label)) < 0.5
        label = np.where(turn, liked.argmax(axis=1), label)
        poll()
    for _ in range(_ABSORBING_ROUNDS):
        face_chart, _ = pieces(across, label)
        few = np.bincount(face_chart)[face_chart] < _FEW
        if not few.any():
            break
        votes = np.zeros((len(label), len(DIRECTIONS)), np.float32)
        for side in range(3):
            mine = rows[few & there[:, side]]
            other = across[mine, side]
            mine, other = mine[~few[other]], other[~few[other]]
            votes[mine, label[other]] += 1.0
        votes[own < _LEAST_COSINE_IN_LARGER] = 0.0
        taken = votes.max(axis=1) > 0.0
        label = np.where(taken, (votes + 0.5 * own).argmax(axis=1), label)
        poll()
    facing: Ints = label.astype(np.int32)
    return facing


def _bases() -> tuple[Floats, Floats]:
    """To the right and up [D, 3] for who looks against each direction."""
    helper = np.where(np.abs(DIRECTIONS[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    right = np.cross(helper, DIRECTIONS)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return right, np.cross(DIRECTIONS, right)


def _flattened(
    vertices: Floats, faces: Ints, across: Ints, split: Ints, direction: Ints, density: Floats
) -> Flat:
    """Connected faces of one split, projected along their direction, in their smallest boxes."""
    face_chart, _ = pieces(across, split)
    cut_faces, vertex, chart = corners_of(faces, face_chart)
    count = len(np.bincount(face_chart))
    way = np.zeros(count, np.int32)
    way[face_chart] = direction
    _, area = _normals(vertices, faces)
    area = area + 1e-12 * max(float(area.max()), 1e-300)
    wanted = np.bincount(face_chart, area * density) / np.bincount(face_chart, area)
    right, up = (basis[way[chart]] for basis in _bases())
    own = vertices[vertex] * wanted[chart][:, None]
    x, y = (own * right).sum(axis=1), (own * up).sum(axis=1)
    depth = (own * DIRECTIONS[way[chart]]).sum(axis=1)
    # Corners are in the order of their charts.
    starts = np.flatnonzero(np.diff(chart, prepend=-1))
    best = np.full(count, np.inf)
    place = np.stack([x, y], axis=1)
    size = np.zeros((count, 2))
    for angle in _ANGLES:
        turned = np.stack(
            [x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], axis=1
        )
        low = np.minimum.reduceat(turned, starts)
        extent = np.maximum.reduceat(turned, starts) - low
        better = extent.prod(axis=1) < best
        best = np.where(better, extent.prod(axis=1), best)
        size[better] = extent[better]
        mine = better[chart]
        place[mine] = (turned - low[chart])[mine]
    # Shelves waste least where what stands on them is low. A quarter turn keeps what is left left.
    tall = size[:, 1] > size[:, 0]
    mine = tall[chart]
    place[mine] = np.stack([place[mine, 1], size[chart[mine], 0] - place[mine, 0]], axis=1)
    size[tall] = size[tall][:, ::-1]
    return Flat(cut_faces, vertex, chart, face_chart, place, depth, size)


def _hidden(flat: Flat) -> NDArray[np.bool_]:
    """Faces [F] that must leave their charts so that none lies over another there.

    Of two that do, the one behind goes; so does a small one above a large one, which covers none
    of the places that the large one is looked at in.
    """
    target = _apart(np.ceil(flat.size) + 2.0)
    lowest = np.minimum.reduceat(flat.depth, np.flatnonzero(np.diff(flat.chart, prepend=-1)))
    height = flat.depth - lowest[flat.chart]
    corners = np.concatenate([flat.place + target[flat.chart] + 1.0, height[:, None]], axis=1)
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor(corners.astype(np.float32)),
        _core.Tensor(np.ascontiguousarray(flat.faces, np.uint32)),
    )
    spots = np.einsum("kc,fcd->fkd", _INSIDE, corners[flat.faces])
    far = float(height.max()) + 10.0
    above, _ = _first(scene, spots, far, -1.0)
    hidden: NDArray[np.bool_] = (above - spots[..., 2] > _OVER_TEXELS).any(axis=1)
    below, what = _first(scene, spots, -10.0, 1.0)
    under = (spots[..., 2] - below > _OVER_TEXELS) & ~hidden[what]
    hidden |= under.any(axis=1)
    return hidden


def _apart(boxes: Floats) -> Floats:
    """Left and top [C, 2] of boxes [C, 2] that are to lie beside each other, on shelves."""
    side = max(np.sqrt(boxes.prod(axis=1).sum()), boxes[:, 0].max())
    order = np.argsort(-boxes[:, 1], kind="stable")
    ends = np.cumsum(boxes[order, 0])
    shelf = (ends // side).astype(np.int64)
    begins = np.flatnonzero(np.diff(shelf, prepend=-1))
    heights = np.zeros(len(order))
    heights[begins[1:]] = np.maximum.reduceat(boxes[order, 1], begins)[:-1]
    first = np.zeros(len(order))
    first[begins] = np.diff(ends[begins] - boxes[order[begins], 0], prepend=0.0)
    target = np.zeros_like(boxes)
    target[order, 0] = ends - boxes[order, 0] - np.cumsum(first)
    target[order, 1] = np.cumsum(heights)
    return target


def _first(scene: Any, spots: Floats, start: float, way: float) -> tuple[Floats, NDArray[np.int64]]:
    """The height of the first face on the way through spots [F, K, 3], and which it is."""
    rays = np.zeros((*spots.shape[:2], 6), np.float32)
    rays[..., :2], rays[..., 2], rays[..., 5] = spots[..., :2], start, way
    found = scene.cast_rays(_core.Tensor(rays))
    distance, face = found["t_hit"].numpy(), found["primitive_ids"].numpy().astype(np.int64)
    missed = ~np.isfinite(distance)
    height = np.where(missed, spots[..., 2], start + way * np.where(missed, 0.0, distance))
    return height, np.where(missed, np.arange(len(spots))[:, None], face)
