"""The surface of a job's mesh as the point cloud reads it: `surface.npz`, no artifact.

Whole, in the world of cameras.json and with all its triangles, whatever part of it, how many and in
which frame and formats people asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.shells import Shell

Floats = NDArray[np.floating[Any]]

SURFACE = "surface.npz"


@dataclass(frozen=True)
class KeptSurface:
    """origin: [3] world. vertices: [V, 3] from there. faces: [F, 3] int32, counter-clockwise from
    outside. voxel: [V], world units, of the shell that each vertex lies in.
    """

    origin: Floats
    vertices: Floats
    faces: NDArray[np.int32]
    voxel: Floats


def save_surface(folder: Path, mesh: TriangleMesh, shells: Sequence[Shell]) -> None:
    """Leave a mesh with at least one vertex in a folder. shells: that it was made in, innermost
    first.
    """
    voxel = np.full(len(mesh.vertices), shells[-1].voxel)
    for shell in reversed(shells):
        voxel[shell.bounds.contains(mesh.vertices)] = shell.voxel
    origin = mesh.vertices.mean(axis=0)
    np.savez(
        folder / SURFACE,
        origin=origin,
        vertices=(mesh.vertices - origin).astype(np.float32),
        faces=mesh.faces.astype(np.int32),
        voxel=voxel.astype(np.float32),
    )


def load_surface(folder: Path) -> KeptSurface | None:
    """The surface of a mesh's folder; None where there is none, as the mesh was not made yet, or
    by a version that kept none.
    """
    path = folder / SURFACE
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as stored:
        return KeptSurface(**{name: stored[name] for name in stored.files})
