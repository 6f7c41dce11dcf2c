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

from pipelines.exports.mesh import TriangleMesh
from pipelines.scene.depth_views import DepthView, ViewStore

_TOO_NEAR = 0.1
"""Share of a view's depth: nothing is filmed through what stands so near."""
_EVERY = 3
"""Pixels along each side for a ray: what is so near is large."""
_MOST_ROUNDS = 8
"""Behind one sheet there may be another."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def unblocked(
    mesh: TriangleMesh,
    views: Sequence[ViewStore | Sequence[DepthView]],
    poll: Callable[[], None] = lambda: None,
) -> TriangleMesh:
    """The mesh without the faces that a ray of a view meets before a tenth of the depth that is
    known there. views: in any number of parts. poll: called for each view, more than once; may
    raise. A mesh of which nothing would be left stays.
    """
    faces = mesh.faces
    origin = mesh.vertices.mean(axis=0) if len(mesh.vertices) else np.zeros(3)
    asked = [(part, index) for part in views for index in range(len(part))]
    for _ in range(_MOST_ROUNDS):
        if len(faces) == 0:
            return mesh
        scene = _tensor_geometry.RaycastingScene()
        scene.add_triangles(
            _core.Tensor((mesh.vertices - origin).astype(np.float32)),
            _core.Tensor(faces.astype(np.uint32)),
        )
        blocking = np.zeros(len(faces), np.bool_)
        blocked = []
        for part, index in asked:
            poll()
            found = _blocking(scene, part[index], origin)
            if len(found):
                blocking[found] = True
                blocked.append((part, index))
        if not blocked:
            break
        faces, asked = faces[~blocking], blocked
    return mesh if len(faces) in (0, len(mesh.faces)) else mesh.with_faces(faces)


def _blocking(scene: Any, view: DepthView, origin: NDArray[np.float64]) -> NDArray[np.int64]:
    """The faces that stand before a view."""
    known = view.z_depth[::_EVERY, ::_EVERY]
    ways = view.lens.directions()[::_EVERY, ::_EVERY][known > 0.0]  # of z depth 1
    pose = np.asarray(view.world_from_camera, np.float64)
    begins = np.broadcast_to(pose[:, 3] - origin, ways.shape)
    rays = np.concatenate([begins, ways @ pose[:, :3].T], axis=1).astype(np.float32)
    found = scene.cast_rays(_core.Tensor(rays))
    near = found["t_hit"].numpy() < _TOO_NEAR * known[known > 0.0]
    return np.unique(found["primitive_ids"].numpy()[near]).astype(np.int64)
