"""A triangle mesh as Wavefront OBJ with its material and picture, in one zip.

`mesh.obj`, `mesh.mtl`, and `mesh.png` where the mesh is textured; else each vertex carries its
colour behind its position (`v x y z r g b`, sRGB), which MeshLab, Blender and Open3D read. Texture
coordinates of OBJ have their origin at the picture's bottom left. Numbers have nine digits, which
hold a float32, and more where that would blur them.

Corners name place, texture coordinates and normal each by a number of its own. So a place is there
once, though the picture has it once for each chart that meets there: what is one surface stays one
for who prints, smooths or reduces it.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats.archive import entry
from pipelines.exports.frame import Frame, is_far
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, unit_normals

Floats = NDArray[np.float64]

_ROWS = 50_000
_MATERIAL = "newmtl captured\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\n"


def write_mesh(path: Path, mesh: TriangleMesh | TexturedMesh, frame: Frame) -> None:
    """Write the zip with a mesh of the world. frame: of the file."""
    textured = isinstance(mesh, TexturedMesh)
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open(entry("mesh.obj"), "w", force_zip64=True) as file:
            for text in _lines(mesh, frame):
                file.write(text.encode("ascii"))
        material = _MATERIAL + ("map_Kd mesh.png\n" if textured else "")
        archive.writestr(entry("mesh.mtl"), material)
        if isinstance(mesh, TexturedMesh):
            held = io.BytesIO()
            Image.fromarray(mesh.texture).save(held, "PNG")
            archive.writestr(entry("mesh.png", compressed=False), held.getvalue())


def _lines(mesh: TriangleMesh | TexturedMesh, frame: Frame) -> Iterator[str]:
    """The text of `mesh.obj`, in pieces."""
    told = "\n# ".join(frame.lines())
    yield f"# nerfworks: {told}\nmtllib mesh.mtl\no mesh\n"
    positions, faces = frame.of_world(mesh.vertices), mesh.faces
    place = " ".join(["%.15g" if is_far(positions) else "%.9g"] * 3)
    normals, of_normal = _each_once(np.round(frame.of_world(unit_normals(mesh.normals)), 6))
    if isinstance(mesh, TexturedMesh):
        places, of_place = _each_once(positions)
        yield from _rows(f"v {place}\n", places)
        up = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], axis=1)
        yield from _rows("vt %.9g %.9g\n", up)
        corner, named = "%d/%d/%d", (of_place[faces], faces, of_normal[faces])
    else:
        colored = np.concatenate([positions, np.clip(mesh.colors, 0.0, 1.0)], axis=1)
        yield from _rows(f"v {place} %.4f %.4f %.4f\n", colored)
        corner, named = "%d//%d", (faces, of_normal[faces])
    yield from _rows("vn %.6f %.6f %.6f\n", normals)
    yield "usemtl captured\n"
    numbers = np.stack(named, axis=2).astype(np.int64).reshape(len(faces), -1) + 1
    yield from _rows(f"f {corner} {corner} {corner}\n", numbers)


def _each_once(values: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """The different rows of [N, 3], in the order in which they first come; which is each one's."""
    order = np.lexsort(values.T)
    is_new = np.ones(len(order), np.bool_)
    is_new[1:] = (values[order[1:]] != values[order[:-1]]).any(axis=1)
    first = np.sort(order[is_new])  # a stable order: the first of equal ones is the first that came
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(is_new) - 1
    number = np.empty(len(first), np.int64)
    number[group[first]] = np.arange(len(first))
    return values[first], number[group]


def _rows(template: str, values: NDArray[np.float64] | NDArray[np.int64]) -> Iterator[str]:
    """Each row through the template, so many at a time."""
    for start in range(0, len(values), _ROWS):
        yield "".join([template % tuple(row) for row in values[start : start + _ROWS].tolist()])
