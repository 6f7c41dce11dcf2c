"""A triangle mesh as binary glTF 2.0 (`.glb`), with vertex colours and nothing to fetch.

glTF is right-handed with +Y up, our world has +Z up: positions and normals are written turned,
(x, y, z) -> (x, z, -y), since some readers ignore node transforms. `COLOR_0` is linear (glTF 2.0,
section 3.7.2.1), our colours are sRGB: they are converted, into 16-bit so that dark tones keep
their steps. A NeRF's colours contain the light, hence KHR_materials_unlit.

Source: Khronos, glTF 2.0 specification; KHR_materials_unlit.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh

Floats = NDArray[np.float64]

_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
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


def linear_from_srgb(color: Floats) -> Floats:
    """Linear light in [0, 1] from sRGB in [0, 1] (IEC 61966-2-1)."""
    linear: Floats = np.where(
        color <= 0.04045, color / 12.92, ((np.maximum(color, 0.0) + 0.055) / 1.055) ** 2.4
    )
    return linear


def write_mesh(path: Path, mesh: TriangleMesh, generator: str = "nerfworks") -> None:
    """Write a mesh of our world, +Z up; its normals may have any length.

    Raises ValueError for an empty mesh, and where shapes or indices do not fit.
    """
    vertices, faces, colors, normals = mesh.vertices, mesh.faces, mesh.colors, mesh.normals
    if len(vertices) == 0 or len(faces) == 0:
        raise ValueError("glTF cannot hold a mesh without faces")
    if colors.shape != vertices.shape or normals.shape != vertices.shape:
        raise ValueError(
            f"colors {colors.shape} and normals {normals.shape} must be like {vertices.shape}"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("a face names a vertex that does not exist")
    position = _y_up(vertices).astype("<f4")
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    rgba = np.full((len(vertices), 4), 65535, "<u2")
    rgba[:, :3] = np.rint(65535.0 * linear_from_srgb(np.clip(colors, 0.0, 1.0)))
    blobs = [
        position.tobytes(),
        _y_up(unit).astype("<f4").tobytes(),
        rgba.tobytes(),
        faces.astype("<u4").tobytes(),
    ]
    document = _document(position, len(faces), [len(blob) for blob in blobs], generator)
    text = json.dumps(document, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    # Every part is a multiple of 4 bytes by its type, so the views need no padding.
    binary = b"".join(blobs)
    total = 12 + 8 + len(text) + 8 + len(binary)
    if total >= 2**32:
        raise ValueError(f"{total} bytes do not fit in a .glb: simplify the mesh")
    with path.open("wb") as file:
        file.write(struct.pack("<III", _MAGIC, _VERSION, total))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", len(binary), _BIN) + binary)


def _y_up(vectors: Floats) -> Floats:
    """(x, y, z) with +Z up -> (x, z, -y) with +Y up: a turn by -90 degrees about X."""
    return np.stack((vectors[:, 0], vectors[:, 2], -vectors[:, 1]), axis=1)


def _document(
    position: NDArray[np.float32], num_faces: int, sizes: list[int], generator: str
) -> dict[str, Any]:
    """The JSON part. sizes: bytes of positions, normals, colours, indices, in this order."""
    offsets = [sum(sizes[:i]) for i in range(len(sizes))]
    targets = [_ARRAY_BUFFER] * 3 + [_ELEMENT_ARRAY_BUFFER]
    num = len(position)
    return {
        "asset": {"version": "2.0", "generator": generator},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "scene"}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2},
                        "indices": 3,
                        "material": 0,
                        "mode": 4,
                    }
                ]
            }
        ],
        "materials": [_MATERIAL],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": num,
                "type": "VEC3",
                "min": [float(value) for value in position.min(axis=0)],
                "max": [float(value) for value in position.max(axis=0)],
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": num, "type": "VEC3"},
            {
                "bufferView": 2,
                "componentType": _UINT16,
                "normalized": True,
                "count": num,
                "type": "VEC4",
            },
            {"bufferView": 3, "componentType": _UINT32, "count": 3 * num_faces, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target}
            for offset, size, target in zip(offsets, sizes, targets, strict=True)
        ],
        "buffers": [{"byteLength": sum(sizes)}],
    }
