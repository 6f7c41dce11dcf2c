"""The assess stage: the delivered mesh and cloud, seen from cameras that nothing was made from.

Reads the held-out photos with their masks, the cameras of `train`, `mesh.glb` and `pointcloud.ply`
as they are delivered (`pipelines.exports.judged` where other formats are), and what `evaluate`
found of floaters. Where training held nothing out, training views take the place of held-out ones,
and the result says so. Writes `assets.json` and `images/<name>.jpg`: photo | mesh | where there is
none. Nothing is rendered from the model, no GPU is used.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.errors import ExportError
from pipelines.exports.formats.glb import read_mesh
from pipelines.exports.formats.ply import Ply, read_ply
from pipelines.exports.frame import back_to_world
from pipelines.exports.judged import cloud_of, mesh_of
from pipelines.exports.mesh import TexturedMesh
from pipelines.judging.asset_scores import DEFINITIONS, mean_scores, picture_of, score_view
from pipelines.judging.asset_views import (
    AssetView,
    MeshCaster,
    Texture,
    cloud_view,
    point_spacing,
)
from pipelines.judging.depth_scores import (
    depth_agreement,
    depth_scores,
    fitted_scale,
    nearest,
)
from pipelines.judging.verdicts import Limits, geometry_warning, model_warning
from pipelines.nerf.data.images import ImageData, load_images
from pipelines.nerf.data.light import in_the_light_of
from pipelines.nerf.judging.off_path import evenly
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.options import AssessOptions
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.registered_depth import registered_depth
from pipelines.scene.trained_scene import nerf_cameras, nerf_errors_as
from pipelines.stage import StageContext
from pipelines.stages.evaluate import picture_name
from pipelines.stages.void_masks import void_masks
from pipelines.workspace import Workspace

NO_AGREED_DEPTH = "This job made no depth maps that views agree on."
_AGREEMENT_VIEWS = 8
_SAMPLES = 2
"""Rays along each side of a pixel: a photo's pixel is the mean over a square, not one point."""


@dataclass(frozen=True)
class Views:
    """What assets are compared with: N photos at the size asked for, and their cameras.

    lenses: of the photos as they are stored. cameras: in `frame`, the world less its origin.
    held_out: whether training never saw them.
    bend: of the camera's curve, where assets have the mean light, which each photo differs from.
    void: [H, W] of each photo, where nothing stands; None where depth found nothing of the kind.
    """

    posed: list[PosedImage]
    lenses: list[Intrinsics]
    images: ImageData
    cameras: Cameras
    frame: SceneTransform
    held_out: bool
    bend: float | None = None
    void: list[NDArray[np.bool_]] | None = None

    def photo(self, index: int) -> NDArray[np.float32]:
        """[H, W, 3] in [0, 1]."""
        photo: NDArray[np.float32] = self.images.image(index).numpy()
        return photo

    def valid(self, index: int) -> NDArray[np.bool_] | None:
        """[H, W], or None where all of it counts. The sky and the dark do not, as nothing is to be
        there, but in a photo that shows nothing else.
        """
        mask = self.images.mask(index)
        valid = None if mask is None else mask.numpy()
        if self.void is None:
            return valid
        solid = ~self.void[index] if valid is None else valid & ~self.void[index]
        return solid if solid.any() else valid

    def lit(self, view: AssetView, index: int) -> AssetView:
        """A view of an asset in the light of the photo."""
        if self.bend is None:
            return view
        valid = self.valid(index)
        usable = view.hit if valid is None else view.hit & valid
        return replace(
            view, color=in_the_light_of(view.color, self.photo(index), usable, self.bend)
        )


def run(options: AssessOptions, ctx: StageContext) -> dict[str, Any]:
    """Measure. The summary is the content of `assets.json`.

    Raises ExportError `geometry_poor` where the options require surfaces that hold together.
    """
    (ctx.out / "images").mkdir(exist_ok=True)
    views = load_views(ctx.workspace, options)
    ctx.progress(0.1, "reading the mesh")
    caster = _caster(ctx.workspace.stage("mesh"), views.frame)
    seen = _look_at_mesh(caster, views, options, ctx)
    agreement, no_agreement = _against_agreed_depth(caster, views.frame, ctx.workspace)
    cloud = read_ply(cloud_of(ctx.workspace.stage("pointcloud")))
    cloud_rows, spacing = _look_at_cloud(cloud, views, ctx)
    metrics = json.loads((ctx.workspace.stage("evaluate") / "metrics.json").read_text("utf-8"))
    mesh_means, floaters = mean_scores(seen.rows), _floaters(metrics)
    poor = geometry_warning(
        mesh_means["coverage"],
        floaters,
        Limits(options.min_coverage, options.max_depth_inconsistency),
    )
    warnings = [
        warning
        for warning in (poor, model_warning(metrics.get("psnr"), options.min_psnr))
        if warning is not None
    ]
    depth, no_depth = _against_sensor(seen.views, views, ctx.workspace)
    assets = {
        "views": describe(views),
        "mesh": mesh_means,
        "cloud": {**mean_scores(cloud_rows), "median_spacing": spacing},
        "depth_agreement": agreement,
        "depth_agreement_reason": no_agreement,
        "depth": depth,
        "depth_reason": no_depth,
        "depth_inconsistency": floaters,
        "void": _before_void(seen.views, views),
        "warnings": warnings,
        "definitions": DEFINITIONS,
        "per_view": [
            {"file": image.file, "mesh": mesh_row, "cloud": cloud_row}
            for image, mesh_row, cloud_row in zip(views.posed, seen.rows, cloud_rows, strict=True)
        ],
    }
    (ctx.out / "assets.json").write_text(json.dumps(assets, indent=1), "utf-8")
    for warning in warnings:
        ctx.logger.warning("%s %s", warning["message"], warning["hint"])
    if poor is not None and options.require_geometry:
        raise ExportError(
            poor["message"], code=poor["code"], hint=poor["hint"], details=poor["details"]
        )
    ctx.progress(1.0, "measured", 0.0)
    return assets


def load_views(workspace: Workspace, options: AssessOptions) -> Views:
    """The held-out photos, evenly picked; training photos where none were held out."""
    cameras = CamerasFile.load(workspace.stage("train") / "cameras.json")
    held_out = [image for image in cameras.images if image.split == "test"]
    pool = held_out or [image for image in cameras.images if image.split == "train"]
    posed = [pool[index] for index in evenly(len(pool), options.num_views or len(pool))]
    poses = np.asarray([image.world_from_camera for image in posed], np.float64)
    frame = SceneTransform.fit(poses[:, :, 3], scale_poses=False)
    root = workspace.images_root
    with nerf_errors_as(ExportError):
        images = load_images(
            [root / image.file for image in posed],
            options.long_side_px,
            [None if image.mask is None else root / image.mask for image in posed],
        )
        lenses = [cameras.cameras[image.camera] for image in posed]
        sized = nerf_cameras(lenses, poses, frame).resized(options.long_side_px)
    void = void_masks(workspace, cameras, posed, sized)
    return Views(posed, lenses, images, sized, frame, bool(held_out), cameras.bend, void)


def describe(views: Views) -> dict[str, Any]:
    """What the assets were compared with, in words and numbers."""
    width, height = views.cameras.size[0].tolist()
    note = (
        "Held-out photos, never trained on."
        if views.held_out
        else "Nothing was held out: photos that were trained on, evenly picked."
    )
    return {
        "held_out": views.held_out,
        "num_views": len(views.posed),
        "width": width,
        "height": height,
        "note": note,
        "light": "as it is" if views.bend is None else "halves",
    }


@dataclass(frozen=True)
class _Seen:
    """views, rows: of the mesh, one per photo."""

    views: list[AssetView]
    rows: list[dict[str, float | None]]


def _caster(folder: Path, frame: SceneTransform) -> MeshCaster:
    """The mesh as it is delivered, back from its frame: with its texture, where it has one."""
    mesh = read_mesh(mesh_of(folder))
    vertices = frame.scene_from_world(mesh.vertices)
    if isinstance(mesh, TexturedMesh):
        return MeshCaster(vertices, mesh.faces, Texture(mesh.uv, mesh.texture))
    return MeshCaster(vertices, mesh.faces, mesh.colors)


def _look_at_mesh(
    caster: MeshCaster, views: Views, options: AssessOptions, ctx: StageContext
) -> _Seen:
    shown = set(evenly(len(views.posed), options.num_pictures)) if options.num_pictures else set()
    seen = _Seen([], [])
    for index, image in enumerate(views.posed):
        view = views.lit(caster.view(views.cameras, index, _SAMPLES), index)
        photo = views.photo(index)
        seen.views.append(view)
        seen.rows.append(score_view(view, photo, views.valid(index)))
        if index in shown:
            path = ctx.out / "images" / f"{picture_name(image.file)}.jpg"
            Image.fromarray(picture_of(view, photo)).save(path, quality=90)
        ctx.progress(0.15 + 0.35 * (index + 1) / len(views.posed), "looking at the mesh")
    return seen


def _look_at_cloud(
    cloud: Ply, views: Views, ctx: StageContext
) -> tuple[list[dict[str, float | None]], float]:
    """The rows of the cloud, drawn with its own spacing as radius, and the median spacing."""
    points = views.frame.scene_from_world(back_to_world(cloud.points, cloud.from_world))
    grey = np.full((len(points), 3), 128, np.uint8)
    colors = (grey if cloud.colors is None else cloud.colors).astype(np.float32) / 255.0
    ctx.progress(0.5, "measuring the cloud's spacing")
    spacing = point_spacing(points)
    rows = []
    for index in range(len(views.posed)):
        view = views.lit(cloud_view(points, colors, spacing, views.cameras, index), index)
        rows.append(score_view(view, views.photo(index), views.valid(index)))
        ctx.progress(0.6 + 0.35 * (index + 1) / len(views.posed), "looking at the cloud")
    return rows, round(float(np.median(spacing)), 6)


def _before_void(seen: list[AssetView], views: Views) -> dict[str, float] | None:
    """How much of the photos shows that nothing stands there, and how much of that the mesh hides;
    None without any.
    """
    if views.void is None:
        return None
    size = sum(int(mask.sum()) for mask in views.void)
    hidden = sum(int((view.hit & mask).sum()) for view, mask in zip(seen, views.void, strict=True))
    return {
        "share": round(size / sum(mask.size for mask in views.void), 4),
        "hidden": round(hidden / max(size, 1), 4),
    }


def _floaters(metrics: dict[str, Any]) -> float | None:
    """The depth inconsistency that `evaluate` measured, if it did."""
    found = (metrics.get("floaters") or {}).get("depth_inconsistency")
    return None if found is None else float(found)


def _against_agreed_depth(
    caster: MeshCaster, frame: SceneTransform, workspace: Workspace
) -> tuple[dict[str, Any] | None, str | None]:
    """The mesh against the maps of the stage `depth`, or why it was not compared."""
    maps = DepthMapsFile(workspace.stage("depth")) if workspace.is_complete("depth") else None
    if maps is None or len(maps) == 0:
        return None, NO_AGREED_DEPTH
    cameras = CamerasFile.load(workspace.stage("train") / "cameras.json")
    poses = {image.file: image.world_from_camera for image in cameras.images}
    found, agreed = [], []
    for index in evenly(len(maps), _AGREEMENT_VIEWS):
        item = maps.images[index]
        pose = np.asarray(poses[item.file], np.float64)
        # As they come, rays reach one unit along the camera's axis: distance / length is z-depth.
        rays = item.lens.directions().reshape(-1, 3)
        lengths = np.linalg.norm(rays, axis=1)
        eyes = np.broadcast_to(frame.scene_from_world(pose[:, 3]), rays.shape)
        turned = (rays / lengths[:, None]) @ pose[:, :3].T
        shape = (item.lens.height, item.lens.width)
        view = caster.along(eyes, turned, shape)
        found.append(view.distance / lengths.reshape(shape))
        agreed.append(maps.read(index).z)
    return depth_agreement(found, agreed), None


def _against_sensor(
    seen: list[AssetView], views: Views, workspace: Workspace
) -> tuple[dict[str, Any] | None, str | None]:
    """The mesh's depth against the capture's own, or why it was not compared.

    Where poses came with the capture, its unit is that of its depth; where they were found from
    pictures, one factor for all views brings the mesh to the sensor's unit, and is reported.
    """
    rows = [row for row, image in enumerate(views.posed) if image.depth is not None]
    if not rows:
        return None, "The capture holds no depth."
    found, truth = [], []
    for row in rows:
        shape = (seen[row].hit.shape[0], seen[row].hit.shape[1])
        image = views.posed[row]
        try:
            stored = registered_depth(workspace.images_root, image, views.lenses[row])
            depth = nearest(stored, shape)
        except ValueError as error:
            return None, f"The capture's depth was not compared: {error}"
        valid = views.valid(row)
        truth.append(depth if valid is None else np.where(valid, depth, np.float32(0.0)))
        found.append(seen[row].z_depth(views.cameras, row))
    scale = 1.0
    if not workspace.brought_poses:
        scale = fitted_scale(found, truth) or 1.0
        found = [scale * values for values in found]
    return {**depth_scores(found, truth), "scale": round(scale, 6)}, None
