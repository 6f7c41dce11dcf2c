"""The files by which a job's later stages know its mesh and its cloud, whatever people asked for.

The assessment and `meshvideo` read back what is delivered. Where its formats are others than those
they read, the export leaves the same content beside them, in a file that is no artifact.
"""

from __future__ import annotations

from pathlib import Path

MESH, JUDGED_MESH = "mesh.glb", "judged.glb"
CLOUD, JUDGED_CLOUD = "pointcloud.ply", "judged.ply"


def mesh_of(folder: Path) -> Path:
    """The GLB of a mesh's folder; one that is not there where the folder has none."""
    return _first(folder / MESH, folder / JUDGED_MESH)


def cloud_of(folder: Path) -> Path:
    """The PLY of a point cloud's folder."""
    return _first(folder / CLOUD, folder / JUDGED_CLOUD)


def _first(delivered: Path, judged: Path) -> Path:
    return delivered if delivered.is_file() or not judged.is_file() else judged
