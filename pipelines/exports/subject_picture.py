"""The picture of a subject: where it lies in the whole mesh, and what was cut out of that.

One row of square tiles. The first shows the delivered mesh from above and before, where the cameras
were, with the region's edges in orange; the others the subject alone, turned by an eighth of a turn
to either side and straight on.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from pipelines.exports.crop import Crop
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.paths.flight import looking_at
from pipelines.judging.asset_views import MeshCaster, Texture
from pipelines.scene.depth_views import Pinhole

Floats = NDArray[np.float64]

_TILE_PX = 480
_FOV_DEG = 40.0
_EDGE, _EDGE_PX = (255, 150, 30), 3
_FILLS, _WHOLE_FILLS = 1.25, 1.6
"""How large the sphere around the region is drawn, 1 for a tile's inner circle: alone; and how much
farther away the whole mesh is looked at from."""
_SIDES_DEG = (-45.0, 0.0, 45.0)
_LOWEST_DEG, _STEEPEST_DEG, _HIGHER_DEG = 10.0, 50.0, 10.0
_BACKGROUND = 60
_QUALITY = 88


def save_subject_picture(
    path: Path,
    whole: TriangleMesh,
    cut: TriangleMesh | TexturedMesh,
    region: Crop,
    eyes: Floats,
    check: Callable[[], None] = lambda: None,
) -> None:
    """Write the picture. eyes: [N, 3] where the cameras stood. check: called between tiles."""
    away = (eyes - region.center).mean(axis=0)
    level = float(np.hypot(away[0], away[1]))
    side = float(np.degrees(np.arctan2(away[1], away[0])))
    raised = float(np.clip(np.degrees(np.arctan2(away[2], level)), _LOWEST_DEG, _STEEPEST_DEG))
    radius = float(np.linalg.norm(region.half))
    lens = _lens()
    distance = radius / np.sin(np.radians(_FOV_DEG / 2.0))
    pose = _pose(side, raised + _HIGHER_DEG, _WHOLE_FILLS * distance)
    tiles = [_with_edges(_seen(_caster(whole, region.center), lens, pose), region, lens, pose)]
    caster = _caster(cut, region.center)
    for turn in _SIDES_DEG:
        check()
        tiles.append(_seen(caster, lens, _pose(side + turn, raised, distance / _FILLS)))
    Image.fromarray(np.concatenate(tiles, axis=1)).save(path, quality=_QUALITY)


def _caster(mesh: TriangleMesh | TexturedMesh, middle: Floats) -> MeshCaster:
    """A mesh to be looked at, with the origin in the middle of the region."""
    skin = Texture(mesh.uv, mesh.texture) if isinstance(mesh, TexturedMesh) else mesh.colors
    return MeshCaster(mesh.vertices - middle, mesh.faces, skin)


def _seen(caster: MeshCaster, lens: Pinhole, pose: Floats) -> NDArray[np.uint8]:
    """[H, W, 3], what a pose around the middle shows, on dark grey."""
    rays = lens.directions().reshape(-1, 3) @ pose[:, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eye = np.broadcast_to(pose[:, 3], rays.shape)
    seen = caster.along(eye, rays, (lens.height, lens.width), 1.0 / lens.fl_x)
    colors = np.where(seen.hit[..., None], np.rint(255.0 * seen.color), _BACKGROUND)
    return colors.astype(np.uint8)


def _lens() -> Pinhole:
    focal = _TILE_PX / 2.0 / np.tan(np.radians(_FOV_DEG / 2.0))
    return Pinhole(_TILE_PX, _TILE_PX, focal, focal, _TILE_PX / 2.0, _TILE_PX / 2.0)


def _pose(side_deg: float, raised_deg: float, distance: float) -> Floats:
    """[3, 4], camera axes and place around the middle, from a side and a height, looking at it."""
    side, raised = np.radians(side_deg), np.radians(raised_deg)
    away = np.array([np.cos(side) * np.cos(raised), np.sin(side) * np.cos(raised), np.sin(raised)])
    pose: Floats = looking_at((distance * away)[None], np.zeros(3))[0]
    return pose


def _with_edges(
    picture: NDArray[np.uint8], region: Crop, lens: Pinhole, pose: Floats
) -> NDArray[np.uint8]:
    """The picture with the twelve edges of a box drawn over it."""
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    local = ((signs * region.half) @ region.axes.T - pose[:, 3]) @ pose[:, :3]
    flat = np.stack(
        [
            lens.cx + lens.fl_x * local[:, 0] / -local[:, 2],
            lens.cy - lens.fl_y * local[:, 1] / -local[:, 2],
        ],
        axis=1,
    )
    for one in range(8):
        for other in range(one + 1, 8):
            if np.abs(signs[one] - signs[other]).sum() == 2.0:
                pen.line([*map(float, flat[one]), *map(float, flat[other])], _EDGE, _EDGE_PX)
    return np.asarray(image)
