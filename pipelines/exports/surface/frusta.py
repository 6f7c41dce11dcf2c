"""The cameras of a capture as a small mesh: a pyramid each, to be looked at beside the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.depth_views import Pinhole

Floats = NDArray[np.float64]

_SHARE_OF_EXTENT = 0.04
_SMALLEST_EXTENT = 1e-6
_TRAINED, _HELD_OUT = (0.13, 0.47, 0.71), (1.0, 0.5, 0.05)
# Vertices: the eye, the picture's corners from the top left clockwise, and the tip that is up.
_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4], [1, 5, 2]], np.int32
)


def camera_frusta(cameras: CamerasFile) -> TriangleMesh:
    """A pyramid from each camera's centre to its picture, without distortion, in the world frame.

    A triangle stands on the upper edge. Blue was trained on, orange held out. The pyramids are 4 %
    of the extent of all centres deep.
    """
    poses = np.asarray([image.world_from_camera for image in cameras.images], np.float64)
    extent = float(np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)))
    depth = _SHARE_OF_EXTENT * (extent if extent > _SMALLEST_EXTENT else 1.0)
    local = np.stack([depth * _corners(cameras, image.camera) for image in cameras.images])
    vertices = np.einsum("nij,nvj->nvi", poses[:, :, :3], local) + poses[:, None, :, 3]
    num, size = vertices.shape[:2]
    colors = [_HELD_OUT if image.split == "test" else _TRAINED for image in cameras.images]
    return TriangleMesh(
        vertices=vertices.reshape(-1, 3),
        faces=(_FACES[None] + size * np.arange(num, dtype=np.int32)[:, None, None]).reshape(-1, 3),
        colors=np.repeat(np.asarray(colors), size, axis=0),
        normals=np.repeat(poses[:, :, 2], size, axis=0),
    )


def _corners(cameras: CamerasFile, index: int) -> Floats:
    """[6, 3] the vertices in camera axes, where the picture is 1 away."""
    lens = cameras.cameras[index]
    shown = Pinhole.of(lens, max(lens.width, lens.height))
    left, right = -shown.cx / shown.fl_x, (shown.width - shown.cx) / shown.fl_x
    top, bottom = shown.cy / shown.fl_y, (shown.cy - shown.height) / shown.fl_y
    tip = top + 0.3 * (top - bottom)
    return np.array(
        [
            [0.0, 0.0, 0.0],
            [left, top, -1.0],
            [right, top, -1.0],
            [right, bottom, -1.0],
            [left, bottom, -1.0],
            [(left + right) / 2.0, tip, -1.0],
        ]
    )
