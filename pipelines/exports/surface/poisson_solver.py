"""Screened Poisson reconstruction, here or in a process of its own.

Open3D can neither tell how far it is nor be stopped, minutes for millions of points. So where they
are many this file is run as a script of numpy and Open3D alone, which can be waited for and killed.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SCALE = 1.1


class _Nothing(ModuleType):
    """A module in which there is whatever is asked for, and nothing of it works."""

    def __getattr__(self, name: str) -> None:
        return None


def solved(given: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """The surface: vertices [V, 3], faces [F, 3], colors [V, 3] in [0, 1].

    given: points [P, 3], normals [P, 3], colors [P, 3] and the width of the finest cells.
    """
    import open3d

    geometry: Any = open3d.geometry
    vector: Any = open3d.utility.Vector3dVector
    cloud = geometry.PointCloud(vector(given["points"]))
    cloud.normals = vector(given["normals"])
    cloud.colors = vector(given["colors"])
    # With several threads its sums have another order in each run, and so has the surface.
    mesh, _ = geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, width=float(given["width"]), scale=_SCALE, n_threads=1
    )
    return {
        "vertices": np.array(mesh.vertices),
        "faces": np.array(mesh.triangles, np.int32),
        "colors": np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0),
    }


def main(read: Path, written: Path) -> None:
    """Read what is given, write the surface."""
    # Open3D's plots are web pages, and importing what serves them takes as long as all the rest.
    sys.modules["dash"] = _Nothing("dash")
    with np.load(read) as given:
        np.savez(written, **solved(given))  # type: ignore[arg-type]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
