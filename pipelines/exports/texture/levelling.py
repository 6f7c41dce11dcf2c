"""Charts brought to one brightness: what must be added to each corner so that seams do not show.

Photos differ in exposure and white balance. Corners that lie on one point of the surface should
have one colour: their differences are spread over the charts as smoothly as possible. Source:
Lempitsky and Ivanov, "Seamless mosaicing of image-based texture maps", CVPR 2007; Waechter et al.
2014, section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

from pipelines.exports.texture.charts import Charts
from pipelines.exports.texture.choice import NOBODY
from pipelines.nerf.stereo.light import offsets_between

Floats = NDArray[np.float64]

_SMOOTH = 0.3
_KEEP = 1e-3
_MOST = 0.1
"""Where the photos of a corner differ by so much more than these photos do elsewhere, one of them
shows something else there: what lies behind the edge that the corner is on, or stands before it."""
_ITERATIONS, _TOLERANCE = 300, 1e-4


def levels(charts: Charts, colors: Floats, poll: Callable[[], None] = lambda: None) -> Floats:
    """What to add to each corner's colour, [U, 3].

    colors: [U, 3] in [0, 1], as each corner's photo has it; NaN where no photo shows it. poll:
    called every fraction of a second; may raise.
    """
    known = charts.photo[charts.chart] != NOBODY
    seams = _seams(charts, known)
    difference = _believed(
        colors[seams[:, 1]] - colors[seams[:, 0]], charts.photo[charts.chart[seams]]
    )
    poll()
    edges = _edges(charts, known)
    poll()
    count = len(charts.vertex)
    across, within = _differences(seams, count), _differences(edges, count)
    matrix = csr_array(
        across.T @ across + _SMOOTH * (within.T @ within) + _KEEP * diags_array(np.ones(count))
    )
    scale = 1.0 / matrix.diagonal()
    found = np.zeros((count, 3))
    for channel in range(3):
        wanted = across.T @ difference[:, channel]
        # Jacobi's preconditioner; where it stops early the seams are only less than perfect.
        found[:, channel], _ = cg(
            matrix,
            wanted,
            rtol=_TOLERANCE,
            maxiter=_ITERATIONS,
            M=diags_array(scale),
            callback=lambda _: poll(),
        )
    return found


def _believed(difference: Floats, photos: NDArray[np.integer[Any]]) -> Floats:
    """The differences [S, 3] at seams of two photos [S, 2]; those that are far from what the two
    photos differ by elsewhere are replaced by that.
    """
    if len(difference) == 0:
        return difference
    offsets = offsets_between(photos, difference, int(photos.max()) + 1)
    expected = offsets[photos[:, 1]] - offsets[photos[:, 0]]
    far_off = np.abs(difference - expected).max(axis=1) > _MOST
    believed: Floats = np.where(far_off[:, None], expected, difference)
    return believed


def _seams(charts: Charts, known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Pairs [S, 2] of corners of different charts at one vertex."""
    corners = np.flatnonzero(known)
    order = corners[np.argsort(charts.vertex[corners], kind="stable")]
    same = charts.vertex[order][1:] == charts.vertex[order][:-1]
    return np.stack([order[:-1][same], order[1:][same]], axis=1)


def _edges(charts: Charts, known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Pairs [E, 2] of corners that an edge of a chart joins."""
    faces = charts.faces[known[charts.faces[:, 0]]]
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0).astype(np.intp)


def _differences(pairs: NDArray[np.intp], count: int) -> csr_array:
    """[S, U]: the first of a pair less the second."""
    rows = np.repeat(np.arange(len(pairs)), 2)
    values = np.tile([1.0, -1.0], len(pairs))
    return csr_array((values, (rows, pairs.reshape(-1))), shape=(len(pairs), count))
