"""What a report says of how a mesh is coloured."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.exports.mesh import Floats, TexturedMesh, TriangleMesh


def skin_told(skin: TriangleMesh | TexturedMesh) -> dict[str, Any]:
    """Of a delivered mesh: how many faces, how large its picture is, and how fine.

    texture_px: the longer side of its picture. texture_size_px: width and height. texture_filled:
    the share of it that is on faces. texels_per_unit: texels along one unit of the world on the
    middle one of the faces.
    """
    if not isinstance(skin, TexturedMesh):
        return {
            "texture_px": None,
            "texture_size_px": None,
            "texture_filled": None,
            "texels_per_unit": None,
            "num_faces": len(skin.faces),
        }
    height, width = skin.texture.shape[:2]
    flat = _twice_area(np.pad(skin.uv * (width, height), ((0, 0), (0, 1)))[skin.faces])
    density = np.sqrt(flat / np.maximum(_twice_area(skin.vertices[skin.faces]), 1e-300))
    return {
        "texture_px": max(width, height),
        "texture_size_px": [width, height],
        "texture_filled": round(float(flat.sum()) / 2.0 / (width * height), 4),
        "texels_per_unit": round(float(np.median(density)), 3),
        "num_faces": len(skin.faces),
    }


def _twice_area(corners: Floats) -> Floats:
    """Of triangles [F, 3, 3]: [F]."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area: Floats = np.linalg.norm(across, axis=1)
    return area
