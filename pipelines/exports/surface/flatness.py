"""The plain parts of a mesh made plane: floors, walls and table tops without fusion's bumps.

A fused surface trembles by a fraction of a voxel. On a wall that is all one sees of it, and normals
that tremble hide from the photos where it is (`pipelines.exports.surface.refinement`). So planes
are sought among the vertices, by RANSAC with normals; where a region of the mesh lies within two
edges of one, each vertex keeps of its distance d to the plane what the photos answer for and its
neighbours share:

    min_d  sum_i t_i (d_i - a_i)^2 + e d_i^2 + s sum_edges (d_i - d_j)^2

with a the photos' answer and t its trust, the more the finer their pixels are: a plain wall (t = 0)
becomes plane, a textured one smooth but as bent as its pictures say, and what stands out by more
than half an edge in the pictures, or is the rim of a plane, stays as it is. Sources: Schnabel,
Wahl, Klein, "Efficient RANSAC for Point-Cloud Shape Detection", CGF 2007; Torr, Zisserman,
"MLESAC", CVIU 2000 (a hypothesis is worth more the nearer its points are).

Symbols: V vertices, F faces, P planes (n, d) with n . X = d, n of length 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from pipelines.exports.mesh import unit_normals
from pipelines.exports.surface.rings import MeshRings

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

NOWHERE = -1
_NEAR = 2.0
"""Edges that a vertex of a plane may be away from it: fusion's noise is a third of an edge."""
_ALIGNED, _MEMBER_ALIGNED = 0.9, 0.85
"""|cosine| between the normals of a vertex and of a plane that is looked for, and of its own."""
_SAMPLES, _HYPOTHESES, _MOST_PLANES, _LEAST_SHARE = 30_000, 300, 24, 0.01
_LEAST_SAMPLES = 50
_FITS, _FIT_ROUNDS, _FIT_SCALE = 3, 10, 0.5
_FLAT, _LARGE, _LARGE_FLAT = 0.36, 0.035, 0.6
"""Median distance, in edges, of what lies on a plane; and of what lies on one that has so much of
the surface. Of anything that only passes through the two edges on both sides it is one. The side of
a fur coat has 0.47 to 0.72 and 2 %, bumpy floors and tables have 0.17 to 0.56 and 4 to 40 %."""
_NEARLY_DEG, _OBJECTION = 5.0, 1.5
"""Planes so nearly parallel or perpendicular to a larger one are, unless their points come to lie
so much farther away."""
_LEAST_AREA = 0.003
"""Of the mesh's area, for a connected region to be a plane's."""
_BENT, _BENT_SHARE = 0.35, 0.5
"""Of a region's distances, in edges: what a quadric explains. So much is part of a curved thing."""
_TURNED_DEG, _TURNED_SHARE = 3.5, 0.15
"""And so is what turns so far within the region, root mean square, where the quadric explains so
much: a plane would meet what is around it at an angle. Of boxes, floors and walls the largest has
2.8 degrees; the dark cheeks and the back of a bronze head, all bumps, have 3.8 to 8.7, and the
quadric explains 0.2 to 0.47."""
_NORMAL_ROUNDS, _CORNER_ROUNDS, _RELIEF_ROUNDS = 8, 2, 6
_CORNER = 1.0
_INSIDE, _INSIDE_ROUNDS = 0.9, 20
"""Of what lies around a vertex, how much must be of its plane: its rim stays as it is."""
_RELIEF, _RELIEF_TRUST = 0.5, 0.25
"""Edges that a vertex and all around it stand out by, and the trust in that, to stay as it is."""
_SURE, _SLACK = 0.3, 1.5
"""Trust in the photos' answer, and half pixels that such a vertex may leave it by."""
_MOST_ALONE = 2.0
"""A vertex on a plane goes so many times as far as its neighbours do."""
_SMOOTH, _TO_PLANE = 10.0, 0.005
_PIXEL, _FINEST = 0.3, 5.0
"""Half a pixel of the photos, in edges, of which an answer has its trust as weight; where photos
are finer it has more, up to so many times, squared."""
_HOLD, _MOVE = 3.0, 30.0
_ITERATIONS, _TOLERANCE = 200, 1e-4


@dataclass(frozen=True)
class FlatParts:
    """planes: [P, 4]. plane_of: [V], the plane that each vertex lies on, or `NOWHERE`."""

    planes: Floats
    plane_of: Ints


@dataclass(frozen=True)
class Answers:
    """What the photos say of V vertices.

    offset: [V], how far along its normal they want each. trust: [V] in [0, 1], in that.
    half_pixel: [V], along the normal, what moves a vertex by half a pixel in them.
    """

    offset: Floats
    trust: Floats
    half_pixel: Floats


def find_flat_parts(
    vertices: Floats, rings: MeshRings, poll: Callable[[], None] = lambda: None
) -> FlatParts:
    """The planes of a mesh [V, 3] that is centred near the origin, and what lies on them.

    poll: called now and then; may raise.
    """
    normals = unit_normals(rings.spread(rings.normals(vertices), _NORMAL_ROUNDS))
    lengths = rings.scale(vertices)
    planes = _planes(vertices, normals, lengths, rings.areas(vertices), poll)
    nowhere = np.full(len(vertices), NOWHERE, np.intp)
    if len(planes) == 0:
        return FlatParts(planes, nowhere)
    plane_of = _members(vertices, normals, lengths, planes, rings, poll)
    plane_of = _without_small_and_bent(vertices, lengths, planes, plane_of, rings)
    return FlatParts(planes, plane_of)


def flattened(
    vertices: Floats, parts: FlatParts, rings: MeshRings, answers: Answers | None = None
) -> Floats:
    """The vertices [V, 3] with their flat parts flat; those around them go along.

    Without answers what stands out all around by half an edge stays as it is; with them what the
    photos say stands out, and no vertex that they are sure of leaves their answer by more than
    three quarters of a pixel.
    """
    plane_of = parts.plane_of
    on = plane_of != NOWHERE
    if not on.any():
        return vertices
    normals = parts.planes[np.maximum(plane_of, 0), :3]
    away = (vertices * normals).sum(axis=1) - parts.planes[np.maximum(plane_of, 0), 3]
    lengths = rings.scale(vertices)
    if answers is None:
        on = on & ~_in_relief(away, on.astype(np.float64), on, lengths, rings)
        kept = np.zeros(len(vertices))
    else:
        wanted = away + answers.offset * (rings.normals(vertices) * normals).sum(axis=1)
        trust = np.where(on, answers.trust, 0.0)
        on = on & ~_in_relief(wanted, trust, on, lengths, rings)
        exact = _PIXEL * lengths / np.maximum(answers.half_pixel, 1e-12)
        weights = np.where(on, trust * np.clip(exact, 1.0, _FINEST) ** 2, 0.0)
        kept = _shared(wanted, weights, np.where(on, plane_of, NOWHERE), rings)
        slack = np.where(trust > _SURE, _SLACK * answers.half_pixel, np.inf)
        sure = np.clip(kept, wanted - slack, wanted + slack) - kept
        kept = kept + _not_alone(np.where(on, sure, 0.0), rings)
    moves = np.where(on[:, None], (kept - away)[:, None] * normals, 0.0)
    weights = np.where(on, _MOVE, _HOLD)
    matrix = (diags_array(weights) + rings.laplacian).tocsr()
    spread = [_solved(matrix, weights * moves[:, axis]) for axis in range(3)]
    # What is flat is exact; only its surroundings are led over softly.
    flat: Floats = vertices + np.where(on[:, None], moves, np.stack(spread, axis=-1))
    return flat


def _planes(
    vertices: Floats,
    normals: Floats,
    lengths: Floats,
    areas: Floats,
    poll: Callable[[], None],
) -> Floats:
    """[P, 4]: planes that at least 1 % of the surface lies on, largest first."""
    rng = np.random.default_rng(0)
    # A few huge faces must not be all that is looked at.
    share = np.minimum(areas, np.quantile(areas, 0.99)) + 1e-30
    count = min(len(vertices), _SAMPLES)
    which = rng.choice(len(vertices), count, replace=False, p=share / share.sum())
    points, facing, scale = vertices[which], normals[which], np.maximum(lengths[which], 1e-12)
    least = max(_LEAST_SHARE * count, _LEAST_SAMPLES)
    found: list[Floats] = []
    for _ in range(_MOST_PLANES):
        poll()
        if len(points) < least:
            break
        plane = _best_plane(points, facing, scale, rng)
        on = _near(plane, points, facing, scale)
        if on.sum() < least:
            break
        plane = _regular(plane, found, points[on], scale[on])
        limit = _LARGE_FLAT if on.sum() >= _LARGE * count else _FLAT
        if _unevenness(plane, points[on], scale[on]) < limit:
            found.append(plane)
        rest = ~_near(plane, points, facing, scale, slack=2.0)
        points, facing, scale = points[rest], facing[rest], scale[rest]
    return np.array(found).reshape(-1, 4)


def _best_plane(points: Floats, normals: Floats, scale: Floats, rng: np.random.Generator) -> Floats:
    """The plane [4] that most points lie near, fitted to them."""
    tried = rng.choice(len(points), min(_HYPOTHESES, len(points)), replace=False)
    offsets = (normals[tried] * points[tried]).sum(axis=1)
    candidates = np.column_stack([normals[tried], offsets])
    worth = []
    for plane in candidates:
        far = distances(plane, points) / (_NEAR * scale)
        worth.append(np.maximum(1.0 - far**2, 0.0)[_aligned(plane, normals, _ALIGNED)].sum())
    best: Floats = candidates[int(np.argmax(worth))]
    for _ in range(_FITS):
        on = _near(best, points, normals, scale)
        if on.sum() < _LEAST_SAMPLES:
            break
        best = _fitted(best, points[on], scale[on])
    return best


def _fitted(plane: Floats, points: Floats, scale: Floats) -> Floats:
    """The plane [4] of points [K, 3] with so much noise each, those far from it counting less."""
    for _ in range(_FIT_ROUNDS):
        far = distances(plane, points) / (_FIT_SCALE * scale)
        weights = 1.0 / (scale**2 * (1.0 + far**2))
        middle = weights @ points / weights.sum()
        apart = points - middle
        _, axes = np.linalg.eigh(apart.T @ (weights[:, None] * apart))
        normal = axes[:, 0] * np.copysign(1.0, axes[:, 0] @ plane[:3])
        plane = np.append(normal, normal @ middle)
    return plane


def _regular(plane: Floats, others: list[Floats], points: Floats, scale: Floats) -> Floats:
    """The plane [4], made parallel or perpendicular to larger ones where it nearly is and its
    points [K, 3] do not object.

    A small plain table top says little of its slope; the floor below it says more.
    """
    normal = plane[:3]
    for other in others:
        cosine = float(normal @ other[:3])
        if abs(cosine) > np.cos(np.radians(_NEARLY_DEG)):
            normal = other[:3] * np.copysign(1.0, cosine)
            break
        if abs(cosine) < np.sin(np.radians(_NEARLY_DEG)):
            normal = unit_normals((normal - cosine * other[:3])[None])[0]
    made = np.append(normal, np.median(points @ normal))
    for _ in range(_FIT_ROUNDS):
        weights = 1.0 / (scale**2 * (1.0 + (distances(made, points) / (_FIT_SCALE * scale)) ** 2))
        made[3] = weights @ (points @ normal) / weights.sum()
    before, after = (_unevenness(given, points, scale) for given in (plane, made))
    return made if after < _OBJECTION * before else plane


def _unevenness(plane: Floats, points: Floats, scale: Floats) -> float:
    """The median distance of points [K, 3] from a plane, in edges."""
    return float(np.median(np.abs(distances(plane, points)) / scale))


def _members(
    vertices: Floats,
    normals: Floats,
    lengths: Floats,
    planes: Floats,
    rings: MeshRings,
    poll: Callable[[], None],
) -> Ints:
    """[V]: the nearest plane of those that each vertex lies on, without its rim.

    The edge of a box lies near both of its sides: laid on either, it would be torn.
    """
    far = np.stack([np.abs(distances(plane, vertices)) for plane in planes], axis=-1)
    far /= np.maximum(lengths, 1e-12)[:, None]
    aligned = np.stack([_aligned(plane, normals, _MEMBER_ALIGNED) for plane in planes], axis=-1)
    on = (far < _NEAR) & aligned
    nearest = np.where(on, far, np.inf).argmin(axis=-1)
    plane_of = np.where(on.any(axis=-1), nearest, NOWHERE)
    for _ in range(_CORNER_ROUNDS):
        for index in range(len(planes)):
            beside = rings.around @ (plane_of == index).astype(np.float64) > 0.0
            plane_of[(plane_of == NOWHERE) & beside & (far[:, index] < _CORNER)] = index
    for index in range(len(planes)):
        poll()
        on_it = plane_of == index
        share = rings.spread(on_it.astype(np.float64)[:, None], _INSIDE_ROUNDS)[:, 0]
        plane_of[on_it & (share < _INSIDE)] = NOWHERE
    return plane_of.astype(np.intp)


def _without_small_and_bent(
    vertices: Floats, lengths: Floats, planes: Floats, plane_of: Ints, rings: MeshRings
) -> Ints:
    """`plane_of` without regions that are small, or a part of something curved."""
    edges = edges_within(plane_of, rings)
    _, region_of = connected_components(edges, directed=False)
    areas = rings.areas(vertices)
    large = np.bincount(region_of, areas) >= _LEAST_AREA * areas.sum()
    large[region_of[plane_of == NOWHERE]] = False
    kept = np.full_like(plane_of, NOWHERE)
    order = np.argsort(region_of, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(region_of[order])) + 1):
        if not large[region_of[members[0]]]:
            continue
        plane = planes[plane_of[members[0]]]
        if not is_bent(plane, vertices[members], lengths[members]):
            kept[members] = plane_of[members]
    return kept


def is_bent(plane: Floats, points: Floats, lengths: Floats) -> bool:
    """Whether the distances of points [K, 3] to their plane are those of a quadric: mostly, or in
    part where that turns by more than a crease that one would see."""
    middle = points.mean(axis=0)
    _, axes = np.linalg.eigh((points - middle).T @ (points - middle))
    along = (points - middle) @ axes[:, 1:]
    reach = np.maximum(np.abs(along).max(axis=0), 1e-30)
    u, v = (along / reach).T
    far = distances(plane, points) / np.maximum(lengths, 1e-12)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    found = np.linalg.lstsq(terms, far, rcond=None)[0]
    explained = terms @ found
    rms = float(np.sqrt((explained**2).mean()))
    share = rms**2 / max(float((far**2).mean()), 1e-30)
    slopes = np.stack(
        [2.0 * found[3] * u + found[4] * v, found[4] * u + 2.0 * found[5] * v], axis=-1
    )
    slopes *= np.median(lengths) / reach
    turned = float(np.sqrt(((slopes - slopes.mean(axis=0)) ** 2).sum(axis=1).mean()))
    mostly = rms > _BENT and share > _BENT_SHARE
    return mostly or (turned > np.tan(np.radians(_TURNED_DEG)) and share > _TURNED_SHARE)


def _in_relief(
    wanted: Floats, trust: Floats, on: NDArray[np.bool_], lengths: Floats, rings: MeshRings
) -> NDArray[np.bool_]:
    """[V]: where what is trusted says, all around, that the surface is not on its plane."""
    in_edges = wanted / np.maximum(lengths, 1e-12)
    sums = rings.spread(
        np.stack([trust * in_edges, trust, on.astype(np.float64)], axis=-1), _RELIEF_ROUNDS
    )
    mean = sums[:, 0] / np.maximum(sums[:, 1], 1e-9)
    sure = sums[:, 1] / np.maximum(sums[:, 2], 1e-9)
    relief: NDArray[np.bool_] = on & (np.abs(mean) > _RELIEF) & (sure > _RELIEF_TRUST)
    return relief


def _shared(wanted: Floats, trust: Floats, plane_of: Ints, rings: MeshRings) -> Floats:
    """[V]: the distances to the planes that photos answer for and neighbours share."""
    edges = edges_within(plane_of, rings)
    degree = np.asarray(edges.sum(axis=1)).ravel()
    matrix = diags_array(trust + _TO_PLANE) + _SMOOTH * (diags_array(degree) - edges)
    return _solved(matrix.tocsr(), trust * wanted)


def _not_alone(moves: Floats, rings: MeshRings) -> Floats:
    """The moves [V] as far as the neighbours', in the mean, are half of them.

    One vertex that the photos are sure of, and none around it, has been mistaken for another.
    """
    around = _MOST_ALONE * (rings.around @ moves) / np.maximum(rings.degree, 1.0)
    shared: Floats = np.where(
        moves * around > 0.0, np.copysign(np.minimum(abs(moves), abs(around)), moves), 0.0
    )
    return shared


def edges_within(plane_of: Ints, rings: MeshRings) -> csr_array:
    """[V, V]: 1 where an edge joins two vertices of one plane."""
    pairs = rings.around.tocoo()
    same = (plane_of[pairs.row] == plane_of[pairs.col]) & (plane_of[pairs.row] != NOWHERE)
    return coo_array(
        (np.ones(int(same.sum())), (pairs.row[same], pairs.col[same])), shape=pairs.shape
    ).tocsr()


def _solved(matrix: csr_array, wanted: Floats) -> Floats:
    found, _ = cg(
        matrix,
        wanted,
        rtol=_TOLERANCE,
        maxiter=_ITERATIONS,
        M=diags_array(1.0 / matrix.diagonal()),
    )
    solved: Floats = found
    return solved


def distances(plane: Floats, points: Floats) -> Floats:
    """[K]: signed distances."""
    signed: Floats = points @ plane[:3] - plane[3]
    return signed


def _aligned(plane: Floats, normals: Floats, cosine: float) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = np.abs(normals @ plane[:3]) > cosine
    return found


def _near(
    plane: Floats, points: Floats, normals: Floats, scale: Floats, slack: float = 1.0
) -> NDArray[np.bool_]:
    """[K]: which points lie on the plane and face as it does."""
    on: NDArray[np.bool_] = np.abs(distances(plane, points)) < slack * _NEAR * scale
    return on & _aligned(plane, normals, 1.0 - slack * (1.0 - _ALIGNED))
