"""A triangle mesh as binary STL: shape alone, as slicers for 3D printing take it.

A file cannot say its unit, and slicers take it for a millimetre: so a mesh in metres may be written
in millimetres.

80 bytes of text, the number of triangles, and of each its normal, its corners and two unused bytes.
The text must not begin with "solid", by which readers know the textual form.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, unit_normals

_HEADER_BYTES = 80
_PER_METRE = 1000.0
_RECORD = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("unused", "<u2")])


def write_mesh(
    path: Path, mesh: TriangleMesh | TexturedMesh, frame: Frame, in_millimetres: bool = False
) -> None:
    """Write a mesh of the world. frame: of the file.

    in_millimetres: a thousand units of the file for one of the frame, which must be a metre: raises
    ValueError where its length is unknown.
    """
    note = frame.note()
    places = frame.of_world(mesh.vertices)
    if in_millimetres:
        if not frame.metric:
            raise ValueError("millimetres are known of a frame in metres alone")
        places, note = _PER_METRE * places, note.replace("1 metre", "1 mm")
    corners = places[mesh.faces]
    records = np.zeros(len(mesh.faces), _RECORD)
    records["corners"] = corners
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    records["normal"] = unit_normals(np.cross(*sides))
    header = f"nerfworks {note}".encode("ascii")[:_HEADER_BYTES]
    with path.open("wb") as file:
        file.write(header.ljust(_HEADER_BYTES, b"\0") + struct.pack("<I", len(records)))
        file.write(records.tobytes())
