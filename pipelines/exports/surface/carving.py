"""A mesh without what stands where photos show that nothing does.

What a ray passes that ends in the sky or in a blank ground is empty, all the way: the visual hull
(Laurentini, "The Visual Hull Concept for Silhouette-Based Image Understanding", PAMI 1994). Fusion
knows surfaces alone, and lets them run on past a thing's rim, or across the gap between two
chimneys, where the photos paint them with the sky.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from pipelines.exports.mesh import TriangleMesh
from pipelines.nerf.stereo.views import StereoView

_MARGIN_PX = 2
"""Of a map: what is so near to something may be its outline, or its pose's error."""
_LEAST_VIEWS, _LEAST_SHARE = 3, 0.05
"""Views, and of those whose picture reaches there the share, that see through a vertex."""


def carved(
    mesh: TriangleMesh,
    views: Iterable[tuple[StereoView, NDArray[np.bool_]]],
    poll: Callable[[], None] = lambda: None,
) -> TriangleMesh:
    """The mesh without the faces of which views see through all three corners.

    views: each with where nothing stands in its picture, [H, W]. poll: called for each; may raise.
    A mesh of which nothing would be left stays.
    """
    through = np.zeros(len(mesh.vertices), np.int64)
    reached = np.zeros(len(mesh.vertices), np.int64)
    for view, void in views:
        poll()
        inside = binary_erosion(void, iterations=_MARGIN_PX, border_value=1)
        which, row, column = view.shown_at(mesh.vertices)
        reached[which] += 1
        through[which] += inside[row, column]
    empty = (through >= _LEAST_VIEWS) & (through >= _LEAST_SHARE * reached)
    kept = ~empty[mesh.faces].all(axis=1)
    return mesh if kept.all() or not kept.any() else mesh.with_faces(mesh.faces[kept])
