"""A triangle mesh as binary glTF 2.0 (`.glb`), with a texture or vertex colours, nothing to fetch.

glTF is right-handed with +Y up, our world has +Z up: positions and normals are written turned
(`pipelines.exports.frame`), since some readers ignore node transforms. Only where 32 bits would
blur them, as in map coordinates, the node's translation has what is common to all. `COLOR_0` is
linear (glTF 2.0, section 3.7.2.1), our colours are sRGB: they are converted, into 16-bit so that
dark tones keep their steps. A texture is a JPEG or a KTX2, both sRGB as base colours are, and lies
in the file. A capture's colours contain the light, hence KHR_materials_unlit.

Source: Khronos, glTF 2.0 specification; KHR_materials_unlit, KHR_mesh_quantization,
KHR_texture_basisu, EXT_meshopt_compression.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats import ktx2, meshopt
from pipelines.exports.formats.srgb import linear_from_srgb, srgb_from_linear
from pipelines.exports.frame import FROM_WORLD, Frame, back_to_world, is_far
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, unit_normals

Floats = NDArray[np.float64]
Texture = Literal["jpeg", "ktx2"]

_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32, _UINT16, _INT8 = 5126, 5125, 5123, 5120
_STEPS = 65535.0
_QUANTIZATION = "KHR_mesh_quantization"
_COMPRESSION = "EXT_meshopt_compression"
_KTX2 = "KHR_texture_basisu"
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071
_JPEG_QUALITY = 92
_MATERIAL: dict[str, Any] = {
    "name": "captured",
    "doubleSided": True,
    "pbrMetallicRoughness": {
        "baseColorFactor": [1.0, 1.0, 1.0, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0,
    },
    "extensions": {"KHR_materials_unlit": {}},
}


@dataclass(frozen=True)
class _Accessor:
    """One array of the file. name: of the attribute, "" for indices. padded: whether its rows end
    in one value that fills them up to 4 bytes and does not count."""

    name: str
    values: NDArray[Any]
    kind: str
    component: int
    normalized: bool = False
    padded: bool = False

    @property
    def stride(self) -> int:
        """Bytes of a row."""
        return self.values.strides[0] if self.name else self.values.itemsize

    def compressed(self) -> bytes:
        """Its content as the second buffer has it in the first one."""
        if not self.name:
            return meshopt.encode_indices(self.values.ravel())
        rows = np.ascontiguousarray(self.values).view(np.uint8)
        return meshopt.encode_attributes(rows.reshape(len(self.values), self.stride))

    def compressed_view(self, offset: int, at: int, length: int) -> dict[str, Any]:
        """Its buffer view, where `length` bytes of the file at `at` stand for those at `offset`."""
        plain = self.view(offset) | {"buffer": 1}
        if self.name:
            plain["byteStride"] = self.stride
        stored = {
            "buffer": 0,
            "byteOffset": at,
            "byteLength": length,
            "byteStride": self.stride,
            "count": self.values.nbytes // self.stride,
            "mode": "ATTRIBUTES" if self.name else "INDICES",
        }
        return plain | {"extensions": {_COMPRESSION: stored}}

    def view(self, offset: int) -> dict[str, Any]:
        """Its buffer view."""
        plain: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": offset,
            "byteLength": self.values.nbytes,
            "target": _ARRAY_BUFFER if self.name else _ELEMENT_ARRAY_BUFFER,
        }
        if self.padded:
            plain["byteStride"] = self.values.strides[0]
        return plain

    def as_dict(self, view: int) -> dict[str, Any]:
        """The accessor of the buffer view of the same number."""
        plain: dict[str, Any] = {
            "bufferView": view,
            "componentType": self.component,
            "count": self.values.size if self.kind == "SCALAR" else len(self.values),
            "type": self.kind,
        }
        if self.normalized:
            plain["normalized"] = True
        if self.name == "POSITION":
            counted = self.values[:, :3]
            plain["min"] = [number.item() for number in counted.min(axis=0)]
            plain["max"] = [number.item() for number in counted.max(axis=0)]
        return plain


@dataclass(frozen=True)
class GlbStyle:
    """unlit: colours as they are, which hold the light of the capture; else a rough surface that
    the viewer's lamps light. quantized: places in 65535 steps of the longest side and half the
    bytes a vertex (`KHR_mesh_quantization`), for viewers that know it. compressed: so, and what is
    left in half the bytes once more (`EXT_meshopt_compression`), for those that can read that.
    texture: as what the picture lies in the file, ktx2 for viewers that know `KHR_texture_basisu`.
    """

    unlit: bool = True
    quantized: bool = False
    compressed: bool = False
    texture: Texture = "jpeg"

    @property
    def in_steps(self) -> bool:
        """Whether places are whole numbers."""
        return self.quantized or self.compressed

    def extensions(self, textured: bool) -> list[str]:
        """What a reader must know to show anything."""
        of_shape = [_QUANTIZATION] * self.in_steps + [_COMPRESSION] * self.compressed
        return of_shape + [_KTX2] * (textured and self.texture == "ktx2")

    def picture(self, texture: NDArray[np.uint8], on_progress: Callable[[float], None]) -> bytes:
        """The texture [H, W, 3] as the file has it. Raises ValueError for sides that cannot be.

        on_progress: as of `write_mesh`.
        """
        return ktx2.encode(texture, on_progress) if self.texture == "ktx2" else jpeg(texture)


def write_mesh(
    path: Path,
    mesh: TriangleMesh | TexturedMesh,
    frame: Frame = Frame(),
    style: GlbStyle = GlbStyle(),
    on_progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Write a mesh of our world, +Z up; its normals may have any length.

    frame: where the mesh lies, and whether a unit is a metre, as glTF would have it;
    `asset.extras.frame` says it, and `from_world` beside it how it came there, if it was moved.
    on_progress: told the share of a KTX2 that is done, which takes seconds; may raise, and then
    there is no file.
    Raises ValueError for an empty mesh, where shapes or indices do not fit, and for a texture that
    the style's kind cannot hold.
    """
    vertices, faces, normals = mesh.vertices, mesh.faces, mesh.normals
    if len(vertices) == 0 or len(faces) == 0:
        raise ValueError("glTF cannot hold a mesh without faces")
    if normals.shape != vertices.shape:
        raise ValueError(f"normals {normals.shape} must be like {vertices.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("a face names a vertex that does not exist")
    frame = frame.y_up()
    places, directions = frame.of_world(vertices), frame.of_world(unit_normals(normals))
    node: dict[str, Any] = {"mesh": 0, "name": "scene"}
    if style.in_steps:
        low, size = places.min(axis=0), max(float(np.ptp(places, axis=0).max()), 1e-12)
        node |= {"translation": low.tolist(), "scale": [size] * 3}
        shape = [
            _steps("POSITION", np.rint((places - low) * (_STEPS / size)), "<u2", _UINT16),
            _steps("NORMAL", np.rint(127.0 * directions), "<i1", _INT8),
        ]
    else:
        if is_far(places):
            middle = np.round(places.mean(axis=0))
            places = places - middle
            node["translation"] = middle.tolist()
        shape = [
            _Accessor("POSITION", places.astype("<f4"), "VEC3", _FLOAT),
            _Accessor("NORMAL", directions.astype("<f4"), "VEC3", _FLOAT),
        ]
    accessors = [
        *shape,
        _colored(mesh, style.in_steps),
        _Accessor("", faces.astype("<u4"), "SCALAR", _UINT32),
    ]
    picture = b""
    if isinstance(mesh, TexturedMesh):
        picture = style.picture(mesh.texture, on_progress)
    # Arrays are multiples of 4 bytes by their types, or made so; the picture comes last.
    arrays = [
        accessor.compressed() if style.compressed else accessor.values.tobytes()
        for accessor in accessors
    ]
    blobs = [array + b"\0" * (-len(array) % 4) for array in arrays] + [picture] * bool(picture)
    lengths = [len(array) for array in arrays]
    document = _document(accessors, lengths, len(picture), frame, node, style)
    text = json.dumps(document, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    binary = b"".join(blobs)
    binary += b"\0" * (-len(binary) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    if total >= 2**32:
        raise ValueError(f"{total} bytes do not fit in a .glb: simplify the mesh")
    with path.open("wb") as file:
        file.write(struct.pack("<III", _MAGIC, _VERSION, total))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", len(binary), _BIN) + binary)


def read_mesh(path: Path) -> TriangleMesh | TexturedMesh:
    """Read back what `write_mesh` wrote, whatever its frame, into the world of cameras.json.

    Raises ValueError for another file.
    """
    document, binary = _parts(path)
    try:
        views = [_content(view, binary) for view in document["bufferViews"]]
        (primitive,) = document["meshes"][0]["primitives"]
        at = primitive["attributes"]
        kinds = [accessor["componentType"] for accessor in document["accessors"]]
        placed, turned = (
            _three(views[at[name]], kinds[at[name]]) for name in ("POSITION", "NORMAL")
        )
        (node,) = document["nodes"]
        placed = placed * node.get("scale", 1.0) + node.get("translation", 0.0)
        position, normal = _in_world(document, placed, unit_normals(turned))
        faces = np.frombuffer(views[primitive["indices"]], "<u4").reshape(-1, 3).astype(np.int32)
        if "images" not in document:
            rgba = np.frombuffer(views[at["COLOR_0"]], "<u2").reshape(-1, 4)
            return TriangleMesh(position, faces, srgb_from_linear(rgba[:, :3] / 65535.0), normal)
        in_steps = kinds[at["TEXCOORD_0"]] == _UINT16
        flat = np.frombuffer(views[at["TEXCOORD_0"]], "<u2" if in_steps else "<f4")
        uv = flat.reshape(-1, 2).astype(np.float64) / (_STEPS if in_steps else 1.0)
        (image,) = document["images"]
        texture = _picture(views[image["bufferView"]], image["mimeType"])
    except (KeyError, IndexError, TypeError, OSError, ValueError) as error:
        raise ValueError(f"{path.name} is no mesh of ours: {error}") from error
    return TexturedMesh(position, faces, normal, uv, texture)


def _picture(data: memoryview, kind: str) -> NDArray[np.uint8]:
    """The texture [H, W, 3] of a file. kind: its MIME type."""
    if kind == "image/ktx2":
        return ktx2.decode(data)
    with Image.open(io.BytesIO(data)) as opened:
        return np.asarray(opened.convert("RGB"))


def _content(view: dict[str, Any], binary: memoryview) -> memoryview:
    """The bytes of a buffer view."""
    stored = view.get("extensions", {}).get(_COMPRESSION)
    at = stored or view
    data = binary[at["byteOffset"] : at["byteOffset"] + at["byteLength"]]
    if stored is None:
        return data
    if stored["mode"] == "INDICES":
        whole = meshopt.decode_indices(data, stored["count"]).astype("<u4").tobytes()
    else:
        whole = meshopt.decode_attributes(data, stored["count"], stored["byteStride"]).tobytes()
    return memoryview(whole)


def _in_world(
    document: dict[str, Any], places: Floats, directions: Floats
) -> tuple[Floats, Floats]:
    """Positions and unit directions [V, 3] of a file in the world of cameras.json."""
    rows = document["asset"].get("extras", {}).get(FROM_WORLD)
    if rows is None:
        plain = Frame("y")
        return plain.to_world(places), plain.to_world(directions)
    matrix = np.asarray(rows, np.float64).reshape(3, 4)
    # Turned back by the transpose, to which a similarity's inverse is proportional.
    return back_to_world(places, matrix), unit_normals(directions @ matrix[:, :3])


def _steps(name: str, values: Floats, kind: str, component: int) -> _Accessor:
    """Whole numbers [V, 3] as an array with a fourth one, so that rows are multiples of 4 bytes."""
    padded = np.zeros((len(values), 4), kind)
    padded[:, :3] = values
    return _Accessor(name, padded, "VEC3", component, normalized=True, padded=True)


def _three(view: memoryview, component: int) -> Floats:
    """[V, 3] of what `write_mesh` wrote in a buffer view, as glTF decodes it."""
    if component == _FLOAT:
        return np.frombuffer(view, "<f4").reshape(-1, 3).astype(np.float64)
    kind, most = ("<u2", _STEPS) if component == _UINT16 else ("<i1", 127.0)
    padded = np.frombuffer(view, kind).reshape(-1, 4)
    values: Floats = np.maximum(padded[:, :3] / most, -1.0)
    return values


def _parts(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The JSON and the binary part. Raises ValueError for what is no binary glTF 2.0."""
    data = path.read_bytes()
    try:
        magic, version, _, length, _ = struct.unpack_from("<IIIII", data)
        if (magic, version) != (_MAGIC, _VERSION):
            raise ValueError("its first bytes are others")
        document: dict[str, Any] = json.loads(data[20 : 20 + length])
    except (struct.error, ValueError) as error:
        raise ValueError(f"{path.name} is no binary glTF 2.0: {error}") from error
    return document, memoryview(data)[28 + length :]


def _colored(mesh: TriangleMesh | TexturedMesh, quantized: bool) -> _Accessor:
    """What gives a vertex its colour."""
    count = len(mesh.vertices)
    if isinstance(mesh, TexturedMesh):
        if mesh.uv.shape != (count, 2):
            raise ValueError(f"uv {mesh.uv.shape} must be ({count}, 2)")
        if quantized:
            steps = np.rint(_STEPS * np.clip(mesh.uv, 0.0, 1.0)).astype("<u2")
            return _Accessor("TEXCOORD_0", steps, "VEC2", _UINT16, normalized=True)
        return _Accessor("TEXCOORD_0", mesh.uv.astype("<f4"), "VEC2", _FLOAT)
    if mesh.colors.shape != mesh.vertices.shape:
        raise ValueError(f"colors {mesh.colors.shape} must be like {mesh.vertices.shape}")
    rgba = np.full((count, 4), 65535, "<u2")
    rgba[:, :3] = np.rint(65535.0 * linear_from_srgb(np.clip(mesh.colors, 0.0, 1.0)))
    return _Accessor("COLOR_0", rgba, "VEC4", _UINT16, normalized=True)


def jpeg(texture: NDArray[np.uint8]) -> bytes:
    """The picture as a JPEG with all of its colour resolution."""
    held = io.BytesIO()
    Image.fromarray(texture).save(held, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return held.getvalue()


def _document(
    accessors: list[_Accessor],
    lengths: list[int],
    picture_bytes: int,
    frame: Frame,
    node: dict[str, Any],
    style: GlbStyle,
) -> dict[str, Any]:
    """The JSON part. lengths: of the arrays in the file, which come one after the other, each from
    a multiple of 4. picture_bytes: of the texture behind all arrays, 0 for none."""
    views: list[dict[str, Any]] = []
    total = whole = 0
    for accessor, length in zip(accessors, lengths, strict=True):
        views.append(
            accessor.compressed_view(whole, total, length)
            if style.compressed
            else accessor.view(total)
        )
        whole += accessor.values.nbytes
        total += length + -length % 4
    if picture_bytes:
        views.append({"buffer": 0, "byteOffset": total, "byteLength": picture_bytes})
        total += picture_bytes
    names = [accessor.name for accessor in accessors]
    material = {
        key: value for key, value in _MATERIAL.items() if style.unlit or key != "extensions"
    }
    required = style.extensions(picture_bytes > 0)
    used = ["KHR_materials_unlit"] * style.unlit + required
    # What stands for the arrays as they are unpacked: it is nowhere, and has a length.
    unpacked = {"byteLength": whole, "extensions": {_COMPRESSION: {"fallback": True}}}
    extras: dict[str, Any] = {"frame": frame.note()}
    if (matrix := frame.matrix()) is not None:
        extras[FROM_WORLD] = matrix.tolist()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "nerfworks", "extras": extras},
        **({"extensionsUsed": used} if used else {}),
        **({"extensionsRequired": required} if required else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {name: i for i, name in enumerate(names) if name},
                        "indices": names.index(""),
                        "material": 0,
                        "mode": 4,
                    }
                ]
            }
        ],
        "accessors": [accessor.as_dict(view) for view, accessor in enumerate(accessors)],
        "bufferViews": views,
        "buffers": [{"byteLength": total + -total % 4}, *[unpacked] * style.compressed],
    }
    if picture_bytes:
        base = {**_MATERIAL["pbrMetallicRoughness"], "baseColorTexture": {"index": 0}}
        material["pbrMetallicRoughness"] = base
        wraps = {"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}
        document["images"] = [{"bufferView": len(accessors), "mimeType": f"image/{style.texture}"}]
        document["samplers"] = [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, **wraps}]
        source: dict[str, Any] = {"source": 0}
        if style.texture == "ktx2":
            source = {"extensions": {_KTX2: source}}
        document["textures"] = [{"sampler": 0, **source}]
    document["materials"] = [material]
    return document
