"""A mesh whose outlines lie on the edges that the photos show there.

Where a surface ends before another one, depth says little: a rendered pixel holds both, and a patch
of a photo shows both, so that `pipelines.exports.surface.refinement` holds such vertices. Rims come
out frayed, and a texture of photos has the background on them. But there a photo has an edge. So
at each outline of the mesh, as a photo's camera sees it, the photo's colours I across it are
compared with the mesh's own on both sides, F before and B behind it:

    E(s) = sum_(t < s) min(|I(t) - F(t)|^2, c) + sum_(t >= s) min(|I(t) - B(t)|^2, c)

with t in px along the outline's normal, 0 where the mesh ends; where E is least it should end. The
search along normals is that of Harris and Stennett (RAPID, BMVC 1990); colours of both sides in
place of gradients are after Hanek and Beetz (contracting curve density, IJCV 2004). Each answer is
an equation for the face that ends there, o = s z / f across the ray; together, with neighbours that
move alike, they give the moves of all vertices:

    min_d  sum_j w_j (N_j . sum_k b_jk d_k - o_j)^2 + a sum_edges |d_i - d_k|^2
           + sum_i A_i (h |d_i|^2 + g f_i (n_i . d_i)^2)

with b the place within the face, w the trust, less where an answer is far from the solution, A the
area around a vertex in squares of a pixel, n its normal and f 1 on planes, else 0: so moves die
away sqrt(a / h) px from an outline, whatever the size of the triangles, and sooner where they would
carry a wall along: seen at a grazing angle it goes many pixels along the ray for one across it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, cg

from pipelines.exports.each_view import each_view
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.flatness import NOWHERE, find_flat_parts
from pipelines.exports.surface.outline_views import Answers, OutlineView
from pipelines.exports.surface.rings import MeshRings
from pipelines.exports.surface.sight import Sight
from pipelines.scene.stereo_views import ColorView

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Round:
    """factor: photos are reduced by so much. stiffness: a above. begins: how far before the
    outline, px, the mesh's colours are believed, one hypothesis each."""

    factor: int
    stiffness: float
    begins: tuple[float, ...]


_JUST, _DEEPER = 0.5, 3.0
"""A flap at a rim has the background's colour: what it hangs on is found a little farther in."""
_ROUNDS = (_Round(2, 1.0, (_JUST, _DEEPER)), _Round(1, 0.3, (_JUST,)), _Round(1, 0.3, (_JUST,)))
_MOST_ANSWERS = 1_000_000
_HOLD = 0.003
"""Answers' worth of staying where it is, for a square of a pixel: what few photos saw end there
does not carry its surroundings away."""
_HOLD_FLAT = 0.3
"""The same along the normal, of vertices on a plane: seen at a few degrees, a wall ends far from
where it should for an edge that is a little off."""
_LEAST_AREA = 0.3
"""Squares of a pixel: slivers are held too."""
_RINGS = 8
"""Of neighbours around an outline that move: farther away there is nothing left of a move."""
_REWEIGHTED = 4
_ITERATIONS, _TOLERANCE = 200, 1e-3
_SOME_VIEWS = 16
"""Tell how large a pixel is, about."""
_SOLVE_SHARE = 0.2
"""Of a round's progress, for the moves."""


def outlined(
    mesh: TriangleMesh,
    views: Sequence[ColorView],
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """The mesh with its vertices moved so that it ends, for each view, where the photo says.

    Colours and faces stay. views: undistorted photos with their cameras, in the mesh's world.
    on_progress: told the share that is done; may raise.
    """
    if len(mesh.faces) == 0 or not views:
        return mesh
    origin = mesh.vertices.mean(axis=0)
    vertices = mesh.vertices - origin
    rings = MeshRings(mesh.faces, len(vertices))
    corner_colors = mesh.colors[mesh.faces].astype(np.float32)
    pixel = _pixels(vertices, views, origin)
    flat_parts = find_flat_parts(vertices, rings, lambda: on_progress(0.0))
    on_plane = flat_parts.plane_of != NOWHERE
    for index, step in enumerate(_ROUNDS):
        sight = Sight(vertices, mesh.faces)
        ask = functools.partial(_answers, sight, corner_colors, origin, step)
        parts = []
        for number, part in enumerate(each_view(ask, views)):
            parts.append(part)
            done = (1.0 - _SOLVE_SHARE) * (number + 1) / len(views)
            on_progress((index + done) / len(_ROUNDS))
        answers = Answers.joined(parts).thinned(_MOST_ANSWERS)
        holds = _holds(vertices, rings, pixel, on_plane)
        vertices = vertices + _moves(answers, rings, step.stiffness, *holds)
        on_progress((index + 1) / len(_ROUNDS))
    return replace(mesh, vertices=vertices + origin, normals=rings.normals(vertices))


def _answers(
    sight: Sight, corner_colors: NDArray[np.float32], origin: Floats, step: _Round, view: ColorView
) -> Answers:
    """What one view says in a round. The rest as `OutlineView` has it."""
    seen = OutlineView(sight, corner_colors, view.reduced(step.factor), origin)
    return seen.answers(step.begins)


def _pixels(vertices: Floats, views: Sequence[ColorView], origin: Floats) -> Floats:
    """[V]: how large a pixel is at each vertex, world units, in the median view of some."""
    chosen = views[:: max(1, len(views) // _SOME_VIEWS)]
    sizes = [
        np.linalg.norm(vertices + origin - view.world_from_camera[:, 3], axis=1) / view.lens.fl_x
        for view in chosen
    ]
    size: Floats = np.median(sizes, axis=0)
    return size


def _holds(
    vertices: Floats, rings: MeshRings, pixel: Floats, on_plane: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """What moves cost: any one [V], and besides, its square, along [V, 3]. pixel, on_plane: [V]."""
    area = np.maximum(rings.areas(vertices) / pixel**2, _LEAST_AREA)
    flat = np.sqrt(_HOLD_FLAT * area * on_plane)
    return _HOLD * area, rings.normals(vertices) * flat[:, None]


def _moves(
    answers: Answers, rings: MeshRings, stiffness: float, hold: Floats, along: Floats
) -> Floats:
    """The moves [V, 3] that fit those answers that are believed, and each other.

    hold: [V]. along: [V, 3]. Both as of `_holds`.
    """
    rows = len(answers.offsets)
    moves = np.zeros((rings.num_vertices, 3))
    if rows == 0:
        return moves
    corners = rings.faces[answers.faces]
    near = np.zeros(rings.num_vertices)
    near[corners] = 1.0
    for _ in range(_RINGS):
        near += rings.around @ near
    free = np.flatnonzero(near)
    place = np.zeros(rings.num_vertices, np.int64)
    place[free] = np.arange(len(free))
    columns = 3 * place[corners][:, :, None] + np.arange(3)
    values = answers.places[:, :, None] * answers.across[:, None, :]
    starts = np.arange(0, 9 * rows + 1, 9)
    told = csr_array((values.ravel(), columns.ravel(), starts), shape=(rows, 3 * len(free)))
    squared = told.power(2)
    stiff: Any = rings.laplacian[free][:, free]
    held = np.repeat(hold[free], 3)
    along = along[free]
    still = stiffness * np.repeat(rings.degree[free], 3) + held + along.ravel() ** 2
    weights, found = answers.trust, np.zeros(3 * len(free))

    def product(tried: Floats) -> Floats:
        each = tried.reshape(-1, 3)
        spread = (stiff @ each).ravel()
        across = ((each * along).sum(axis=1, keepdims=True) * along).ravel()
        result: Floats = (
            told.T @ (weights * (told @ tried)) + stiffness * spread + held * tried + across
        )
        return result

    size = 3 * len(free)
    matrix = LinearOperator((size, size), matvec=product, dtype=np.float64)
    for _ in range(_REWEIGHTED):
        diagonal = squared.T @ weights + still
        scale = LinearOperator(matrix.shape, matvec=diagonal.__rtruediv__, dtype=np.float64)
        found, _ = cg(
            matrix,
            told.T @ (weights * answers.offsets),
            x0=found,
            rtol=_TOLERANCE,
            maxiter=_ITERATIONS,
            M=scale,
        )
        left = (told @ found - answers.offsets) / answers.pixels
        weights = answers.trust / (1.0 + left**2)
    moves[free] = found.reshape(-1, 3)
    return moves
