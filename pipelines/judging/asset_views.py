"""What a delivered mesh or cloud shows from a camera: colour, where there is anything, how far.

Cameras are `pipelines.nerf`'s, so that rays are those of the real lens, distortion and all.
Cameras, vertices and points are in one frame, the world less an origin of the caller's choice,
because float32 cannot hold geo-referenced coordinates; lengths are world units. Symbols: V
vertices, F faces, P points, H x W pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
import torch
from numpy.typing import NDArray

from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.lenses import EQUIRECTANGULAR
from pipelines.scene.picture_sampling import between_pixels, points_in_frame

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

NEIGHBOURS = 6
"""A sheet of evenly spread points gives each six neighbours at the spacing of the points."""
WIDEST_SPACING = 3.0
"""A lone point's spacing is at most so many medians, or it would hide half a picture."""
MAX_RADIUS_PX = 6
"""A point is drawn at most this large: what is right before the camera must not hide the rest."""
_MOST_RAYS = 1_000_000
"""Cast at a time: each takes some hundred bytes."""
_TEXTURE_LEVELS = 4
"""Farther copies would mix in what lies beside a patch."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


@dataclass(frozen=True)
class AssetView:
    """color: [H, W, 3] float32, sRGB in [0, 1], 0 where nothing is. hit: [H, W].

    distance: [H, W] float32 along the pixel's ray, world units, 0 where nothing is.
    """

    color: NDArray[np.float32]
    hit: Bools
    distance: NDArray[np.float32]

    def z_depth(self, cameras: Cameras, index: int) -> NDArray[np.float32]:
        """The distance along the camera's axis, [H, W]; `cameras` as it was drawn with."""
        rays = cameras.image_rays(index)
        forward = -cameras.scene_from_camera[index, :, 2]
        along = (rays.directions @ forward).numpy().reshape(self.hit.shape)
        return np.asarray(self.distance * along, np.float32)


class Texture:
    """A picture on a mesh, with smaller copies of it, as viewers look it up from afar.

    uv: [V, 2] in [0, 1], from its top left corner. picture: [H, W, 3] uint8, sRGB.
    """

    def __init__(self, uv: Floats, picture: NDArray[np.uint8]) -> None:
        self.uv = uv
        self._levels = [np.asarray(picture, np.float32) / np.float32(255.0)]
        while len(self._levels) < _TEXTURE_LEVELS and min(self._levels[-1].shape[:2]) > 2:
            height, width = (side // 2 for side in self._levels[-1].shape[:2])
            whole = self._levels[-1][: 2 * height, : 2 * width]
            self._levels.append(whole.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)))

    def density(self, vertices: Floats, faces: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Texels per unit of length on each face, [F]."""
        height, width = self._levels[0].shape[:2]
        places = np.asarray(self.uv, np.float64) * (width, height)
        texels = _twice_area(np.pad(places, ((0, 0), (0, 1)))[faces])
        lengths = _twice_area(np.asarray(vertices, np.float64)[faces])
        return np.sqrt(texels / np.maximum(lengths, 1e-30)).astype(np.float32)

    def colors(self, uv: Floats, footprint: Floats) -> NDArray[np.float32]:
        """Colours [N, 3] at places [N, 2]; footprint: [N], texels that are one pixel."""
        level = np.rint(np.log2(np.maximum(footprint, 1.0))).astype(int)
        level = np.minimum(level, len(self._levels) - 1)
        found = np.zeros((len(uv), 3), np.float32)
        for index, picture in enumerate(self._levels):
            mine = level == index
            if mine.any():
                height, width = picture.shape[:2]
                found[mine] = between_pixels(picture, uv[mine, 0] * width, uv[mine, 1] * height)
        return found


def _twice_area(corners: Floats) -> Floats:
    """Of triangles [F, 3, 3]: [F]."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area: Floats = np.linalg.norm(across, axis=1)
    return area


class MeshCaster:
    """A mesh to be looked at; both sides of its faces show, as viewers draw them.

    vertices: [V, 3]. faces: [F, 3], indices. colors: [V, 3] in [0, 1], or a texture to look them
    up in, or None for mid grey. Raises ValueError for a mesh without faces.
    """

    def __init__(
        self, vertices: Floats, faces: NDArray[np.integer[Any]], colors: Floats | Texture | None
    ) -> None:
        if len(faces) == 0:
            raise ValueError("a mesh without faces shows nothing")
        self._faces = np.ascontiguousarray(faces, np.uint32)
        self._texture = colors if isinstance(colors, Texture) else None
        if isinstance(colors, Texture):
            self._values = np.asarray(colors.uv, np.float32)
            self._density = colors.density(vertices, faces)
        else:
            grey = np.full((len(vertices), 3), 0.5, np.float32)
            self._values = grey if colors is None else np.asarray(colors, np.float32)
        self._scene = _tensor_geometry.RaycastingScene()
        self._scene.add_triangles(
            _core.Tensor.from_numpy(np.ascontiguousarray(vertices, np.float32)),
            _core.Tensor.from_numpy(self._faces),
        )

    def view(self, cameras: Cameras, index: int, samples: int = 1) -> AssetView:
        """What camera `index` sees.

        samples: rays along each side of a pixel. With several, a pixel shows the mean of what they
        meet, as a photo does; it is hit where half of them are, at their middle distance.
        """
        width, height = cameras.size[index].tolist()
        rows = max(1, _MOST_RAYS // (width * samples * samples))
        strips = [
            self._strip(cameras, index, range(top, min(top + rows, height)), samples)
            for top in range(0, height, rows)
        ]
        return AssetView(
            color=np.concatenate([strip.color for strip in strips]),
            hit=np.concatenate([strip.hit for strip in strips]),
            distance=np.concatenate([strip.distance for strip in strips]),
        )

    def _strip(self, cameras: Cameras, index: int, rows: range, samples: int) -> AssetView:
        """Some rows of what camera `index` sees."""
        width = int(cameras.size[index, 0])
        angle = 1.0 / (samples * float(cameras.focal[index].mean()))
        if int(cameras.model[index]) == EQUIRECTANGULAR:
            angle *= math.pi  # its plane is in half turns, not in radians
        shape = (len(rows) * samples, width * samples)
        x, y = (
            (torch.arange(length, dtype=cameras.focal.dtype) + 0.5) / samples
            for length in shape[::-1]
        )
        pixels = torch.stack(torch.meshgrid(x, y + rows.start, indexing="xy"), dim=-1)
        pixels = pixels.reshape(-1, 2)
        rays = cameras.generate_rays(torch.full((len(pixels),), index), pixels)
        found = self.along(rays.origins.numpy(), rays.directions.numpy(), shape, angle)
        return found if samples == 1 else _averaged(found, samples)

    def along(
        self, origins: Floats, directions: Floats, shape: tuple[int, ...], angle: float = 0.0
    ) -> AssetView:
        """What rays [N, 3] with unit directions meet, as pictures of `shape`, N in all.

        angle: between neighbouring rays, radians, which decides how fine a texture is looked at.
        """
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        found = self._scene.cast_rays(_core.Tensor.from_numpy(np.ascontiguousarray(rays)))
        distance = found["t_hit"].numpy()
        hit = np.isfinite(distance)
        met = found["primitive_ids"].numpy()[hit]
        u, v = found["primitive_uvs"].numpy()[hit].T
        weights = np.stack([1.0 - u - v, u, v], axis=1)
        values = np.einsum("nc,ncd->nd", weights, self._values[self._faces[met]])
        if self._texture is not None:
            values = self._texture.colors(values, self._density[met] * distance[hit] * angle)
        color = np.zeros((len(rays), 3), np.float32)
        color[hit] = values
        return AssetView(
            color=color.reshape(*shape, 3),
            hit=hit.reshape(shape),
            distance=np.where(hit, distance, np.float32(0.0)).reshape(shape),
        )


def _averaged(view: AssetView, side: int) -> AssetView:
    """The view with `side` x `side` pixels as one."""
    height, width = (length // side for length in view.hit.shape)

    def squares(values: Floats) -> Floats:
        """[height, width, side * side, ...]"""
        split = values.reshape(height, side, width, side, *values.shape[2:])
        return np.moveaxis(split, 2, 1).reshape(height, width, side * side, *values.shape[2:])

    count = squares(view.hit.astype(np.float32)).sum(axis=2)
    hit = 2.0 * count >= side * side
    color = squares(view.color).sum(axis=2) / np.maximum(count, 1.0)[..., None]
    sorted_distance = np.sort(squares(np.where(view.hit, view.distance, np.inf)), axis=2)
    middle = np.maximum((count.astype(int) - 1) // 2, 0)[..., None]
    distance = np.take_along_axis(sorted_distance, middle, axis=2)[..., 0]
    return AssetView(
        color=np.where(hit[..., None], color, 0.0).astype(np.float32),
        hit=hit,
        distance=np.where(hit, distance, 0.0).astype(np.float32),
    )


def point_spacing(points: Floats) -> NDArray[np.float32]:
    """How far apart points [P, 3] lie around each: [P], world units.

    The mean distance to a point's six nearest, and at most three times the median of that. 0 for a
    single point.
    """
    if len(points) < 2:
        return np.zeros(len(points), np.float32)
    values = _core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32))
    search = _core.nns.NearestNeighborSearch(values)
    search.knn_index()
    _, squared = search.knn_search(values, min(NEIGHBOURS + 1, len(points)))
    # The nearest is the point itself.
    spacing = np.sqrt(np.maximum(squared.numpy()[:, 1:], 0.0)).mean(axis=1)
    limited: NDArray[np.float32] = np.minimum(
        spacing, WIDEST_SPACING * np.median(spacing), dtype=np.float32
    )
    return limited


def cloud_view(
    points: Floats, colors: Floats, radius: Floats, cameras: Cameras, index: int
) -> AssetView:
    """The cloud as discs that face the camera, the nearest of a pixel in front.

    points: [P, 3]. colors: [P, 3] in [0, 1]. radius: [P], world units; drawn with at least half a
    pixel and at most `MAX_RADIUS_PX`.
    """
    width, height = cameras.size[index].tolist()
    which, pixels, z_depth = points_in_frame(points, cameras, index)
    eye = cameras.scene_from_camera[index, :, 3].numpy()
    distance = np.linalg.norm(np.asarray(points, np.float32)[which] - eye, axis=1)
    focal = float(cameras.focal[index].mean())
    sides = np.clip(focal * radius[which] / np.maximum(z_depth, 1e-9), 0.5, MAX_RADIUS_PX)
    first = np.floor(pixels).astype(np.int64)
    reach = int(np.ceil(sides.max(initial=0.5)))
    flats, members = [], []
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            # A point is less than a pixel's diagonal from its own pixel's corner: most are too
            # small for most offsets.
            near = np.flatnonzero(sides >= np.hypot(dx, dy) - 0.75)
            cells = first[near] + (dx, dy)
            off = np.linalg.norm(cells + 0.5 - pixels[near], axis=1)
            drawn = (off <= sides[near]) | ((dx == 0) & (dy == 0))
            drawn &= ((cells >= 0) & (cells < (width, height))).all(axis=1)
            flats.append(cells[drawn, 1] * width + cells[drawn, 0])
            members.append(near[drawn])
    flat, member = np.concatenate(flats), np.concatenate(members)
    # Far to near, so that of the points of one pixel the nearest is written last.
    order = np.argsort(-distance[member], kind="stable")
    flat, member = flat[order], member[order]
    nearest = np.zeros(height * width, np.float32)
    owner = np.full(height * width, -1, np.int64)
    nearest[flat], owner[flat] = distance[member], which[member]
    nearest, owner = nearest.reshape(height, width), owner.reshape(height, width)
    hit = owner >= 0
    color = np.zeros((height, width, 3), np.float32)
    color[hit] = colors[owner[hit]]
    return AssetView(color, hit, nearest)
