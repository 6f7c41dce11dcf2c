"""PLY files: point clouds and triangle meshes with colours and normals, binary little endian.

Symbols: V vertices, F triangles. Positions are float32, or float64 where that would blur them, as
in map coordinates; their axes are told in a comment, colours are sRGB uint8, normals are unit
vectors. The reader understands what the writers here write and what common programs write: any
scalar types, further properties (skipped), polygons (split into fans), binary little endian.

Format: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from pipelines.exports.frame import Frame, is_far, matrix_of
from pipelines.exports.mesh import TriangleMesh

FloatArray = npt.NDArray[np.floating[Any]]
ByteArray = npt.NDArray[np.uint8]
IndexArray = npt.NDArray[np.integer[Any]]

_SCALARS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
_WRITTEN = {1: "uchar", 4: "float", 8: "double"}
_MAX_HEADER_LINES = 1000
_WORLD = Frame()


@dataclass(frozen=True)
class Ply:
    """The contents of a file.

    points: [V, 3] float32, float64 where the file has it so and tells from_world. colors: [V, 3]
    uint8 or None. normals: [V, 3] float32 or None. faces: [F, 3] int32, indices into `points`; F is
    0 for a point cloud. from_world: [3, 4], how the world of cameras.json came into these
    coordinates; None where the file tells no such thing.
    """

    points: FloatArray
    colors: ByteArray | None
    normals: npt.NDArray[np.float32] | None
    faces: npt.NDArray[np.int32]
    from_world: npt.NDArray[np.float64] | None = None


def write_points(
    path: Path,
    points: FloatArray,
    colors: ByteArray | None = None,
    normals: FloatArray | None = None,
    frame: Frame = _WORLD,
) -> None:
    """Write a point cloud.

    points: [V, 3] world. colors: [V, 3] uint8, sRGB. normals: [V, 3], unit. frame: of the file.
    Raises ValueError for shapes or types that do not fit.
    """
    vertices = _vertex_records(points, colors, normals, frame)
    with path.open("wb") as file:
        file.write(_header(vertices, None, frame))
        file.write(vertices.tobytes())


def write_mesh(path: Path, mesh: TriangleMesh, frame: Frame = _WORLD) -> None:
    """Write a triangle mesh of the world. frame: of the file.

    Raises ValueError for shapes, types or indices that do not fit.
    """
    colors = np.rint(255.0 * np.clip(mesh.colors, 0.0, 1.0)).astype(np.uint8)
    records, faces = _vertex_records(mesh.vertices, colors, mesh.normals, frame), mesh.faces
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must be [F, 3], not {list(faces.shape)}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(records)):
        raise ValueError(
            f"faces index vertices {faces.min()} to {faces.max()}, there are {len(records)}"
        )
    triangles = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", (3,))])
    triangles["count"] = 3
    triangles["index"] = faces
    with path.open("wb") as file:
        file.write(_header(records, len(faces), frame))
        file.write(records.tobytes())
        file.write(triangles.tobytes())


def read_ply(path: Path) -> Ply:
    """Read a point cloud or mesh. Raises ValueError naming what is wrong with the file."""
    with path.open("rb") as file:
        elements, comments = _read_header(file, path.name)
        matrix = next((found for line in comments if (found := matrix_of(line)) is not None), None)
        points: FloatArray | None = None
        colors: ByteArray | None = None
        normals: npt.NDArray[np.float32] | None = None
        faces = np.zeros((0, 3), np.int32)
        for element in elements:
            if element.name == "face":
                faces = _read_faces(file, element, path.name)
                continue
            records = _read_records(file, element, path.name)
            if element.name == "vertex":
                exact = matrix is not None and records.dtype["x"] == np.float64
                points = _columns(records, ("x", "y", "z"), np.float64 if exact else np.float32)
                colors = _columns(records, ("red", "green", "blue"), np.uint8)
                normals = _columns(records, ("nx", "ny", "nz"), np.float32)
    if points is None:
        raise ValueError(f"{path.name}: no vertex positions")
    if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
        raise ValueError(f"{path.name}: a face names a vertex that does not exist")
    return Ply(points, colors, normals, faces, from_world=matrix)


def _vertex_records(
    points: FloatArray, colors: ByteArray | None, normals: FloatArray | None, frame: Frame
) -> npt.NDArray[np.void]:
    """The vertices as packed records, checked."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must be [V, 3], not {list(points.shape)}")
    places = frame.of_world(points.astype(np.float64, copy=False))
    exact = "<f8" if is_far(places) else "<f4"
    fields: list[tuple[str, str]] = [(name, exact) for name in ("x", "y", "z")]
    parts: list[npt.NDArray[Any]] = [places]
    if normals is not None:
        if normals.shape != points.shape:
            raise ValueError(f"normals are {list(normals.shape)}, points {list(points.shape)}")
        fields += [(name, "<f4") for name in ("nx", "ny", "nz")]
        parts.append(frame.of_world(normals.astype(np.float64, copy=False)))
    if colors is not None:
        if colors.shape != points.shape or colors.dtype != np.uint8:
            raise ValueError(f"colors must be uint8 {list(points.shape)}, not {colors.dtype}")
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        parts.append(colors)
    records = np.empty(len(points), dtype=fields)
    columns = [part[:, axis] for part in parts for axis in range(3)]
    for (name, _), column in zip(fields, columns, strict=True):
        records[name] = column
    return records


def _header(vertices: npt.NDArray[np.void], num_faces: int | None, frame: Frame) -> bytes:
    """The text before the records; without faces where `num_faces` is None."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for line in frame.lines()]
    lines.append(f"element vertex {len(vertices)}")
    for name in vertices.dtype.names or ():
        lines.append(f"property {_WRITTEN[vertices.dtype[name].itemsize]} {name}")
    if num_faces is not None:
        lines += [f"element face {num_faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


@dataclass(frozen=True)
class _Property:
    """One property; `count_dtype` is set for lists."""

    name: str
    dtype: str
    count_dtype: str | None = None


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]


def _read_header(file: BinaryIO, name: str) -> tuple[list[_Element], list[str]]:
    """Read up to and with end_header: elements and comments.

    Raises ValueError for what is no binary PLY.
    """
    if file.readline().strip() != b"ply":
        raise ValueError(f"{name}: not a PLY file")
    elements: list[_Element] = []
    comments: list[str] = []
    for _ in range(_MAX_HEADER_LINES):
        words = file.readline(4096).decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                return elements, comments
            case ["format", encoding, *_]:
                if encoding != "binary_little_endian":
                    raise ValueError(f"{name}: {encoding} is not read, only binary_little_endian")
            case ["element", element, count] if count.isdigit():
                elements.append(_Element(element, int(count), []))
            case ["property", "list", count_type, item_type, prop] if elements:
                elements[-1].properties.append(
                    _Property(prop, _scalar(item_type, name), _scalar(count_type, name))
                )
            case ["property", kind, prop] if elements:
                elements[-1].properties.append(_Property(prop, _scalar(kind, name)))
            case ["comment" | "obj_info", *said]:
                comments.append(" ".join(said))
            case _:
                raise ValueError(f"{name}: bad header line {' '.join(words)!r}")
    raise ValueError(f"{name}: the header does not end")


def _scalar(kind: str, name: str) -> str:
    if kind not in _SCALARS:
        raise ValueError(f"{name}: unknown property type {kind!r}")
    return _SCALARS[kind]


def _take(file: BinaryIO, num_bytes: int, name: str) -> bytes:
    data = file.read(num_bytes)
    if len(data) != num_bytes:
        raise ValueError(f"{name}: the file is cut short")
    return data


def _read_records(file: BinaryIO, element: _Element, name: str) -> npt.NDArray[np.void]:
    """The records of an element without lists."""
    if any(prop.count_dtype for prop in element.properties):
        raise ValueError(f"{name}: lists in element {element.name!r} are not read")
    dtype = np.dtype([(prop.name, prop.dtype) for prop in element.properties])
    data = _take(file, dtype.itemsize * element.count, name)
    records: npt.NDArray[np.void] = np.frombuffer(data, dtype=dtype, count=element.count)
    return records


def _read_faces(file: BinaryIO, element: _Element, name: str) -> npt.NDArray[np.int32]:
    """The index lists of the faces as triangles [F, 3]."""
    if not any(prop.name in ("vertex_indices", "vertex_index") for prop in element.properties):
        raise ValueError(f"{name}: faces without vertex_indices")
    if element.count == 0:
        return np.zeros((0, 3), np.int32)
    start = file.tell()
    triangles = _read_uniform_triangles(file, element)
    if triangles is not None:
        return triangles
    file.seek(start)
    made: list[Sequence[int]] = []
    for _ in range(element.count):
        for prop in element.properties:
            dtype = np.dtype(prop.dtype)
            count = 1
            if prop.count_dtype:
                count_dtype = np.dtype(prop.count_dtype)
                raw = _take(file, count_dtype.itemsize, name)
                count = int(np.frombuffer(raw, count_dtype)[0])
            values = np.frombuffer(_take(file, dtype.itemsize * count, name), dtype)
            if prop.name in ("vertex_indices", "vertex_index"):
                corners = values.tolist()
                made += [(corners[0], corners[i], corners[i + 1]) for i in range(1, count - 1)]
    return np.asarray(made, np.int32).reshape(-1, 3)


def _read_uniform_triangles(file: BinaryIO, element: _Element) -> npt.NDArray[np.int32] | None:
    """All faces at once where every list has three items; None where that does not hold."""
    fields: list[Any] = []
    counts: list[str] = []
    for prop in element.properties:
        if prop.count_dtype:
            counts.append(f"{prop.name}/count")
            fields += [(counts[-1], prop.count_dtype), (prop.name, prop.dtype, (3,))]
        else:
            fields.append((prop.name, prop.dtype))
    dtype = np.dtype(fields)
    data = file.read(dtype.itemsize * element.count)
    if len(data) != dtype.itemsize * element.count:
        return None
    records = np.frombuffer(data, dtype=dtype)
    if any((records[count] != 3).any() for count in counts):
        return None
    key = "vertex_indices" if "vertex_indices" in (dtype.names or ()) else "vertex_index"
    return np.ascontiguousarray(records[key].astype(np.int32))


def _columns(
    records: npt.NDArray[np.void], names: tuple[str, ...], dtype: type[Any]
) -> npt.NDArray[Any] | None:
    """The named properties as [V, len(names)], or None where one is missing."""
    if not set(names) <= set(records.dtype.names or ()):
        return None
    return np.stack([records[name] for name in names], axis=1).astype(dtype)
