"""The point cloud: points with colour and normals from the depth of training views.

Points near the job's mesh are laid on it, as all views and the photos have made that, and wear its
picture; where views left gaps on it they are filled; where it has nothing points stay where their
view has them, if the photos have them there, too. In one frame, the world of cameras.json unless
another is asked for, in the formats asked for. Normals point to the cameras that saw the points.
Views are spread over the capture and just large enough for the points wanted, so the work is known
beforehand and an empty crop ends in an error instead of a search without end.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator

from pipelines.errors import ExportError
from pipelines.exports.export import Export
from pipelines.exports.options import CropOptions, reach_of
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipelines.exports.placement import Placement
    from pipelines.exports.surface.cloud import Cloud
    from pipelines.exports.surface.skin import Skin
    from pipelines.scene.cameras_file import CamerasFile, PosedImage
    from pipelines.scene.stereo_views import ColorView
    from pipelines.scene.trained_scene import TrainedScene

_MAX_VIEWS = 48
_RENDER_SHARE = 0.75
_NORMAL_NEIGHBOURS = 40
"""With 60 normals are a little smoother still, but more of them are off by 30 degrees and more."""
_AGAINST_PHOTOS, _PHOTO_PX = "checking points against the photos", 320
"""Their long side: coarser than the points, so that a small error of a pose does not matter."""
_LEAST_SHARE = 0.05
"""Of a crop's upright box, if hardly any surface in it is in the crop."""


Format = Literal["ply", "las", "laz", "xyz", "colmap"]

_FILES: dict[Format, str] = {
    "ply": "pointcloud.ply",
    "las": "pointcloud.las",
    "laz": "pointcloud.laz",
    "xyz": "pointcloud.xyz",
    "colmap": "pointcloud.colmap.zip",
}


class PointcloudOptions(CropOptions):
    """The point cloud."""

    formats: tuple[Format, ...] = Field(
        ("ply",),
        min_length=1,
        max_length=5,
        description="Files that are delivered: ply, las, laz, xyz (text), colmap (a model with the "
        "points and the cameras).",
    )
    num_points: int = Field(1_000_000, ge=1000, le=50_000_000, description="Points wanted.")
    spacing: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="One point is kept of each cube with this side, before num_points are picked; "
        "0 for all. Unit: the world's.",
    )
    remove_outliers: bool = Field(True, description="Drop points far from their neighbours.")
    snap_to_mesh: bool = Field(
        True,
        description="Lay points within two voxels of the job's mesh on it, with its normals and "
        "its picture's colours, fill gaps on it, and drop points off it that photos do not have.",
    )

    @field_validator("formats")
    @classmethod
    def _each_once(cls, formats: tuple[Format, ...]) -> tuple[Format, ...]:
        return tuple(dict.fromkeys(formats))


def run(scene: TrainedScene, options: PointcloudOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the cloud.

    Raises ExportError `empty_pointcloud` where the model shows no surface, `export.empty` where
    there is none in the crop.
    """
    # Imported where it runs: the API reads this file too.
    import numpy as np

    from pipelines.exports.chosen_crop import chosen_crop
    from pipelines.exports.crop import empty_crop, narrowed, surface_in
    from pipelines.exports.formats.colmap import check_lenses
    from pipelines.exports.placement import placement_of
    from pipelines.exports.spacing import least_crowded, one_of_each_cube
    from pipelines.exports.subject_files import as_dict
    from pipelines.exports.subject_search import SEARCH_SHARE, search_subject
    from pipelines.exports.surface import cloud as clouds
    from pipelines.exports.surface.snapping import snapped
    from pipelines.exports.surface.strays import strays
    from pipelines.exports.surface.surface_file import load_surface
    from pipelines.exports.surface.views import (
        known_depths,
        lens_of_pixels,
        pixels_for_points,
        render_views,
    )
    from pipelines.scene.consistency import consistent

    if "colmap" in options.formats:
        check_lenses(scene.cameras)
    place = placement_of(options.frame, scene.cameras)
    ctx.progress(0.0, "looking for the scene's bounds")
    probes = scene.probe_views(ctx.check_cancelled)
    near = scene.bounds(options.max_distance, ctx.check_cancelled, probes)
    bounds = scene.bounds(reach_of(options), ctx.check_cancelled, probes)
    if near is None or bounds is None:
        raise _empty("no ray of the training views met a surface")
    known = known_depths(ctx.workspace, options.use_depth_maps)
    alone = options.extent == "subject"
    search = functools.cache(lambda: search_subject(scene, probes, ctx, insist=alone))
    crop, told_crop = chosen_crop(options.crop, place, search, ctx.logger)
    thing = subject = None
    if crop is None and alone:
        thing, subject = search().thing, as_dict(search())
        if thing is None:
            ctx.logger.warning("No subject was found; the cloud is what lies within max_distance.")
        else:
            crop = thing.region

    def inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether each of [P, 3] is in what was asked for."""
        if thing is not None:
            return thing.holds(points)
        return np.ones(len(points), np.bool_) if crop is None else crop.contains(points)

    around = surface_in(crop, probes, bounds, "pointcloud")
    bounds = narrowed(bounds, crop) or bounds
    images = scene.training_images(_MAX_VIEWS)
    pixels = pixels_for_points(options.num_points, len(images), probes, bounds)
    if crop is not None:
        reached = crop.contains(around[bounds.contains(around)])
        pixels /= max(float(reached.mean()) if len(reached) else 0.0, _LEAST_SHARE)
    lenses = [lens_of_pixels(scene.lens_of(image), pixels) for image in images]
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder:
        shares = (SEARCH_SHARE, _RENDER_SHARE)
        store = render_views(scene, images, lenses, Path(folder), ctx, shares, known)
        ctx.progress(_RENDER_SHARE, "gathering points")
        cloud = clouds.gather(store, bounds)
        surface = load_surface(ctx.workspace.stage("mesh")) if options.snap_to_mesh else None
        if surface is not None:
            told = ctx.told_part("laying points on the mesh", _RENDER_SHARE, 0.8)
            cloud = snapped(cloud, surface, told)
        cloud = cloud.take(inside(cloud.points))
        ctx.progress(0.8, f"checking {len(cloud)} points against all views")
        cloud = cloud.take(consistent(cloud.points, store))
    if surface is not None:
        loose = np.flatnonzero(~cloud.normals.any(axis=1))
        photos = _photos(scene, images, ctx, ctx.told_part(_AGAINST_PHOTOS, 0.84, 0.87))
        lost = strays(cloud.points[loose], cloud.colors[loose], surface, photos)
        cloud = cloud.take(np.setdiff1d(np.arange(len(cloud)), loose[lost]))
    if options.remove_outliers:
        ctx.progress(0.87, "removing outliers")
        inner = near.contains(cloud.points)
        parts = [cloud.take(inner), cloud.take(~inner)]  # what is far is spread more widely
        cloud = clouds.joined([clouds.without_outliers(part, bounds.focus) for part in parts])
    if len(cloud) == 0 and thing is not None:
        raise _empty("no two views agree on a surface of the subject")
    if len(cloud) == 0 and crop is not None:
        raise empty_crop(crop, around, "pointcloud")
    if len(cloud) == 0:
        raise _empty("no surface lies within max_distance that views agree on")
    skin = _skin(ctx) if options.snap_to_mesh else None
    num_seen = len(cloud)
    if skin is not None:
        ctx.progress(0.9, "filling gaps on the mesh")
        eyes = np.asarray([image.world_from_camera for image in images], np.float64)[:, :, 3]
        filling = skin.filling(
            cloud,
            eyes,
            options.num_points,
            ctx.seed,
            lambda points: bounds.contains(points) & inside(points),
            ctx.check_cancelled,
        )
        cloud = clouds.joined([cloud, filling])
    filled_share = 1.0 - num_seen / len(cloud)
    if options.spacing:
        cloud = cloud.take(one_of_each_cube(cloud.points, options.spacing))
    cloud = cloud.take(least_crowded(cloud.points, options.num_points, ctx.seed))
    on_mesh = np.asarray(cloud.normals.any(axis=1))
    if skin is not None:
        told = ctx.told_part("painting points on the mesh", 0.92, 0.94)
        cloud = skin.painted(cloud, on_mesh, told)
    told = ctx.told_part("estimating normals", 0.94, 0.97)
    cloud = clouds.with_normals(cloud, _NORMAL_NEIGHBOURS, told)
    _write(cloud, options, ctx, place, scene.cameras)
    return {
        "frame": place.as_dict(),
        "formats": list(options.formats),
        "num_points": len(cloud),
        "num_on_mesh": int(on_mesh.sum()),
        "filled_share": round(filled_share, 4),
        "num_views": len(images),
        "subject": subject,
        "crop": told_crop,
        "bounds": bounds.as_dict(),
    }


def _photos(
    scene: TrainedScene,
    images: list[PosedImage],
    ctx: StageContext,
    on_progress: Callable[[float], None],
) -> Iterator[ColorView]:
    """The images, small. on_progress: told the share that is done; may raise."""
    from pipelines.nerf.ahead import each_ahead
    from pipelines.scene.stereo_views import color_view

    def load(image: PosedImage) -> ColorView:
        return color_view(ctx.workspace.images_root, image, scene.lens_of(image), _PHOTO_PX)

    for done, photo in enumerate(each_ahead(load, images)):
        on_progress(done / len(images))
        yield photo


def _skin(ctx: StageContext) -> Skin | None:
    """The job's mesh with the picture on it; None without one."""
    from pipelines.exports.formats.glb import read_mesh
    from pipelines.exports.judged import mesh_of
    from pipelines.exports.mesh import TexturedMesh
    from pipelines.exports.surface.skin import Skin

    path = mesh_of(ctx.workspace.stage("mesh"))
    mesh = read_mesh(path) if path.is_file() else None
    return Skin(mesh) if isinstance(mesh, TexturedMesh) and len(mesh.faces) else None


def _write(
    cloud: Cloud,
    options: PointcloudOptions,
    ctx: StageContext,
    place: Placement,
    cameras: CamerasFile,
) -> None:
    """The files."""
    from pipelines.exports.formats import las, ply, xyz
    from pipelines.exports.formats.colmap import write_colmap_points
    from pipelines.exports.judged import JUDGED_CLOUD

    told = ctx.told_part("writing", 0.97, 1.0)
    points, cameras = place.points(cloud.points), place.cameras(cameras)
    content = (points, cloud.colors, place.directions(cloud.normals), place.frame())

    def told_of(name: Format) -> Callable[[float], None]:
        begin = options.formats.index(name)
        return lambda done: told((begin + done) / len(options.formats))

    writers: dict[Format, Callable[[Path], None]] = {
        "ply": lambda path: ply.write_points(path, *content),
        "las": lambda path: las.write_points(path, *content),
        "laz": lambda path: las.write_points(path, *content),
        "xyz": lambda path: xyz.write_points(path, *content, told_of("xyz")),
        "colmap": lambda path: write_colmap_points(
            path, cameras, points, cloud.colors, place.frame()
        ),
    }
    for name in options.formats:
        told_of(name)(0.0)
        writers[name](ctx.out / _FILES[name])
    if "ply" not in options.formats:
        writers["ply"](ctx.out / JUDGED_CLOUD)


def _empty(why: str) -> ExportError:
    return ExportError(
        f"The point cloud is empty: {why}.",
        code="empty_pointcloud",
        hint="Raise pointcloud.max_distance, or train longer.",
    )


EXPORT = Export(
    kind="pointcloud",
    version=16,
    reads=("ingest", "frames", "depth", "mesh"),
    run=run,
    options=PointcloudOptions,
    artifacts=(
        Artifact(
            "pointcloud.ply",
            "pointcloud.ply",
            "application/octet-stream",
            "MeshLab, CloudCompare, Blender",
        ),
        Artifact(
            "pointcloud.las",
            "pointcloud.las",
            "application/vnd.las",
            "CloudCompare, QGIS",
            on_request=True,
        ),
        Artifact(
            "pointcloud.laz",
            "pointcloud.laz",
            "application/vnd.laszip",
            "CloudCompare, QGIS",
            on_request=True,
        ),
        Artifact(
            "pointcloud.xyz",
            "pointcloud.xyz",
            "text/plain; charset=utf-8",
            "CloudCompare, spreadsheets",
            on_request=True,
        ),
        Artifact(
            "pointcloud.colmap.zip",
            "pointcloud.colmap.zip",
            "application/zip",
            "COLMAP, gsplat",
            on_request=True,
        ),
    ),
)
