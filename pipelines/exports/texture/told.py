"""What a report says of how a mesh is coloured."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.exports.mesh import Floats, TexturedMesh, TriangleMesh


def skin_told(skin: TriangleMesh | TexturedMesh) -> dict[str, Any]:
    """Of a delivered mesh: how many faces, the side of its picture, and how fine that is.

    texels_per_unit: texels along one unit of the world on the middle one of the faces.
    """
    if not isinstance(skin, TexturedMesh):
        return {"texture_px": None, "texels_per_unit": None, "num_faces": len(skin.faces)}
    lengths = _twice_area(skin.vertices[skin.faces])
    flat = np.pad(len(skin.texture) * skin.uv, ((0, 0), (0, 1)))
    density = np.sqrt(_twice_area(flat[skin.faces]) / np.maximum(lengths, 1e-300))
    return {
        "texture_px": len(skin.texture),
        "texels_per_unit": round(float(np.median(density)), 3),
        "num_faces": len(skin.faces),
    }


def _twice_area(corners: Floats) -> Floats:
    """Of triangles [F, 3, 3]: [F]."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area: Floats = np.linalg.norm(across, axis=1)
    return area
