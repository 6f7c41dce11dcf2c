"""What views say of a mesh's vertices: how many see each from its front, and in what colour."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.each_view import each_view
from pipelines.exports.mesh import Floats, TriangleMesh
from pipelines.exports.surface.tsdf import Sized
from pipelines.scene.depth_views import DepthView
from pipelines.scene.picture_sampling import between_pixels

_LEAST_COSINE = 0.1


def seen_colors(
    mesh: TriangleMesh,
    views: Sized,
    beside: float,
    on_progress: Callable[[float], None] = lambda done: None,
) -> tuple[NDArray[np.int32], Floats]:
    """[V] how many views see each vertex from its front, and [V, 3] the mean of their colours.

    A view counts by the cosine of the angle at which it looks: at a glance pixels are coarse, and
    at an outline they are mixed with what is behind. beside: how far from a view's depth a vertex
    may be, along the view's axis, to be what it sees; world units. on_progress: told the share that
    is done; may raise. Colours are in [0, 1], 0 of what no view sees.
    """
    count = np.zeros(len(mesh.vertices), np.int32)
    weight, total = np.zeros((len(mesh.vertices), 1)), np.zeros((len(mesh.vertices), 3))
    shown = each_view(lambda view: _shown(mesh, view, beside), views)
    for done, (which, cosine, colors) in enumerate(shown, start=1):
        count[which] += 1
        weight[which] += cosine[:, None]
        total[which] += cosine[:, None] * colors
        on_progress(done / len(views))
    mean: Floats = np.clip(total / np.maximum(weight, 1e-12), 0.0, 1.0)
    return count, mean


def _shown(
    mesh: TriangleMesh, view: DepthView, beside: float
) -> tuple[NDArray[np.intp], Floats, NDArray[np.float32]]:
    """Which vertices a view sees from their front, [Q], the cosines of the angles between their
    normals and the rays, [Q], and their colours there, [Q, 3]."""
    lens, eye = view.lens, view.world_from_camera[:, 3]
    toward = mesh.vertices - eye
    x, y, back = (toward @ view.world_from_camera[:, :3]).T
    depth = np.maximum(-back, 1e-12)
    length = np.maximum(np.sqrt(np.einsum("vd,vd->v", toward, toward)), 1e-12)
    cosine = -np.einsum("vd,vd->v", toward, mesh.normals) / length
    column, row = lens.cx + lens.fl_x * x / depth, lens.cy - lens.fl_y * y / depth
    inside = (cosine > _LEAST_COSINE) & (back < -1e-9) & (column >= 0) & (column < lens.width)
    which = np.flatnonzero(inside & (row >= 0) & (row < lens.height))
    found = view.z_depth[row[which].astype(int), column[which].astype(int)]
    which = which[(found > 0) & (np.abs(found - depth[which]) <= beside)]
    picture = np.asarray(view.rgb, np.float32) / np.float32(255.0)
    return which, cosine[which], between_pixels(picture, column[which], row[which])
