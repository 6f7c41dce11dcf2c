"""The point cloud stage: points with colour and normals from the depth of training views.

Reads `train/model.zip`, writes `pointcloud.ply` in the world frame of cameras.json. Views are
spread over the capture and just large enough for the points wanted, so the work is known beforehand
and an empty crop ends in an error instead of a search without end.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.depth_views import DepthView, Pinhole, ViewStore
from pipelines.errors import ExportError
from pipelines.options import PointcloudOptions, render_config
from pipelines.ply import write_points
from pipelines.scene_bounds import SceneBounds
from pipelines.stage import StageContext
from pipelines.trained_scene import TrainedScene

Floats = NDArray[np.float64]

_geometry: Any = open3d.geometry
_utility: Any = open3d.utility

_MAX_VIEWS = 48
_MIN_LONG_SIDE, _MAX_LONG_SIDE = 64, 4096
_OVERSAMPLING = 1.5
_MIN_VALID_SHARE = 0.05
_DEPTH_TOLERANCE = 0.05
_MAX_CONTRADICTED = 0.3
_NEIGHBOURS = 20
_OUTLIER_SIGMAS = 2.0
_RENDER_SHARE = 0.75


@dataclass(frozen=True)
class Cloud:
    """points, normals: [P, 3] world. colors: [P, 3] uint8. eyes: [P, 3], who saw each point."""

    points: Floats
    colors: NDArray[np.uint8]
    eyes: Floats

    def __len__(self) -> int:
        return len(self.points)

    def take(self, which: NDArray[Any]) -> Cloud:
        """The points that a mask or index array picks."""
        return Cloud(self.points[which], self.colors[which], self.eyes[which])


def run(options: PointcloudOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the cloud. Raises ExportError `empty_pointcloud` where no surface is in the crop."""
    scene = TrainedScene.load(ctx.workspace.stage("train") / "model.zip", render_config(options))
    ctx.progress(0.0, "looking for the scene's bounds")
    probes = scene.probe_views(ctx.check_cancelled)
    bounds = scene.bounds(options.max_distance, ctx.check_cancelled, probes)
    if bounds is None:
        raise _empty("no ray of the training views met a surface")
    valid_share = float(np.mean([_wanted(view, bounds).mean() for view in probes]))
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder:
        store = _render(scene, options.num_points, valid_share, ctx, Path(folder))
        ctx.progress(_RENDER_SHARE, "gathering points")
        cloud = gather(store, bounds)
        ctx.progress(0.8, f"checking {len(cloud)} points against all views")
        cloud = cloud.take(consistent(cloud, store))
    if options.remove_outliers and len(cloud) > _NEIGHBOURS:
        ctx.progress(0.87, "removing outliers")
        cloud = cloud.take(_inliers(cloud, bounds))
    if len(cloud) == 0:
        raise _empty("no surface lies within the crop")
    if len(cloud) > options.num_points:
        rng = np.random.default_rng(ctx.seed)
        cloud = cloud.take(np.sort(rng.choice(len(cloud), options.num_points, replace=False)))
    ctx.progress(0.92, "estimating normals")
    normals = oriented_normals(cloud, bounds.focus)
    ctx.progress(0.97, "writing")
    write_points(ctx.out / "pointcloud.ply", cloud.points, cloud.colors, normals)
    return {"num_points": len(cloud), "num_views": len(store), "bounds": bounds.as_dict()}


def _wanted(view: DepthView, bounds: SceneBounds) -> NDArray[np.bool_]:
    """[H, W] pixels whose depth is to be trusted and lies in the scene."""
    wanted: NDArray[np.bool_] = view.smooth_mask() & bounds.contains(view.points())
    return wanted


def _render(
    scene: TrainedScene, num_points: int, valid_share: float, ctx: StageContext, folder: Path
) -> ViewStore:
    """Depth views, just large enough that their valid pixels give the points wanted."""
    images = scene.training_images()
    count = min(_MAX_VIEWS, len(images))
    picked = np.unique(np.linspace(0, len(images) - 1, count).round().astype(int))
    pixels = _OVERSAMPLING * num_points / max(valid_share, _MIN_VALID_SHARE) / len(picked)
    store = ViewStore(folder)
    started = time.monotonic()
    for done, index in enumerate(picked, start=1):
        lens = scene.lens_of(images[index])
        long_side = math.sqrt(pixels * max(lens.width, lens.height) / min(lens.width, lens.height))
        side = math.ceil(min(max(long_side, _MIN_LONG_SIDE), _MAX_LONG_SIDE))
        pose = np.asarray(images[index].world_from_camera, np.float64)
        store.append(scene.depth_view(Pinhole.of(lens, side), pose))
        eta = (time.monotonic() - started) / done * (len(picked) - done)
        ctx.progress(_RENDER_SHARE * done / len(picked), f"view {done}/{len(picked)}", eta)
    return store


def gather(views: Iterable[DepthView], bounds: SceneBounds) -> Cloud:
    """The points of all views that lie in the scene and not on a jump in depth."""
    points, colors, eyes = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros((0, 3))]
    for view in views:
        mask = _wanted(view, bounds)
        points.append(view.points()[mask])
        colors.append(view.rgb[mask])
        eyes.append(np.broadcast_to(view.world_from_camera[:, 3], points[-1].shape))
    return Cloud(np.concatenate(points), np.concatenate(colors), np.concatenate(eyes))


def consistent(cloud: Cloud, views: Iterable[DepthView]) -> NDArray[np.bool_]:
    """Which points the views do not contradict: [P].

    A view contradicts a point that hangs in front of the surface it sees by more than 5 %, and
    supports one on that surface. The nearest surface around the pixel counts, or edges would be
    eaten away by the background beside them. Points behind it are hidden and say nothing. A point
    goes when at least two views, and more than 30 % of those with a say, contradict it.
    """
    contradicted = np.zeros(len(cloud), np.int32)
    supported = np.zeros(len(cloud), np.int32)
    for view in views:
        lens = view.lens
        matrix = view.camera_from_world_cv(np.zeros(3))
        local = cloud.points @ matrix[:3, :3].T + matrix[:3, 3]
        z = local[:, 2]
        safe = np.where(z > 1e-9, z, np.inf)
        u = np.floor(lens.fl_x * local[:, 0] / safe + lens.cx)
        v = np.floor(lens.fl_y * local[:, 1] / safe + lens.cy)
        inside = (z > 1e-9) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
        seen = np.flatnonzero(inside)
        surface = _nearest_around(view.z_depth)[v[seen].astype(int), u[seen].astype(int)]
        known = np.isfinite(surface)
        seen, surface = seen[known], surface[known]
        contradicted[seen] += z[seen] < surface * (1.0 - _DEPTH_TOLERANCE)
        supported[seen] += np.abs(z[seen] - surface) <= surface * _DEPTH_TOLERANCE
    bad = (contradicted >= 2) & (contradicted > _MAX_CONTRADICTED * (contradicted + supported))
    fine: NDArray[np.bool_] = ~bad
    return fine


def _nearest_around(z_depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """[H, W] the least known depth in each pixel's 3x3 neighbourhood; infinite where none is."""
    height, width = z_depth.shape
    padded = np.pad(
        np.where(z_depth > 0, z_depth, np.float32(np.inf)), 1, constant_values=np.float32(np.inf)
    )
    shifted = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    nearest: NDArray[np.float32] = np.minimum.reduce(shifted)
    return nearest


def _inliers(cloud: Cloud, bounds: SceneBounds) -> NDArray[np.int64]:
    """Indices of the points whose neighbours are not unusually far."""
    _, kept = _legacy(cloud, bounds.focus).remove_statistical_outlier(_NEIGHBOURS, _OUTLIER_SIGMAS)
    return np.asarray(kept, np.int64)


def oriented_normals(cloud: Cloud, origin: Floats) -> Floats:
    """Unit normals [P, 3] from each point's neighbours, turned to the camera that saw it."""
    legacy = _legacy(cloud, origin)
    legacy.estimate_normals(_geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
    normals = np.asarray(legacy.normals, np.float64)
    to_eye = cloud.eyes - cloud.points
    # Too few neighbours give a zero normal: then the view direction is the best that is known.
    lost = np.linalg.norm(normals, axis=1) < 0.5
    normals[lost] = to_eye[lost]
    away = (normals * to_eye).sum(axis=1) < 0
    normals[away] *= -1.0
    unit: Floats = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def _legacy(cloud: Cloud, origin: Floats) -> Any:
    return _geometry.PointCloud(_utility.Vector3dVector(cloud.points - origin))


def _empty(why: str) -> ExportError:
    return ExportError(
        f"The point cloud is empty: {why}.",
        code="empty_pointcloud",
        hint="Raise pointcloud.max_distance, or train longer.",
    )
