"""A mesh with a picture on it, out of the trained field.

The mesh is unwrapped, each texel is turned into a place on the surface by its barycentric
coordinates, and a short ray through that place is rendered with the field's mean appearance.
Source: Nerfstudio, arXiv:2302.04264, section 4.3.

Departures: rays go the way that cameras looked, and against the normal where none did, as a field
knows its colours only as they were seen (a floor, by who walked over it, never from above); a ray
begins no farther out than half the way to what else of the mesh stands before it, so that it does
not begin in another surface; and where a ray meets hardly anything (the mesh closes a hole, or lies
beside what the field learned), the mesh's own colours take its place. Memory: a few rows of the
picture at a time, and the picture itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.mesh import Floats, TexturedMesh, TriangleMesh, unit_normals
from pipelines.exports.surface.sight import Sight
from pipelines.exports.texture.photos import Photos
from pipelines.exports.texture.texels import Texels, fill, spread, texels_of
from pipelines.exports.texture.unwrap import GUTTER_PX, unwrap
from pipelines.nerf.renderer import RenderedImage
from pipelines.scene.cameras_file import Intrinsics, PosedImage

Look = Callable[[Floats, Floats, float, Callable[[float], None]], RenderedImage]
"""As `TrainedScene.short_rays`."""

TEXELS_PER_PIXEL = 1.5
"""Along a side: of a texel and of a pixel that was trained on, seen from the nearest camera."""
_LEAST_REACH, _MOST_REACH = 2.0, 8.0
"""Half a ray's length, in such pixels; between them it is the mean edge of the mesh there."""
_OPAQUE = 0.5
"""A ray that meets less of the field fades into the mesh's own colours."""
_LEAST_COSINE = 0.1
_UNWRAP_SHARE, _RENDER_SHARE = 0.15, 0.97
_ROWS = 64

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def texture_from_field(
    mesh: TriangleMesh,
    look: Look,
    pixel: Floats,
    toward: Floats,
    largest_side: int,
    on_progress: Callable[[float], None] = lambda done: None,
) -> TexturedMesh:
    """Paint a mesh of the world with what short rays through its surface show.

    pixel: [F], what a pixel that was trained on covers on each face, world units. toward: [V, 3],
    unit, from where each vertex is looked at. largest_side: of the texture, px, a power of two.
    on_progress: told the share that is done; may raise. Raises TextureFull.
    """
    origin = mesh.vertices.mean(axis=0)
    local = mesh.vertices - origin

    def poll() -> None:
        on_progress(0.0)

    atlas = unwrap(local, mesh.faces, TEXELS_PER_PIXEL / pixel, largest_side, poll)
    on_progress(_UNWRAP_SHARE)
    width, height = atlas.size
    picture = np.zeros((height, width, 3), np.uint8)
    covered = np.zeros(picture.shape[:2], np.bool_)
    surface = _Surface(local, mesh, toward, _reaches(local, mesh.faces, pixel, atlas.face_chart))
    last = max(1.0, min(float(atlas.uv[:, 1].max()) + 1.0, height))
    for texels in texels_of(atlas.uv, atlas.faces, atlas.size, _ROWS):

        def on_share(done: float, rows: slice = texels.rows) -> None:
            share = min(1.0, (rows.start + done * (rows.stop - rows.start)) / last)
            on_progress(_UNWRAP_SHARE + (_RENDER_SHARE - _UNWRAP_SHARE) * share)

        on_share(0.0)
        colors = surface.colors(texels, look, origin, on_share)
        texture = np.rint(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)
        picture[texels.rows][texels.covered] = texture
        covered[texels.rows] = texels.covered
    spread(picture, covered, GUTTER_PX, lambda: on_progress(_RENDER_SHARE))
    fill(picture, covered)
    on_progress(1.0)
    return TexturedMesh(
        vertices=mesh.vertices[atlas.vertex],
        faces=atlas.faces,
        normals=mesh.normals[atlas.vertex],
        uv=atlas.uv / atlas.size,
        texture=picture,
    )


def _reaches(vertices: Floats, faces: NDArray[np.int32], pixel: Floats, chart: Any) -> Floats:
    """How far rays reach to either side of each face, [F], a power of two for each chart.

    Few lengths are rendered with, each at once.
    """
    corners = vertices[faces]
    edge = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).mean(axis=1)
    count = np.maximum(np.bincount(chart), 1)
    own, footprint = np.bincount(chart, edge) / count, np.bincount(chart, pixel) / count
    reach = np.clip(own, _LEAST_REACH * footprint, _MOST_REACH * footprint)
    rounded: Floats = np.exp2(np.rint(np.log2(np.maximum(reach, 1e-30))))[chart]
    return rounded


class _Surface:
    """A mesh, its vertices less an origin, from where each is looked at [V, 3], and how far rays
    reach beside each face [F]."""

    def __init__(self, vertices: Floats, mesh: TriangleMesh, toward: Floats, reach: Floats) -> None:
        self.vertices, self.mesh, self.toward, self.reach = vertices, mesh, toward, reach
        self._scene = _tensor_geometry.RaycastingScene()
        self._scene.add_triangles(
            _core.Tensor(vertices.astype(np.float32)),
            _core.Tensor(np.ascontiguousarray(mesh.faces, np.uint32)),
        )

    def colors(
        self, texels: Texels, look: Look, origin: Floats, on_share: Callable[[float], None]
    ) -> Floats:
        """Of the texels, [N, 3]."""
        corners = self.mesh.faces[texels.face]
        weights = texels.weights[..., None]
        points: Floats = (weights * self.vertices[corners]).sum(axis=1)
        out = self._outward(texels.face, (weights * self.toward[corners]).sum(axis=1))
        own: Floats = (weights * self.mesh.colors[corners]).sum(axis=1)
        reach = self.reach[texels.face]
        start = self._free(points, out, reach)
        colors = np.zeros_like(points)
        before = 0
        for length in np.unique(reach):
            mine = np.flatnonzero(reach == length)

            def on_part(done: float, before: int = before, here: int = len(mine)) -> None:
                on_share((before + done * here) / len(reach))

            begins = origin + points[mine] + start[mine, None] * out[mine]
            seen = look(begins, -out[mine], 2.0 * float(length), on_part)
            share = np.minimum(seen.accumulation.astype(np.float64) / _OPAQUE, 1.0)[:, None]
            colors[mine] = share * seen.rgb + (1.0 - share) * own[mine]
            before += len(mine)
        return colors

    def _outward(self, face: NDArray[np.int64], smooth: Floats) -> Floats:
        """From where to look, [N, 3]: as vertices are, or along the normal of a face whose back or
        edge that would show."""
        a, b, c = (self.vertices[self.mesh.faces[face, corner]] for corner in range(3))
        flat = unit_normals(np.cross(b - a, c - a))
        smooth = unit_normals(smooth)
        behind = (smooth * flat).sum(axis=1) <= _LEAST_COSINE
        out: Floats = np.where(behind[:, None], flat, smooth)
        return out

    def _free(self, points: Floats, out: Floats, reach: Floats) -> Floats:
        """How far outside rays begin, [N]: at most half the way to what stands before them."""
        lift = 0.05 * reach[:, None] * out
        rays = np.concatenate([points + lift, out], axis=1).astype(np.float32)
        free = self._scene.cast_rays(_core.Tensor(rays))["t_hit"].numpy().astype(np.float64)
        begins: Floats = np.minimum(reach, 0.5 * (free + 0.05 * reach))
        return begins


def seen_from(
    mesh: TriangleMesh, photos: Photos, on_progress: Callable[[float], None] = lambda done: None
) -> Floats:
    """From where each vertex was looked at, [V, 3], unit: the mean of the ways to the photos that
    show it, nothing in the way, the larger the more; its normal where none does.

    on_progress: told the share that is done; may raise.
    """
    vertices = photos.frame.scene_from_world(mesh.vertices)
    sight = Sight(vertices, mesh.faces)
    corners = vertices[mesh.faces]
    edge = float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    lifted = vertices + 0.5 * edge * mesh.normals
    total = np.zeros_like(vertices)
    for index in range(len(photos)):
        eye = photos.eye(index)
        ways = eye - vertices
        distance = np.maximum(np.linalg.norm(ways, axis=1), 1e-30)
        ways /= distance[:, None]
        facing = (ways * mesh.normals).sum(axis=1)
        _, shown = photos.pixels(index, vertices)
        which = np.flatnonzero(shown & (facing > _LEAST_COSINE))
        which = which[sight.reached(eye, lifted[which])]
        total[which] += (facing[which] / distance[which] ** 2)[:, None] * ways[which]
        on_progress((index + 1) / len(photos))
    known = (total != 0.0).any(axis=1)
    return unit_normals(np.where(known[:, None], total, mesh.normals))


def pixels_on(
    mesh: TriangleMesh,
    images: Sequence[PosedImage],
    lenses: Sequence[Intrinsics],
    long_side_px: int,
) -> Floats:
    """What a pixel of the nearest camera that looks there covers on each face, [F], world units.

    long_side_px: of the pictures as they were trained on. Where no camera looks it is as in the
    nearest one that does not.
    """
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    seen, any_camera = np.full(len(middle), np.inf), np.full(len(middle), np.inf)
    for image, lens in zip(images, lenses, strict=True):
        pose = np.asarray(image.world_from_camera, np.float64)
        toward = middle - pose[:, 3]
        distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-30)
        focal = min(lens.fl_x, lens.fl_y) * long_side_px / max(lens.width, lens.height)
        covers = distance / focal
        half = np.hypot(lens.width, lens.height) / 2.0 / min(lens.fl_x, lens.fl_y)
        inside = -(toward @ pose[:, 2]) > distance * np.cos(min(np.arctan(half), np.pi / 2.0))
        any_camera = np.minimum(any_camera, covers)
        seen = np.where(inside, np.minimum(seen, covers), seen)
    found: Floats = np.where(np.isfinite(seen), seen, any_camera)
    return found
