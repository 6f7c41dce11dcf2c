"""The plain parts of a mesh that are not plane made smooth: where photos say nothing, noise is all
that bends a surface sharply.

Floors and tables become plane (`pipelines.exports.surface.flatness`); the side of a white drum is
as plain and as bumpy. So where all around has one colour and the photos have no say, the vertices
move along their normals by d that bends the surface least while it stays about where it is:

    min_d  sum_i d_i^2 + a sum_i (b_i + sum_j U_ij d_j)^2

with U the umbrella, a vertex less the mean of its neighbours, and b what that is of the places now,
along the normal. Bumps shorter than 2 pi a^(1/4) edges go; what is bent more widely stays. Source:
Kobbelt et al., "Interactive Multi-Resolution Modeling on Arbitrary Meshes", SIGGRAPH 1998.

Symbols: V vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.sparse.linalg import cg

from pipelines.exports.mesh import unit_normals
from pipelines.exports.surface.rings import MeshRings

Floats = NDArray[np.float64]

ONE_COLOUR, UNTOLD = 0.03, 0.15
"""Spread of colours [0, 1] around a vertex, and trust in the photos' answers, below which it is
plain enough: less than for a plane, which much more than its neighbourhood speaks for."""
_STIFFNESS = 500.0
_MOST_EDGES = 0.5
"""So far at most a vertex moves: fusion's noise, and little enough for the edges of a white box."""
_NORMAL_ROUNDS = 4
_ITERATIONS, _TOLERANCE = 500, 1e-2


def faired(vertices: Floats, plain: NDArray[np.bool_], rings: MeshRings) -> Floats:
    """The vertices [V, 3] with what is plain, [V], smooth; all else and open borders stay."""
    which = np.flatnonzero(plain & ~rings.on_border)
    if len(which) == 0:
        return vertices
    normals = unit_normals(rings.spread(rings.normals(vertices), _NORMAL_ROUNDS))
    umbrella = (diags_array(1.0 / np.maximum(rings.degree, 1.0)) @ rings.laplacian).tocsr()
    bent = ((umbrella @ vertices) * normals).sum(axis=1)
    moving = umbrella[:, which].tocsr()
    matrix = (diags_array(np.ones(len(which))) + _STIFFNESS * (moving.T @ moving)).tocsr()
    moves, _ = cg(
        matrix,
        -_STIFFNESS * (moving.T @ bent),
        rtol=_TOLERANCE,
        maxiter=_ITERATIONS,
        M=diags_array(1.0 / matrix.diagonal()),
    )
    most = _MOST_EDGES * rings.scale(vertices)[which]
    fair = vertices.copy()
    fair[which] += np.clip(moves, -most, most)[:, None] * normals[which]
    return fair
