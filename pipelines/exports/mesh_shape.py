"""The shape of a mesh, step by step: what is looked at, its surface, what of it is wanted.

`plan_of` settles what was filmed and where surfaces are looked for; `surface_of` renders, fuses,
refines and closes what is there; `part_of` takes the subject or the crop of it, and `finished`
gives that its triangles and closes it all over. All in the world of cameras.json. What it looks
like, and its files: `pipelines.exports.mesh_files`.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pipelines.errors import ExportError, ToolError
from pipelines.exports.chosen_crop import chosen_crop
from pipelines.exports.crop import Crop, cropped, empty_crop, narrowed, surface_in
from pipelines.exports.cutting import cut_out
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.mesh_options import MeshOptions
from pipelines.exports.options import reach_of
from pipelines.exports.placement import Placement
from pipelines.exports.reduction import reduced
from pipelines.exports.subject import Decision, Thing
from pipelines.exports.subject_files import as_dict
from pipelines.exports.subject_search import SEARCH_SHARE, look_at_one_place, search_subject
from pipelines.exports.surface.carving import Seen, carved
from pipelines.exports.surface.denoising import denoised
from pipelines.exports.surface.holes import close_holes, hole_limits
from pipelines.exports.surface.outlines import outlined
from pipelines.exports.surface.refinement import refined
from pipelines.exports.surface.seams import seamless
from pipelines.exports.surface.shells import (
    Method,
    Shell,
    Subject,
    affordable,
    find_shells,
    fuse_shells,
)
from pipelines.exports.surface.unblocking import unblocked
from pipelines.exports.surface.views import known_depths, render_views
from pipelines.exports.surface.watertight import is_closed, made_watertight, why_open
from pipelines.exports.void import void_of_photos
from pipelines.nerf.stereo.views import StereoView
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import DepthView, Floats, Pinhole, ViewStore
from pipelines.scene.known_depths import KnownDepths
from pipelines.scene.stereo_views import ColorView, color_view, stereo_view, view_of
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext

REDUCE_SHARE = 0.86
"""Of the export's progress, when the shape is done."""
_RENDER_SHARE, _AFFORD_SHARE, _FUSE_SHARE, _SMOOTH_SHARE = 0.5, 0.53, 0.65, 0.68
_MEND_SHARE, _CLOSED_SHARE, _OTHERS_SHARE = 0.78, 0.79, 0.793
_FREE_SHARE, _CARVED_SHARE, _REFINE_SHARE = 0.797, 0.8, 0.83
_CLEARING = "clearing what is empty"
_OVER = 1.1
"""Times as many triangles as were asked for, which is told."""
_OTHERS_PX = 64
_MOST_CARVING = 400
"""Photos that tell what is empty: more tell no more, and their maps are held at once."""
_View = TypeVar("_View", StereoView, ColorView)
_PHOTO_SIDE_PX, _PHOTOS_PX = 960, 50_000_000
"""Photos that refine the mesh are so long, or shorter where all of them would have more pixels."""


@dataclass(frozen=True)
class Plan:
    """What is looked at. images, lenses: the views that are fused. shells: within the crop. method:
    by which they are to be made. known: depth maps that vote beside the field. told_crop: what the
    report says of the crop. decision: what was filmed, where that is asked for and no crop
    overrides it."""

    images: Sequence[PosedImage]
    lenses: Sequence[Pinhole]
    shells: Sequence[Shell]
    method: Method
    known: KnownDepths | None
    crop: Crop | None
    told_crop: dict[str, Any] | None
    decision: Decision | None


@dataclass(frozen=True)
class Surface:
    """What there is within the plan's shells. shells: as memory has room for them. method: by which
    it was made in the end. coarser, holes: what the report says of voxels and of holes closed."""

    mesh: TriangleMesh
    shells: Sequence[Shell]
    method: Method
    coarser: dict[str, Any] | None
    holes: dict[str, Any]


@dataclass(frozen=True)
class Part:
    """What of the surface is delivered. thing: to be cut out besides. down: [3], which way a thing
    stands on what carries it. subject: what the report says of it."""

    mesh: TriangleMesh
    thing: Thing | None = None
    down: Floats | None = None
    subject: dict[str, Any] | None = None


def plan_of(scene: TrainedScene, options: MeshOptions, place: Placement, ctx: StageContext) -> Plan:
    """What to look at.

    place: the frame that the crop is given in. Raises ExportError `empty_mesh` where the model
    shows no surface, `export.empty` where there is none in the crop.
    """
    ctx.progress(0.0, "looking for the scene's bounds")
    images = scene.training_images(options.num_views)
    lenses = [Pinhole.of(scene.lens_of(image), options.render_long_side_px) for image in images]
    probes = scene.probe_views(ctx.check_cancelled)
    shells = find_shells(
        lambda distance: scene.bounds(distance, ctx.check_cancelled, probes),
        options.max_distance,
        reach_of(options),
        options.resolution,
        Subject(options.fine_distance, _pixel_of(lenses), probes),
    )
    if not shells:
        raise _empty("no ray of the training views met a surface")
    known = known_depths(ctx.workspace, options.use_depth_maps)
    search = functools.cache(
        lambda: search_subject(scene, probes, ctx, insist=options.extent == "subject")
    )
    crop, told_crop = chosen_crop(options.crop, place, search, ctx.logger)
    surface_in(crop, probes, shells[-1].bounds, "mesh")
    kept = [(shell, narrowed(shell.bounds, crop)) for shell in shells]
    shells = [replace(shell, bounds=bounds) for shell, bounds in kept if bounds is not None]
    decision = search() if crop is None and options.extent != "scene" else None
    method = options.method
    if method == "auto":
        method = "poisson" if look_at_one_place(scene) else "tsdf"
    return Plan(images, lenses, shells, method, known, crop, told_crop, decision)


def surface_of(scene: TrainedScene, options: MeshOptions, plan: Plan, ctx: StageContext) -> Surface:
    """The surface within the plan's shells: fused, moved onto the photos, its small holes closed,
    its outlines moved onto the photos' edges.

    Raises ExportError `empty_mesh` where there is none.
    """
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder:
        store = render_views(
            scene,
            plan.images,
            plan.lenses,
            Path(folder),
            ctx,
            (SEARCH_SHARE, _RENDER_SHARE),
            plan.known,
        )
        told = ctx.told_part("looking for surfaces", _RENDER_SHARE, _AFFORD_SHARE)
        shells = affordable(store, plan.shells, told)
        coarser = _coarser(plan.shells, shells)
        if coarser is not None:
            ctx.logger.warning("The mesh is coarser than asked for: %s", coarser["reason"])
        mesh, method = _fused(scene, options, store, shells, plan.method, ctx)
        if len(mesh.faces) == 0:
            raise _empty(
                f"{len(plan.images)} views show no surface within the bounds that two agree on"
            )
        if options.refine == "photos":
            mesh = _on_the_photos(mesh, method, scene, shells, options, ctx)
        mesh = seamless(mesh, shells)
        told = ctx.told_part("closing holes", _MEND_SHARE, _CLOSED_SHARE)
        limits = hole_limits(shells, options.close_holes, options.max_distance)
        closing = close_holes(mesh, limits, store, told)
        others = _others(scene, plan, ctx)
        told = ctx.told_part(_CLEARING, _OTHERS_SHARE, _FREE_SHARE)
        mesh = unblocked(closing.mesh, [store, others], told)
    mesh = _out_of_the_void(mesh, scene, ctx)
    if options.refine == "photos":
        mesh = _on_the_edges(mesh, scene, ctx)
    return Surface(mesh, shells, method, coarser, closing.as_dict())


def _others(scene: TrainedScene, plan: Plan, ctx: StageContext) -> list[DepthView]:
    """What the scene shows, small, from where photos were taken that do not make the surface: where
    a camera was is nothing, whether its photo was held out or not.
    """
    fused = {image.file for image in plan.images}
    others = [image for image in scene.cameras.images if image.file not in fused]
    told = ctx.told_part(_CLEARING, _CLOSED_SHARE, _OTHERS_SHARE)
    views = []
    for done, image in enumerate(others):
        told(done / len(others))
        lens = Pinhole.of(scene.lens_of(image), _OTHERS_PX)
        views.append(scene.depth_view(lens, np.asarray(image.world_from_camera, np.float64)))
    return views


def _fused(
    scene: TrainedScene,
    options: MeshOptions,
    store: ViewStore,
    shells: Sequence[Shell],
    method: Method,
    ctx: StageContext,
) -> tuple[TriangleMesh, Method]:
    """All shells as one mesh, and the method that made it."""
    told = ctx.told_part("fusing depth", _AFFORD_SHARE, _FUSE_SHARE)
    faces = options.max_faces
    try:
        mesh = fuse_shells(store, shells, faces, told, method, scene.density, options.density_level)
    except ToolError as error:
        if method != "poisson":
            raise
        # Poisson's solver runs apart; there is a mesh without it, a little rougher.
        ctx.logger.warning("No Poisson surface, depth is fused in voxels instead: %s", error)
        return fuse_shells(store, shells, faces, told, "tsdf"), "tsdf"
    return mesh, method


def _on_the_photos(
    mesh: TriangleMesh,
    method: Method,
    scene: TrainedScene,
    shells: Sequence[Shell],
    options: MeshOptions,
    ctx: StageContext,
) -> TriangleMesh:
    """The mesh moved onto what the training photos agree on, without the noise of its voxels."""
    begun = _FUSE_SHARE
    if method == "tsdf":
        begun = _SMOOTH_SHARE
        mesh = denoised(mesh, ctx.told_part("smoothing", _FUSE_SHARE, begun))
    told = ctx.told_part("refining", begun, _MEND_SHARE)
    return refined(
        mesh,
        _photos(stereo_view, scene, ctx, told),
        told,
        flat=options.flatten,
        noise=max((shell.voxel for shell in shells if not shell.is_far), default=0.0),
    )


def _on_the_edges(mesh: TriangleMesh, scene: TrainedScene, ctx: StageContext) -> TriangleMesh:
    """The mesh with its outlines on the edges of the training photos."""
    told = ctx.told_part("moving outlines", _CARVED_SHARE, _REFINE_SHARE)
    return outlined(mesh, _photos(color_view, scene, ctx, told), told)


def _out_of_the_void(mesh: TriangleMesh, scene: TrainedScene, ctx: StageContext) -> TriangleMesh:
    """The mesh without what stands before the sky or the blank ground that `depth` told of."""
    images = {image.file: image for image in scene.training_images(_MOST_CARVING)}
    told = ctx.told_part(_CLEARING, _FREE_SHARE, _CARVED_SHARE)
    photos = (
        Seen(view_of(images[void.file], void.lens, void.z), void.is_void, void.z)
        for void in void_of_photos(ctx.workspace)
        if void.file in images
    )
    return carved(mesh, photos, told)


def _photos(
    load: Callable[[Path, PosedImage, Intrinsics, int], _View],
    scene: TrainedScene,
    ctx: StageContext,
    told: Callable[[float], None],
) -> list[_View]:
    """The training photos as what refines the mesh wants them; told, with 0, of each."""
    shown = scene.training_images()
    side = _photo_side([scene.lens_of(image) for image in shown])
    photos = []
    for image in shown:
        told(0.0)
        photos.append(load(ctx.workspace.images_root, image, scene.lens_of(image), side))
    return photos


def _pixel_of(lenses: Sequence[Pinhole]) -> float:
    """What a pixel covers at distance 1: of half of the views; a wide one more is no reason to know
    less of what the others show.
    """
    return float(np.median([1.0 / lens.fl_x for lens in lenses]))


def part_of(options: MeshOptions, plan: Plan, surface: Surface, ctx: StageContext) -> Part:
    """The part of the surface that is asked for.

    Raises ExportError `empty_mesh` where nothing is left of the subject, `export.empty` where there
    is no surface in the crop.
    """
    if plan.crop is not None:
        mesh = cropped(surface.mesh, plan.crop)
        if len(mesh.faces) == 0:
            raise empty_crop(plan.crop, surface.mesh.vertices, "mesh")
        return Part(mesh)
    if plan.decision is None:
        return Part(surface.mesh)
    thing = plan.decision.thing
    carrier = None if thing is None else thing.carried_by
    part = Part(
        surface.mesh, thing, None if carrier is None else -carrier.normal, as_dict(plan.decision)
    )
    if options.extent != "subject":
        return part
    if thing is None:
        ctx.logger.warning("No subject was found; the mesh is what lies within max_distance.")
        return part
    alone = cut_out(surface.mesh, thing)
    if len(alone.faces) == 0:
        raise _empty("nothing is left of the subject")
    return replace(part, mesh=alone, thing=None)


def finished(part: Part, options: MeshOptions, ctx: StageContext) -> Part:
    """The part with the triangles asked for, closed all over where that is asked for.

    Raises ExportError `empty_mesh` where nothing is left with so few.
    """
    mesh = part.mesh
    if options.triangles:
        words = f"reducing {len(mesh.faces)} triangles"
        told = ctx.told_part(words, _REFINE_SHARE, REDUCE_SHARE)
        told(0.0)
        mesh = reduced(mesh, options.triangles, told)
        if len(mesh.faces) == 0:
            raise ExportError(
                f"Of {len(part.mesh.faces)} triangles nothing is left in {options.triangles}.",
                code="empty_mesh",
                hint="Ask for more of them: raise mesh.triangles, or leave it out.",
            )
        if len(mesh.faces) > _OVER * options.triangles:
            ctx.logger.warning(
                "The mesh has %d triangles, and not the %d that were asked for: its pieces and "
                "holes need so many. Cut out the subject (mesh.extent), or crop, for fewer.",
                len(mesh.faces),
                options.triangles,
            )
    if options.watertight:
        ctx.progress(REDUCE_SHARE, "closing the mesh all over")
        mesh = made_watertight(mesh, part.down, lambda done: ctx.check_cancelled())
        if not is_closed(mesh.faces):
            ctx.logger.warning("The mesh is not watertight: %s", why_open(mesh.faces))
    return replace(part, mesh=mesh)


def _coarser(asked: Sequence[Shell], made: Sequence[Shell]) -> dict[str, Any] | None:
    """What the report says where memory has no room for voxels as fine as asked for."""
    grown = [(one.voxel, two.voxel) for one, two in zip(asked, made, strict=True)]
    if all(wanted == found for wanted, found in grown):
        return None
    return {
        "asked_voxel": round(asked[0].voxel, 9),
        "reason": f"{len([one for one in grown if one[0] != one[1]])} of {len(grown)} parts of the "
        "scene would not fit into memory with voxels of mesh.resolution; crop, or lower "
        "mesh.far_distance, for finer ones.",
    }


def _photo_side(lenses: Sequence[Intrinsics]) -> int:
    """The long side of the photos that refine the mesh, px."""
    squares = sum(min(lens.width, lens.height) / max(lens.width, lens.height) for lens in lenses)
    return min(_PHOTO_SIDE_PX, int((_PHOTOS_PX / squares) ** 0.5))


def _empty(why: str) -> ExportError:
    return ExportError(
        f"The mesh is empty: {why}.",
        code="empty_mesh",
        hint="Train longer, or raise mesh.max_distance; a low PSNR in evaluate means that the "
        "capture itself needs more overlap and light.",
    )
