"""The draft stage: a mesh from the depth maps alone, long before anything is trained.

Reads the maps of `depth`, the posed cameras and their images. Writes `draft.glb`, the maps fused
and cleaned as the final mesh is, with the photos' colours, and `draft.jpg`, the draft seen from a
camera of the capture. Where the maps show no surface it writes nothing and says so: the job goes
on, its mesh comes from training. A job that trains nothing asks for more (`draft.required`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipelines.errors import ExportError
from pipelines.exports.cutting import cut_out
from pipelines.exports.formats import glb
from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.options import reach_of
from pipelines.exports.subject import Decision
from pipelines.exports.subject_files import as_dict
from pipelines.exports.subject_search import decide_on
from pipelines.exports.surface.shells import find_shells, fuse_shells
from pipelines.exports.texture.bake import painted
from pipelines.judging.asset_views import MeshCaster, Texture
from pipelines.nerf.judging.off_path import evenly
from pipelines.options import DraftOptions
from pipelines.scene.bounds import bounds_of_views
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.depth_views import DepthView, Floats, Pinhole, ViewStore
from pipelines.scene.gaze import gaze_of
from pipelines.scene.stereo_views import undistorted_picture
from pipelines.stage import StageContext

_PICTURE_LONG_SIDE = 640
_LOAD_SHARE, _FUSE_SHARE, _TEXTURE_SHARE = 0.3, 0.6, 0.95
_BACKGROUND = 128
_NUM_PROBES = 16


def run(options: DraftOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the draft. Raises ExportError `empty_mesh` where there is none and it is required."""
    maps = DepthMapsFile(ctx.workspace.stage("depth"))
    if len(maps) == 0:
        return _nothing(options, ctx, "there are no depth maps")
    cameras = CamerasFile.load(ctx.workspace.posed_cameras)
    poses = np.asarray([image.world_from_camera for image in cameras.images], np.float64)
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder:
        views = _views(maps, cameras, Path(folder), options, ctx)
        probes = [views[index] for index in evenly(len(views), _NUM_PROBES)]
        shells = find_shells(
            lambda distance: bounds_of_views(probes, poses, distance),
            options.max_distance,
            reach_of(options),
            options.resolution,
        )
        if not shells:
            return _nothing(
                options, ctx, "no depth map shows a surface near what the cameras look at"
            )
        share = _FUSE_SHARE - _LOAD_SHARE
        mesh = fuse_shells(
            views,
            shells,
            options.max_faces,
            lambda done: ctx.progress(_LOAD_SHARE + share * done, "fusing depth", None),
        )
        decision = _decided(views, probes, cameras, ctx) if options.extent == "subject" else None
    if len(mesh.faces) == 0:
        return _nothing(options, ctx, "no two depth maps agree on a surface")
    subject = None
    if decision is not None:
        mesh, subject = _alone(mesh, decision, ctx), as_dict(decision)
        if len(mesh.faces) == 0:
            return _nothing(options, ctx, "nothing is left of the subject")
    skin = _painted(mesh, maps, cameras, options, ctx)
    glb.write_mesh(ctx.out / "draft.glb", skin, Frame(metric=cameras.metric))
    _save_picture(ctx.out / "draft.jpg", skin, probes[len(probes) // 2], shells[0].bounds.focus)
    return {
        "num_faces": len(mesh.faces),
        "num_views": len(views),
        "voxel": round(shells[0].voxel, 9),
        "subject": subject,
        "bounds": shells[0].bounds.as_dict(),
    }


def _decided(
    views: ViewStore, probes: Sequence[DepthView], cameras: CamerasFile, ctx: StageContext
) -> Decision:
    """What was filmed, by the maps: decided as it will be by the trained scene."""
    ctx.progress(_FUSE_SHARE, "looking for the subject")
    lenses = [cameras.cameras[image.camera] for image in cameras.images]
    gaze = gaze_of(list(cameras.images), lenses)
    return decide_on(views, probes, gaze, lambda done: ctx.check_cancelled(), insist=True)


def _alone(mesh: TriangleMesh, decision: Decision, ctx: StageContext) -> TriangleMesh:
    """The thing in the mesh with what it stands on; all of the mesh where none was found."""
    if decision.thing is None:
        ctx.logger.warning("No subject was found; the draft is what lies within max_distance.")
        return mesh
    return cut_out(mesh, decision.thing)


def _nothing(options: DraftOptions, ctx: StageContext, why: str) -> dict[str, Any]:
    if options.required:
        raise ExportError(
            f"The draft is empty: {why}.",
            code="empty_mesh",
            hint="A preset that trains, such as preview, sees more than depth maps do; plain or "
            "shining surfaces need light, and pictures that overlap more.",
        )
    ctx.logger.warning("There is no draft: %s.", why)
    return {"num_faces": 0, "why": why}


def _views(
    maps: DepthMapsFile,
    cameras: CamerasFile,
    folder: Path,
    options: DraftOptions,
    ctx: StageContext,
) -> ViewStore:
    """The maps with the photos' colours, as depth views on disk."""
    named = {image.file: image for image in maps.lit(cameras.images)}
    store = ViewStore(folder)
    picked = evenly(len(maps), options.num_views or len(maps))
    for done, index in enumerate(picked, start=1):
        image, lens = named[maps.images[index].file], maps.images[index].lens
        picture = undistorted_picture(
            ctx.workspace.images_root, image, cameras.cameras[image.camera], lens
        )
        pose = np.asarray(image.world_from_camera, np.float64)
        z = maps.read(index).z
        store.append(DepthView(lens, pose, picture, z, is_partial=True))
        ctx.progress(_LOAD_SHARE * done / len(picked), "loading images")
    return store


def _painted(
    mesh: TriangleMesh,
    maps: DepthMapsFile,
    cameras: CamerasFile,
    options: DraftOptions,
    ctx: StageContext,
) -> TriangleMesh | TexturedMesh:
    """The mesh painted with the photos that took part."""
    named = {image.file: image for image in maps.lit(cameras.images)}
    picked = evenly(len(maps), options.num_views or len(maps))
    images = [named[maps.images[index].file] for index in picked]
    lenses = [cameras.cameras[image.camera] for image in images]
    return painted(mesh, images, lenses, options, ctx, (_FUSE_SHARE, _TEXTURE_SHARE))


def _save_picture(
    path: Path, mesh: TriangleMesh | TexturedMesh, view: DepthView, origin: Floats
) -> None:
    """The mesh from a view's camera, on grey."""
    lens = Pinhole.of(view.lens.intrinsics(), _PICTURE_LONG_SIDE)
    rays = lens.directions().reshape(-1, 3) @ view.world_from_camera[:, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eye = np.broadcast_to(view.world_from_camera[:, 3] - origin, rays.shape)
    skin = Texture(mesh.uv, mesh.texture) if isinstance(mesh, TexturedMesh) else mesh.colors
    seen = MeshCaster(mesh.vertices - origin, mesh.faces, skin).along(
        eye, rays, (lens.height, lens.width), 1.0 / lens.fl_x
    )
    colors = np.where(seen.hit[..., None], np.rint(255.0 * seen.color), _BACKGROUND)
    Image.fromarray(colors.astype(np.uint8)).save(path, quality=88)
