"""A mesh without what stands right before a camera that saw far beyond it.

Who films stands in empty space. Surfaces that are closed where nothing was seen, and ghosts of a
few views, know nothing of that: a camera was found in each of three captures of 28 behind a sheet
of some triangles, a hundredth of its depth away, which hides all that it saw.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, binary_propagation

from pipelines.exports.mesh import TriangleMesh
from pipelines.scene.depth_views import DepthView, Floats, ViewStore

_TOO_NEAR = 0.1
"""Share of a view's depth: nothing is filmed through what stands so near."""
_RAYS = 100
"""Of a view along its long side, about: what is so near is large."""
_WHOLE = np.ones((3, 3), np.bool_)
"""Rays: what nowhere hides so many together is the outline of something before a far ground, which
a mesh and a depth map never have at the same pixel."""
_MOST_ROUNDS = 8
"""Behind one sheet there may be another."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def unblocked(
    mesh: TriangleMesh,
    views: Sequence[ViewStore | Sequence[DepthView]],
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """The mesh without the faces that rays of a view meet before a tenth of the depth that is known
    there, where these are a patch of the picture.

    views: in any number of parts. on_progress: told the share that is done; may raise. A mesh of
    which nothing would be left stays.
    """
    faces = mesh.faces
    origin = mesh.vertices.mean(axis=0) if len(mesh.vertices) else np.zeros(3)
    asked = [(part, index) for part in views for index in range(len(part))]
    for turn in range(_MOST_ROUNDS):
        if len(faces) == 0:
            return mesh
        scene = _tensor_geometry.RaycastingScene()
        scene.add_triangles(
            _core.Tensor((mesh.vertices - origin).astype(np.float32)),
            _core.Tensor(faces.astype(np.uint32)),
        )
        centers = sum(mesh.vertices[corner] for corner in faces.T) / 3.0
        blocking = np.zeros(len(faces), np.bool_)
        blocked = []
        for done, (part, index) in enumerate(asked):
            on_progress((turn + done / len(asked)) / _MOST_ROUNDS)
            found = _blocking(scene, part[index], origin, centers)
            if len(found):
                blocking[found] = True
                blocked.append((part, index))
        if not blocked:
            break
        faces, asked = faces[~blocking], blocked
    return mesh if len(faces) in (0, len(mesh.faces)) else mesh.with_faces(faces)


def _blocking(
    scene: Any,
    view: DepthView,
    origin: Floats,
    centers: Floats,
) -> NDArray[np.int64]:
    """The faces that stand before a view: those that rays meet, and the smaller ones between.

    origin: [3], of the scene. centers: [F, 3], of its faces, in the world.
    """
    every = max(round(max(view.z_depth.shape) / _RAYS), 1)
    known = view.z_depth[::every, ::every]
    ways = view.lens.directions()[::every, ::every]  # of z depth 1
    pose = np.asarray(view.world_from_camera, np.float64)
    begins = np.broadcast_to(pose[:, 3] - origin, ways.shape)
    rays = np.concatenate([begins, ways @ pose[:, :3].T], axis=-1).astype(np.float32)
    found = scene.cast_rays(_core.Tensor(rays))
    hides = found["t_hit"].numpy() < _TOO_NEAR * known
    patches = binary_erosion(hides, _WHOLE, border_value=1)
    near = binary_propagation(patches, _WHOLE, mask=hides)
    if not near.any():
        return np.zeros(0, np.int64)
    x, y, back = ((centers - pose[:, 3]) @ pose[:, :3]).T
    z = np.where(back < 0.0, -back, np.inf)
    lens = view.lens
    column = np.floor((lens.cx + lens.fl_x * x / z) / every)
    row = np.floor((lens.cy - lens.fl_y * y / z) / every)
    shown = (column >= 0) & (column < near.shape[1]) & (row >= 0) & (row < near.shape[0])
    which = np.flatnonzero(shown & np.isfinite(z))
    place = row[which].astype(np.int64), column[which].astype(np.int64)
    small = which[near[place] & (z[which] < _TOO_NEAR * known[place])]
    return np.union1d(found["primitive_ids"].numpy()[near].astype(np.int64), small)
