"""Screened Poisson reconstruction in a process of its own: a script of numpy and Open3D alone.

Open3D can neither tell how far it is nor be stopped, minutes for millions of points.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

_SCALE = 1.1


class _Nothing(ModuleType):
    """A module in which there is whatever is asked for, and nothing of it works."""

    def __getattr__(self, name: str) -> None:
        return None


def main(read: Path, written: Path) -> None:
    """Read points [P, 3], normals [P, 3], colors [P, 3] and the width of the finest cells; write
    the surface."""
    # Open3D's plots are web pages, and importing what serves them takes as long as all the rest.
    sys.modules["dash"] = _Nothing("dash")
    import open3d

    geometry: Any = open3d.geometry
    vector: Any = open3d.utility.Vector3dVector
    with np.load(read) as given:
        cloud = geometry.PointCloud(vector(given["points"]))
        cloud.normals = vector(given["normals"])
        cloud.colors = vector(given["colors"])
        width = float(given["width"])
    # With several threads its sums have another order in each run, and so has the surface.
    mesh, _ = geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, width=width, scale=_SCALE, n_threads=1
    )
    np.savez(
        written,
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.triangles, np.int32),
        colors=np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0),
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
