"""One frame of a flight as numbers: what a lens sees of the trained scene, or of its mesh.

A perspective lens is a `Pinhole`; its depth is z, along the camera's axis. Wide lenses, which no
plane can show, are an equidistant fisheye (its circle within the picture, black around it) and the
equirectangular sphere; their depth is the distance along the ray. [H, W] pictures, world units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.exports import shades
from pipelines.exports.flight_options import FlightOptions
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.mixing import enlarged, mixed
from pipelines.exports.paths.flight import Flight, lens_of_size
from pipelines.judging.asset_views import AssetView, MeshCaster, Texture
from pipelines.nerf.space.cameras import SceneTransform, panorama_intrinsics
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.depth_views import Pinhole, surface_distance, without_jumps
from pipelines.scene.trained_scene import TrainedScene, as_array, as_uint8, nerf_cameras

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_HERE = np.eye(3, 4)
_NO_MOVE = SceneTransform((0.0, 0.0, 0.0), 1.0)
_AROUND_MESH = 31
"""Grey where there is no mesh, as no surface is black all round."""
_SAMPLES = 2
"""Rays along each side of a pixel of the mesh."""


@dataclass(frozen=True)
class Shot:
    """rgb: [H, W, 3]. depth: 0 where unknown. accumulation: in [0, 1]. normals: makes [H, W, 3],
    camera axes."""

    rgb: Bytes
    depth: NDArray[np.float32]
    accumulation: Floats
    normals: Callable[[], NDArray[np.float32]]


class Lens:
    """The lens of each frame of a flight. own: the capture's typical one."""

    def __init__(self, options: FlightOptions, own: Intrinsics, flight: Flight) -> None:
        self._kind = options.camera_type()
        self._flight = flight
        self._fov_deg = options.fisheye_fov_deg
        self._plain = (
            lens_of_size(own, *options.size())
            if options.has_own_size()
            else Pinhole.of(own, options.long_side_px, multiple=2)
        )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self._plain.width, self._plain.height

    def plain(self, index: int) -> Pinhole:
        """A perspective lens of the same size for a frame, whatever lens films it."""
        return self._flight.lens(index, self._plain)

    def of(self, index: int) -> Pinhole | Intrinsics:
        """The lens of a frame."""
        width, height = self.size
        if self._kind == "perspective":
            return self.plain(index)
        if self._kind == "equirectangular":
            (fl_x, fl_y), (cx, cy) = panorama_intrinsics(width, height)
            return Intrinsics(width, height, fl_x, fl_y, cx, cy, "EQUIRECTANGULAR")
        if self._flight.fov_deg is not None:
            # nerfstudio's files: the focal length is that of a perspective lens of the same angle.
            focal = self.plain(index).fl_y
        else:
            focal = min(width, height) / math.radians(self._fov_deg)
        return Intrinsics(width, height, focal, focal, width / 2, height / 2, "OPENCV_FISHEYE")

    def circle(self, index: int) -> NDArray[np.bool_] | None:
        """[H, W], what of the picture shows something; None where all of it does."""
        if self._kind != "fisheye":
            return None
        lens = self.of(index)
        x = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fl_x
        y = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fl_y
        farthest = math.pi if self._flight.fov_deg is not None else math.radians(self._fov_deg) / 2
        shown: NDArray[np.bool_] = np.hypot(x[None, :], y[:, None]) <= farthest
        return shown


def shot_of(
    scene: TrainedScene,
    lens: Pinhole | Intrinsics,
    pose: Floats,
    circle: NDArray[np.bool_] | None = None,
) -> Shot:
    """What a lens sees of the trained scene from a world pose; nothing beyond the circle."""
    if isinstance(lens, Pinhole):
        view, accumulation = scene.seen(lens, pose)
        return Shot(view.rgb, view.z_depth, accumulation, lambda: shades.normals_of(view))
    seen = scene.render(lens, pose)
    accumulation = as_array(seen.accumulation)
    rgb = as_uint8(seen.rgb)
    if circle is not None:
        accumulation = np.where(circle, accumulation, 0.0)
        rgb = np.where(circle[..., None], rgb, np.uint8(0))
    distance = surface_distance(as_array(seen.depth), as_array(seen.expected_depth), accumulation)

    def normals() -> NDArray[np.float32]:
        points = directions_of(lens) * distance[..., None]
        return shades.normals_of_points(points, without_jumps(distance, _angle_of(lens)))

    return Shot(rgb, distance.astype(np.float32), accumulation, normals)


def directions_of(lens: Intrinsics) -> Floats:
    """[H, W, 3] unit rays of all pixels, in the camera's axes."""
    cameras = nerf_cameras([lens], [_HERE], _NO_MOVE)
    rays = cameras.image_rays(0).directions.numpy().astype(np.float64)
    grid: Floats = rays.reshape(lens.height, lens.width, 3)
    return grid


def _angle_of(lens: Intrinsics) -> float:
    """Between neighbouring pixels in the middle of a wide picture, radians."""
    return math.tau / lens.width if lens.model == "EQUIRECTANGULAR" else 1.0 / lens.fl_x


class MeshStudio:
    """A delivered mesh, to be filmed."""

    def __init__(self, mesh: TriangleMesh | TexturedMesh) -> None:
        # float32 rays do not reach far from the origin of a georeferenced world.
        self._frame = SceneTransform.fit(mesh.vertices, scale_poses=False)
        colors = Texture(mesh.uv, mesh.texture) if isinstance(mesh, TexturedMesh) else mesh.colors
        self._caster = MeshCaster(self._frame.scene_from_world(mesh.vertices), mesh.faces, colors)

    def view(self, lens: Intrinsics, pose: Floats, samples: int = 1) -> AssetView:
        """What a lens sees of the mesh from a world pose, both sides of its faces."""
        return self._caster.view(nerf_cameras([lens], [pose], self._frame), 0, samples=samples)

    def picture(
        self, lens: Pinhole | Intrinsics, pose: Floats, circle: NDArray[np.bool_] | None = None
    ) -> Bytes:
        """[H, W, 3]: the mesh alone."""
        view = self.view(intrinsics_of(lens), pose, _SAMPLES)
        picture = np.where(view.hit[..., None], as_uint8(view.color), np.uint8(_AROUND_MESH))
        return within(circle, picture)


class MixedStudio:
    """A trained scene and its mesh, to be filmed as one (`pipelines.exports.mixing`).

    mesh: None for a scene that has none; then what was trained on is enlarged. field_px: long side
        at which the scene is rendered through a perspective lens; the mesh is at the film's.
    own: the capture's typical lens. Through a wide one the scene has as many pixels for an angle as
        this has at that size.
    """

    def __init__(
        self, scene: TrainedScene, mesh: MeshStudio | None, field_px: int, own: Intrinsics
    ) -> None:
        self._scene = scene
        self._mesh = mesh
        self._field_px = field_px
        self._own = own
        self.has_mesh = mesh is not None

    def rendered_at(self, field_px: int) -> MixedStudio:
        """The same with the scene at another size."""
        return MixedStudio(self._scene, self._mesh, field_px, self._own)

    def picture(
        self, lens: Pinhole | Intrinsics, pose: Floats, circle: NDArray[np.bool_] | None = None
    ) -> Bytes:
        """[H, W, 3]: both."""
        full = intrinsics_of(lens)
        around, side = full.model == "EQUIRECTANGULAR", self._long_side(lens)
        if self._mesh is None:
            field = as_array(self._scene.render(full, pose, side).rgb)
            shown = enlarged(field, full.height, full.width, around=around)
            return within(circle, as_uint8(shown))
        # Side by side they take a twelfth less than one after the other: not half, as open3d's rays
        # hold the interpreter.
        with ThreadPoolExecutor(1) as pool:
            seen = pool.submit(self._mesh.view, full, pose)
            field = as_array(self._scene.render(full, pose, side).rgb)
            shown = mixed(field, seen.result(), around=around)
        return within(circle, as_uint8(shown))

    def _long_side(self, lens: Pinhole | Intrinsics) -> int:
        """At which the scene is rendered, px."""
        most = max(lens.width, lens.height)
        if isinstance(lens, Pinhole):
            return min(self._field_px, most)
        per_radian = self._own.fl_x * self._field_px / max(self._own.width, self._own.height)
        wanted = 4 * math.ceil(most * _angle_of(lens) * per_radian / 4.0)
        return min(wanted, most)


def intrinsics_of(lens: Pinhole | Intrinsics) -> Intrinsics:
    """The lens as one of `cameras.json`."""
    return lens.intrinsics() if isinstance(lens, Pinhole) else lens


def within(circle: NDArray[np.bool_] | None, picture: Bytes) -> Bytes:
    """The picture, black where a fisheye shows nothing."""
    return picture if circle is None else np.where(circle[..., None], picture, np.uint8(0))
