"""A fused mesh moved onto what the photos agree on, a fraction of a voxel.

Depth is fused at the voxels' and the rendered pictures' resolution; photos are finer. Each vertex
asks the photos that see it how far along its normal they agree best
(`pipelines.nerf.stereo.refinement`), first in photos of half the size, then in whole ones. Answers
are believed by how clear they are and by how well they fit the neighbours': the offsets solve

    min_d  sum_i t_i (d_i - o_i)^2 + s sum_edges (d_i - d_j)^2

with t the trust, less where an answer is far from the solution, and s falling from 16 to 1/2: first
whole regions move, then details. Where photos say nothing, vertices go with their neighbours.
Where they would move a region by more than about an edge they have mistaken something, as in the
grain of wood or in a gleam: a fused surface is not so far off. There it stays.
Vertices on sharp edges and open borders stay: there a patch on the tangent shows two things. What
is about plane is made so before, as a wall whose normals tremble looks sharp all over, and once
more in the end, as far as the photos do not say otherwise (`pipelines.exports.surface.flatness`);
there what is plain and not plane becomes smooth (`pipelines.exports.surface.fairing`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.sparse.linalg import cg

from pipelines.exports.each_view import each_view
from pipelines.exports.mesh import TriangleMesh, unit_normals
from pipelines.exports.surface import fairing
from pipelines.exports.surface.flatness import NOWHERE, Answers, find_flat_parts, flattened
from pipelines.exports.surface.plain import find_plain, with_plain_parts
from pipelines.exports.surface.rings import MeshRings
from pipelines.exports.surface.sight import Sight
from pipelines.nerf.stereo.refinement import Offsets, Pictures, photo_offsets
from pipelines.nerf.stereo.views import StereoView

Floats = NDArray[np.float64]

_ROUNDS = ((2, 5), (1, 4))
"""Photos reduced by so much, looked at so many half pixels to each side."""
_STIFFNESS = (16.0, 8.0, 4.0, 2.0, 1.0, 0.5)
_HOLD = 1e-3
"""A vertex of which nothing is known, nor of any neighbour, stays."""
_HOLD_SHARP = 1.0
_STRAIGHT, _BENT = 0.9, 0.75
"""Length of the mean normal around a vertex: on a surface, and on the edge of a box."""
_CLEAR = 0.3
_FAR, _FAR_ROUNDS = 1.5, 10
"""Edges that moves around a vertex have, as root mean square, for half of them to be believed: of
99 in 100 vertices that are right they have 0.6 to 1."""
_NORMAL_ROUNDS = 2
_LEAST_VIEWS = 2
_SIGHT_SHARE, _POINTS_SHARE = 0.3, 0.5
_FLAT_SHARE = 0.1
"""Of the progress, for what is flat: first and last."""
_ITERATIONS, _TOLERANCE = 200, 1e-4


def refined(
    mesh: TriangleMesh,
    views: Sequence[StereoView],
    on_progress: Callable[[float], None] = lambda done: None,
    *,
    flat: bool = True,
    noise: float = 0.0,
) -> TriangleMesh:
    """The mesh with its vertices moved and without what no two views show.

    Colours stay. views: undistorted grey photos with their cameras, in the mesh's world. flat:
    whether what is about plane becomes plane, and what else is plain smooth. noise: the edge whose
    parts bumps are, where edges are shorter; world units. on_progress: told the share that is done;
    may raise.
    """
    if len(mesh.faces) == 0 or not views:
        return mesh
    origin = mesh.vertices.mean(axis=0)
    vertices = mesh.vertices - origin
    rings = MeshRings(mesh.faces, len(vertices), noise)
    if flat:
        parts = find_flat_parts(vertices, rings, lambda: on_progress(0.0))
        vertices = flattened(vertices, parts, rings)
    sharp = _sharpness(vertices, rings)
    photos_share = 1.0 - 2.0 * _FLAT_SHARE

    def on_photos(done: float) -> None:
        on_progress(_FLAT_SHARE + photos_share * done / len(_ROUNDS))

    for index, (factor, num_steps) in enumerate(_ROUNDS):
        normals = rings.normals(vertices)

        def on_view(done: float, before: int = index) -> None:
            on_photos(before + _SIGHT_SHARE * done)

        def on_point(done: float, before: int = index) -> None:
            on_photos(before + _SIGHT_SHARE + _POINTS_SHARE * done)

        seen = _seen(vertices, normals, mesh.faces, views, origin, on_view)
        smooth = _smoothed(normals, rings)
        pictures = Pictures.of([view.reduced(factor) for view in views], origin)
        offsets = photo_offsets(vertices, smooth, seen, pictures, num_steps, on_progress=on_point)
        lengths = rings.edge_lengths(vertices)
        moves = _agreed(offsets, rings, lengths, sharp)
        believed = _believed(moves / np.maximum(lengths, 1e-30), rings)
        moves *= believed
        vertices = vertices + moves[:, None] * smooth
        on_photos(index + 1)
    if flat:
        left = offsets.length.astype(np.float64) - moves
        trust = offsets.trust * believed
        parts = find_flat_parts(vertices, rings, lambda: on_photos(len(_ROUNDS)))
        parts = with_plain_parts(parts, vertices, rings, mesh.colors, trust)
        answers = Answers(left, trust, offsets.step.astype(np.float64))
        vertices = flattened(vertices, parts, rings, answers)
        plain = find_plain(rings, mesh.colors, trust, fairing.ONE_COLOUR, fairing.UNTOLD)
        vertices = fairing.faired(vertices, plain & (parts.plane_of == NOWHERE), rings)
    on_progress(1.0)
    moved = replace(mesh, vertices=vertices + origin, normals=rings.normals(vertices))
    return moved.with_faces(_shown_faces(mesh.faces, seen, rings))


def _shown_faces(
    faces: NDArray[np.int32], seen: NDArray[np.uint8], rings: MeshRings
) -> NDArray[np.int32]:
    """The faces that have a corner which enough views show, or which is next to one that they do.

    What is fused behind a surface, where it ends for all cameras, was never looked at: more than
    half of it is wrong. A mesh of which nothing is shown stays.
    """
    shown = (seen.sum(axis=0, dtype=np.int32) >= _LEAST_VIEWS).astype(np.float64)
    near = (shown + rings.around @ shown) > 0.0
    kept = near[faces].any(axis=1)
    return faces[kept] if kept.any() else faces


def _smoothed(normals: Floats, rings: MeshRings) -> Floats:
    """Normals with their neighbours' mean: a fused surface's own are noisy."""
    for _ in range(_NORMAL_ROUNDS):
        normals = unit_normals(rings.spread(normals, 1))
    return normals


def _seen(
    vertices: Floats,
    normals: Floats,
    faces: NDArray[np.int32],
    views: Sequence[StereoView],
    origin: Floats,
    on_view: Callable[[float], None],
) -> NDArray[np.uint8]:
    """[N, V]: 1 where a view shows a vertex from its front, with nothing before it."""
    sight = Sight(vertices, faces)
    edges = vertices[faces[:, 0]] - vertices[faces[:, 1]]
    lifted = vertices + 0.5 * float(np.median(np.linalg.norm(edges, axis=1))) * normals
    placed = vertices + origin

    def seen_by(view: StereoView) -> NDArray[np.bool_]:
        _, shown = view.seen(placed)
        eye = view.center - origin
        shown &= np.einsum("vd,vd->v", eye - vertices, normals) > 0.0
        shown[shown] = sight.reached(eye, lifted[shown])
        return shown

    seen = np.zeros((len(views), len(vertices)), np.uint8)
    for index, shown in enumerate(each_view(seen_by, views)):
        seen[index] = shown
        on_view((index + 1) / len(views))
    return seen


def _sharpness(vertices: Floats, rings: MeshRings) -> Floats:
    """[V] in [0, 1]: 0 where the surface is about flat, 1 at its edges and open borders."""
    straight = rings.straightness(vertices, _NORMAL_ROUNDS)
    sharp: Floats = np.clip((_STRAIGHT - straight) / (_STRAIGHT - _BENT), 0.0, 1.0)
    sharp[rings.on_border] = 1.0
    return sharp


def _agreed(offsets: Offsets, rings: MeshRings, lengths: Floats, sharp: Floats) -> Floats:
    """The moves [V] that fit those offsets that are believed, and each other."""
    wanted, trust = offsets.length.astype(np.float64), offsets.trust * (1.0 - sharp)
    hold = _HOLD + _HOLD_SHARP * sharp
    clear = trust > _CLEAR
    if not clear.any():
        return np.zeros(len(wanted))
    in_edges = np.abs(wanted[clear]) / lengths[clear]
    typical = float(np.median(in_edges)) * lengths + 1e-30
    stiff: Any = rings.laplacian
    weights, found = trust, np.zeros(len(wanted))
    for stiffness in _STIFFNESS:
        matrix = (diags_array(weights + hold) + stiffness * stiff).tocsr()
        scale = diags_array(1.0 / matrix.diagonal())
        found, _ = cg(
            matrix, weights * wanted, x0=found, rtol=_TOLERANCE, maxiter=_ITERATIONS, M=scale
        )
        weights = trust / (1.0 + ((found - wanted) / typical) ** 2)
    return found


def _believed(in_edges: Floats, rings: MeshRings) -> Floats:
    """How much of moves [V], in edges, is to be done, [V] in [0, 1]."""
    around = rings.spread((in_edges**2)[:, None], _FAR_ROUNDS)[:, 0]
    share: Floats = 1.0 / (1.0 + (around / _FAR**2) ** 2)
    return share
