"""A triangle mesh as Wavefront OBJ with its material and picture, in one zip.

`mesh.obj`, `mesh.mtl`, and `mesh.png` where the mesh is textured; else each vertex carries its
colour behind its position (`v x y z r g b`, sRGB), which MeshLab, Blender and Open3D read. Texture
coordinates of OBJ have their origin at the picture's bottom left. Places are told to a
hundred-millionth of their extent, also in map coordinates.

OBJ has no word for what is up. Blender, Unity and viewers take +Y for it, so that is the default of
who asks for a mesh (`MeshOptions.up_in`); the first line tells which it is.

Corners name place, texture coordinates and normal each by a number of its own. So a place is there
once, though the picture has it once for each chart that meets there: what is one surface stays one
for who prints, smooths or reduces it.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats.archive import entry
from pipelines.exports.formats.numbers import Numbers, position_decimals, rows
from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, unit_normals

Floats = NDArray[np.float64]

_NORMAL_DECIMALS, _COLOR_DECIMALS, _UV_DECIMALS = 6, 4, 9
_TEXT_SHARE = 0.8
_QUICK = 3
"""zlib's level of the picture: larger by a tenth, and made in half the time, than the default."""
_MATERIAL = "newmtl captured\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\n"


def write_mesh(
    path: Path,
    mesh: TriangleMesh | TexturedMesh,
    frame: Frame,
    on_progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Write the zip with a mesh of the world. frame: of the file.

    on_progress: told the share that is written; may raise.
    """
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open(entry("mesh.obj"), "w", force_zip64=True) as file:
            for text in _lines(mesh, frame, lambda done: on_progress(_TEXT_SHARE * done)):
                file.write(text)
        material = _MATERIAL
        if isinstance(mesh, TexturedMesh):
            material += "map_Kd mesh.png\n"
            held = io.BytesIO()
            Image.fromarray(mesh.texture).save(held, "PNG", compress_level=_QUICK)
            archive.writestr(entry("mesh.png", compressed=False), held.getvalue())
        archive.writestr(entry("mesh.mtl"), material)
    on_progress(1.0)


def _lines(
    mesh: TriangleMesh | TexturedMesh, frame: Frame, on_progress: Callable[[float], None]
) -> Iterator[bytes]:
    """The text of `mesh.obj`, in pieces."""
    told = "\n# ".join(frame.lines())
    yield f"# nerfworks: {told}\nmtllib mesh.mtl\no mesh\n".encode("ascii")
    blocks = _blocks(mesh, frame)
    total, written = sum(len(block.columns[0]) for block in blocks), 0
    for block in blocks:
        if block.before:
            yield block.before
        count = len(block.columns[0])
        tell = _share_of(on_progress, written, count, total)
        yield from rows(block.line, block.columns, block.decimals, tell)
        written += count


def _share_of(
    on_progress: Callable[[float], None], before: int, count: int, total: int
) -> Callable[[float], None]:
    """What reports the progress of some rows as one of all."""
    return lambda done: on_progress((before + done * count) / total)


@dataclass(frozen=True)
class _Block:
    """Rows of one kind. line, columns, decimals: as `rows` takes them. before: a line before."""

    line: str
    columns: Sequence[Numbers]
    decimals: Sequence[int]
    before: bytes = b""


def _blocks(mesh: TriangleMesh | TexturedMesh, frame: Frame) -> list[_Block]:
    """Places, texture coordinates, normals, faces."""
    positions, faces = frame.of_world(mesh.vertices), mesh.faces
    exact = [position_decimals(positions)] * 3
    named: list[NDArray[np.signedinteger[Any]]]
    unit = np.round(frame.of_world(unit_normals(mesh.normals)), _NORMAL_DECIMALS)
    normals, of_normal = _each_once(unit)
    if isinstance(mesh, TexturedMesh):
        places, of_place = _each_once(positions)
        up = [mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]]
        blocks = [
            _Block("v {} {} {}\n", list(places.T), exact),
            _Block("vt {} {}\n", up, [_UV_DECIMALS] * 2),
        ]
        corner, named = "{}/{}/{}", [of_place[faces], faces, of_normal[faces]]
    else:
        colors = np.clip(mesh.colors, 0.0, 1.0)
        columns, decimals = [*positions.T, *colors.T], [*exact, *[_COLOR_DECIMALS] * 3]
        blocks = [_Block("v {} {} {} {} {} {}\n", columns, decimals)]
        corner, named = "{}//{}", [faces, of_normal[faces]]
    blocks.append(_Block("vn {} {} {}\n", list(normals.T), [_NORMAL_DECIMALS] * 3))
    numbers = [of[:, at] + 1 for at in range(3) for of in named]
    whole = [0] * len(numbers)
    line = f"f {corner} {corner} {corner}\n"
    return [*blocks, _Block(line, numbers, whole, b"usemtl captured\n")]


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
