"""What of a mesh an eye sees with nothing in the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


class Sight:
    """A mesh that hides what lies behind it. vertices: [V, 3]. faces: [F, 3]."""

    def __init__(self, vertices: Floats, faces: NDArray[np.integer[Any]]) -> None:
        self._scene = _tensor_geometry.RaycastingScene()
        self._scene.add_triangles(
            _core.Tensor(np.ascontiguousarray(vertices, np.float32)),
            _core.Tensor(np.ascontiguousarray(faces, np.uint32)),
        )
        # The first question builds what answers all; several threads may ask the next ones.
        self.reached(np.zeros(3), np.ones((1, 3)))

    def reached(self, eye: Floats, targets: Floats) -> NDArray[np.bool_]:
        """Whether nothing lies between an eye [3], or one each [N, 3], and targets [N, 3]."""
        if len(targets) == 0:
            return np.zeros(0, np.bool_)
        rays = np.concatenate([np.broadcast_to(eye, targets.shape), targets - eye], axis=1)
        hidden = self._scene.test_occlusions(_core.Tensor(rays.astype(np.float32)), 0.0, 0.999)
        free: NDArray[np.bool_] = ~hidden.numpy()
        return free

    def met(
        self, eye: Floats, ways: Floats
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """What rays from an eye [3], or one each [N, 3], along directions [N, 3] meet first.

        Returns distances [N] in lengths of the directions, infinite where there is nothing, faces
        [N], there 0, and where in the face as barycentric coordinates [N, 3].
        """
        rays = np.concatenate([np.broadcast_to(eye, ways.shape), ways], axis=1)
        found = self._scene.cast_rays(_core.Tensor(rays.astype(np.float32)))
        distance = found["t_hit"].numpy()
        face = np.where(np.isfinite(distance), found["primitive_ids"].numpy(), 0).astype(np.int64)
        u, v = found["primitive_uvs"].numpy().T
        return distance, face, np.stack([1.0 - u - v, u, v], axis=1)
