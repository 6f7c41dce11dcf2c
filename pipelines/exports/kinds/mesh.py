"""The mesh: rendered depth fused into triangles, in the formats asked for.

All of them lie in one frame, the world of cameras.json unless another is asked for
(`pipelines.exports.frame`); GLB and USDZ have +Y up.
GLB, OBJ and USDZ have a texture from the training photos or the trained field, PLY the field's
colours on its vertices, STL is shape alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator

from pipelines.errors import ExportError, ToolError
from pipelines.exports.export import Export
from pipelines.exports.frame import Axis, Frame
from pipelines.exports.options import CropOptions, TextureOptions, reach_of
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.exports.formats.glb import GlbStyle
    from pipelines.exports.mesh import TexturedMesh, TriangleMesh
    from pipelines.exports.surface.shells import Method, Shell
    from pipelines.scene.cameras_file import Intrinsics
    from pipelines.scene.trained_scene import TrainedScene

Format = Literal["glb", "ply", "obj", "stl", "usdz"]

_FILES: dict[Format, str] = {
    "glb": "mesh.glb",
    "ply": "mesh.ply",
    "obj": "mesh.obj.zip",
    "stl": "mesh.stl",
    "usdz": "mesh.usdz",
}
_TEXTURED = frozenset({"glb", "obj", "usdz"})
"""Formats that carry a texture."""
_RENDER_SHARE, _AFFORD_SHARE, _FUSE_SHARE = 0.5, 0.53, 0.65
_MEND_SHARE, _REFINE_SHARE, _REDUCE_SHARE, _TEXTURE_SHARE = 0.82, 0.83, 0.86, 0.96
_SUBJECT_SHARE = 0.98
_PHOTO_SIDE_PX, _PHOTOS_PX = 960, 50_000_000
"""Photos that refine the mesh are so long, or shorter where all of them would have more pixels."""


class MeshOptions(CropOptions, TextureOptions):
    """The mesh, by fusing rendered depth."""

    formats: tuple[Format, ...] = Field(
        ("glb", "ply"),
        min_length=1,
        max_length=5,
        description="Files that are delivered: glb, ply, obj (a zip with its material and "
        "picture), stl, usdz.",
    )
    up_axis: Axis = Field(
        "z",
        description="Which axis is up in ply, obj and stl. In glb and usdz it is always y.",
    )

    extent: Literal["auto", "subject", "scene"] = Field(
        "auto",
        description="scene is all that lies within far_distance, more coarsely beyond "
        "max_distance. auto is scene, and where somebody walked round a thing also subject.glb: "
        "that thing with what it stands on. subject is that thing alone as the mesh itself; else "
        "what stands where the cameras look, or, with a warning, what lies within max_distance. "
        "A crop overrides it.",
    )

    method: Literal["tsdf", "poisson", "marching_cubes"] = Field(
        "tsdf",
        description="How depth becomes a surface: tsdf fuses it in a field of voxels; poisson lays "
        "a smooth surface through the points that views agree on, closes small holes, and takes "
        "longer; where its solver fails, tsdf is what is done. marching_cubes takes the trained "
        "density itself at density_level, near what the views see.",
    )
    density_level: float = Field(
        0.25,
        ge=0.01,
        le=0.99,
        description="Where the surface of method=marching_cubes is: of the light that goes through "
        "a voxel's length there, this share is taken away. Higher is more exact, with more holes.",
    )
    resolution: int = Field(
        256,
        ge=32,
        le=2048,
        description="Voxels along the longest side of what lies within max_distance; fewer where "
        "memory has no room for so many, which the report tells.",
    )
    fine_distance: float = Field(
        1.0,
        ge=0.0,
        le=100.0,
        description="Within so many camera distances of what the cameras look at, voxels are half "
        "as large, if half of what they see is there, and unless a rendered pixel is larger; 0 for "
        "the same everywhere.",
    )
    num_views: int = Field(
        0, ge=0, le=5000, description="Training views fused, evenly picked; 0 for all."
    )
    render_long_side_px: int = Field(
        640, ge=64, le=4096, description="Long side of the rendered depth, in pixels."
    )
    refine: Literal["photos", "none"] = Field(
        "photos",
        description="photos moves the fused surface onto what the training photos agree on, a "
        "fraction of a voxel, and leaves out what no two of them show; none leaves it as fused.",
    )
    flatten: bool = Field(
        True,
        description="Floors, walls and table tops become plane where they are so but for bumps of "
        "a voxel or two, and as far as the photos do not say otherwise. Part of refine=photos.",
    )
    close_holes: float = Field(
        0.1,
        ge=0.0,
        le=10.0,
        description="Holes with a diameter of so many camera distances, or less, are closed, "
        "beyond max_distance of more as voxels are larger; not those that cameras look through, "
        "nor the border of what was filmed. 0 for none.",
    )
    watertight: bool = Field(
        False,
        description="Closes the mesh all over, so that each edge has two faces, as slicers of 3D "
        "printers want it: the border gets a wall to a flat base. With extent=subject and stl "
        "among the formats that is a thing to print, on its piece of table. It is done last: with "
        "triangles there are a few more.",
    )
    max_faces: int = Field(
        200_000,
        ge=100,
        le=20_000_000,
        description="What lies within fine_distance is simplified to this, what lies within "
        "max_distance too, and what lies beyond to a quarter of it a shell.",
    )
    triangles: int = Field(
        0,
        ge=0,
        le=20_000_000,
        description="Triangles of the whole mesh as it is delivered, 100000 for phones and the "
        "web; 0 for all that max_faces leaves. Open borders stay.",
    )
    lods: int = Field(
        0,
        ge=0,
        le=3,
        description="Levels of detail, glb whatever the formats: mesh-lod1.glb has a quarter of "
        "the mesh's triangles, mesh-lod2.glb a sixteenth, mesh-lod3.glb a sixty-fourth, each with "
        "a texture of half the side.",
    )

    glb_unlit: bool = Field(
        True,
        description="glb shows the captured colours as they are, light and all; off, the viewer's "
        "lamps light them once more.",
    )
    glb_quantized: bool = Field(
        False,
        description="glb with places in 65535 steps of the longest side and half the bytes a "
        "vertex (KHR_mesh_quantization), for three.js and the like; other programs may not know "
        "it.",
    )

    @field_validator("formats")
    @classmethod
    def _each_once(cls, formats: tuple[Format, ...]) -> tuple[Format, ...]:
        return tuple(dict.fromkeys(formats))


def run(scene: TrainedScene, options: MeshOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the mesh.

    Raises ExportError `empty_mesh` where the model shows no surface, `export.empty` where there is
    none in the crop.
    """
    # Imported where it runs: the API reads this file too.
    from pipelines.exports.chosen_crop import chosen_crop
    from pipelines.exports.crop import cropped, empty_crop, narrowed, surface_in
    from pipelines.exports.cutting import cut_out
    from pipelines.exports.formats import glb
    from pipelines.exports.levels import levels_of, texture_px_of
    from pipelines.exports.placement import placement_of
    from pipelines.exports.reduction import reduced
    from pipelines.exports.subject import find_subject
    from pipelines.exports.subject_files import as_dict, gaze_of, save_subject
    from pipelines.exports.subject_search import SEARCH_SHARE, search_subject
    from pipelines.exports.surface.holes import close_holes, hole_limits
    from pipelines.exports.surface.refinement import refined
    from pipelines.exports.surface.shells import Subject, affordable, find_shells, fuse_shells
    from pipelines.exports.surface.views import known_depths, render_views
    from pipelines.exports.surface.watertight import is_closed, made_watertight, why_open
    from pipelines.exports.texture.bake import painted
    from pipelines.exports.texture.told import skin_told
    from pipelines.scene.depth_views import Pinhole
    from pipelines.scene.stereo_views import stereo_view

    place = placement_of(options.frame, scene.cameras)
    frame = place.frame(options.up_axis)
    ctx.progress(0.0, "looking for the scene's bounds")
    images = scene.training_images(options.num_views)
    lenses = [Pinhole.of(scene.lens_of(image), options.render_long_side_px) for image in images]
    probes = scene.probe_views(ctx.check_cancelled)
    shells = find_shells(
        lambda distance: scene.bounds(distance, ctx.check_cancelled, probes),
        options.max_distance,
        reach_of(options),
        options.resolution,
        Subject(options.fine_distance, max(1.0 / lens.fl_x for lens in lenses), probes),
    )
    if not shells:
        raise _empty("no ray of the training views met a surface")
    known = known_depths(ctx.workspace, options.use_depth_maps)
    crop, told_crop = chosen_crop(
        options.crop, place, lambda: search_subject(scene, probes, known, ctx), ctx.logger
    )
    surface_in(crop, probes, shells[-1].bounds, "mesh")
    kept = [(shell, narrowed(shell.bounds, crop)) for shell in shells]
    shells = [replace(shell, bounds=bounds) for shell, bounds in kept if bounds is not None]
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder:
        shares = (SEARCH_SHARE, _RENDER_SHARE)
        store = render_views(scene, images, lenses, Path(folder), ctx, shares, known)
        asked, shells = (
            shells,
            affordable(
                store, shells, _part_of(ctx, "looking for surfaces", _RENDER_SHARE, _AFFORD_SHARE)
            ),
        )
        coarser = _coarser(asked, shells)
        if coarser is not None:
            ctx.logger.warning("The mesh is coarser than asked for: %s", coarser["reason"])
        method: Method = options.method
        told = _part_of(ctx, "fusing depth", _AFFORD_SHARE, _FUSE_SHARE)
        try:
            mesh = fuse_shells(
                store, shells, options.max_faces, told, method, scene.density, options.density_level
            )
        except ToolError as error:
            if method != "poisson":
                raise
            # Poisson's solver runs apart; there is a mesh without it, a little rougher.
            ctx.logger.warning("No Poisson surface, depth is fused in voxels instead: %s", error)
            method = "tsdf"
            mesh = fuse_shells(store, shells, options.max_faces, told, method)
        if len(mesh.faces) == 0:
            raise _empty(f"{len(images)} views show no surface within the bounds that two agree on")
        shown = scene.training_images()
        if options.refine == "photos":
            side = _photo_side([scene.lens_of(image) for image in shown])
            photos = [
                stereo_view(ctx.workspace.images_root, image, scene.lens_of(image), side)
                for image in shown
            ]
            mesh = refined(
                mesh,
                photos,
                _part_of(ctx, "refining", _FUSE_SHARE, _MEND_SHARE),
                flat=options.flatten,
                noise=max((shell.voxel for shell in shells if not shell.is_far), default=0.0),
            )
            del photos
        told = _part_of(ctx, "closing holes", _MEND_SHARE, _REFINE_SHARE)
        limits = hole_limits(shells, options.close_holes, options.max_distance)
        closing = close_holes(mesh, limits, store, told)
        mesh = closing.mesh
    gaze = gaze_of(shown, [scene.lens_of(image) for image in shown])
    decision = None
    if crop is None and options.extent != "scene":
        ctx.progress(_REFINE_SHARE, "looking for the subject")
        near = shells[0].bounds
        wanted = (near.focus, near.distance) if options.extent == "subject" else None
        decision = find_subject(mesh.vertices, mesh.faces, gaze, wanted)
    subject = None if decision is None else as_dict(decision)
    thing = None if decision is None else decision.thing
    if thing is not None and options.extent == "subject":
        mesh, thing = cut_out(mesh, thing), None
        if len(mesh.faces) == 0:
            raise _empty("nothing is left of the subject")
    elif options.extent == "subject" and crop is None:
        ctx.logger.warning("No subject was found; the mesh is what lies within max_distance.")
    whole, mesh = mesh, cropped(mesh, crop)
    if crop is not None and len(mesh.faces) == 0:
        raise empty_crop(crop, whole.vertices, "mesh")
    if options.triangles:
        told = _part_of(ctx, f"reducing {len(mesh.faces)} triangles", _REFINE_SHARE, _REDUCE_SHARE)
        told(0.0)
        mesh = reduced(mesh, options.triangles, told)
    if options.watertight:
        ctx.progress(_REDUCE_SHARE, "closing the mesh all over")
        carrier = decision.thing.carried_by if decision and decision.thing else None
        down = None if carrier is None else -carrier.normal
        mesh = made_watertight(mesh, down, lambda done: ctx.check_cancelled())
    watertight = is_closed(mesh.faces)
    if options.watertight and not watertight:
        ctx.logger.warning("The mesh is not watertight: %s", why_open(mesh.faces))
    each = (_TEXTURE_SHARE - _REDUCE_SHARE) / (1 + options.lods)

    def paint(shape: TriangleMesh, level: int) -> TriangleMesh | TexturedMesh:
        side = texture_px_of(level, options.texture_px)
        return painted(
            shape,
            shown,
            [scene.lens_of(image) for image in shown],
            options.model_copy(update={"texture_px": side}),
            ctx,
            (_REDUCE_SHARE + each * (level + 0.1), _REDUCE_SHARE + each * (level + 1)),
            scene,
        )

    # Without a texture to deliver there is none to be judged by either.
    textured = not _TEXTURED.isdisjoint(options.formats)
    skin = paint(mesh, 0) if textured or thing is not None else mesh
    delivered = skin if textured else mesh
    levels: list[dict[str, Any]] = []

    def on_level(done: float) -> None:
        begin = _REDUCE_SHARE + each * (len(levels) + 1)
        ctx.progress(begin + 0.1 * each * done, "reducing for a coarser level")

    for level, shape in enumerate(levels_of(mesh, options.lods, on_level), start=1):
        coarse, path = paint(shape, level), ctx.out / f"mesh-lod{level}.glb"
        glb.write_mesh(path, place.mesh(coarse), frame, style_of(options))
        levels.append({"file": path.name, **skin_told(coarse)})
    ctx.progress(_TEXTURE_SHARE, "writing")
    _write(place.mesh(mesh), place.mesh(delivered), options, ctx, frame)
    if thing is not None and subject is not None:
        ctx.progress(_SUBJECT_SHARE, "cutting out the subject")
        metric, style = scene.cameras.metric, style_of(options)
        subject |= save_subject(
            ctx.out, mesh, skin, thing, gaze, metric, style, ctx.check_cancelled
        )
    return {
        "frame": place.as_dict(),
        "formats": list(options.formats),
        "method": method,
        "num_vertices": len(mesh.vertices),
        **skin_told(delivered),
        "levels": levels,
        "num_views": len(images),
        "voxel": round(shells[0].voxel, 9),
        "coarser": coarser,
        "holes": closing.as_dict(),
        "watertight": watertight,
        "subject": subject,
        "crop": told_crop,
        "bounds": shells[0].bounds.as_dict(),
        "shells": [
            {"voxel": round(shell.voxel, 9), **shell.bounds.as_dict()} for shell in shells[1:]
        ],
    }


def _part_of(ctx: StageContext, message: str, begin: float, end: float) -> Callable[[float], None]:
    """What tells the share that is done of a part of the export."""
    return lambda done: ctx.progress(begin + (end - begin) * done, message, None)


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


def style_of(options: MeshOptions) -> GlbStyle:
    """How GLB files are written."""
    from pipelines.exports.formats.glb import GlbStyle

    return GlbStyle(options.glb_unlit, options.glb_quantized)


def _photo_side(lenses: Sequence[Intrinsics]) -> int:
    """The long side of the photos that refine the mesh, px."""
    squares = sum(min(lens.width, lens.height) / max(lens.width, lens.height) for lens in lenses)
    return min(_PHOTO_SIDE_PX, int((_PHOTOS_PX / squares) ** 0.5))


def _write(
    mesh: TriangleMesh,
    skin: TriangleMesh | TexturedMesh,
    options: MeshOptions,
    ctx: StageContext,
    frame: Frame,
) -> None:
    """The files, `mesh` with its vertices' colours and `skin` as it is painted, if it is."""
    from pipelines.exports.formats import glb, obj, ply, stl, usdz
    from pipelines.exports.judged import JUDGED_MESH

    writers: dict[Format, Callable[[Path], None]] = {
        "glb": lambda path: glb.write_mesh(path, skin, frame, style_of(options)),
        "ply": lambda path: ply.write_mesh(path, mesh, frame),
        "obj": lambda path: obj.write_mesh(path, skin, frame),
        "stl": lambda path: stl.write_mesh(path, mesh, frame),
        "usdz": lambda path: usdz.write_mesh(path, skin, frame),
    }
    for name in options.formats:
        ctx.check_cancelled()
        writers[name](ctx.out / _FILES[name])
    if "glb" not in options.formats:
        writers["glb"](ctx.out / JUDGED_MESH)


def _empty(why: str) -> ExportError:
    return ExportError(
        f"The mesh is empty: {why}.",
        code="empty_mesh",
        hint="Train longer, or raise mesh.max_distance; a low PSNR in evaluate means that the "
        "capture itself needs more overlap and light.",
    )


EXPORT = Export(
    kind="mesh",
    version=11,
    reads=("ingest", "frames", "depth"),
    run=run,
    options=MeshOptions,
    artifacts=(
        Artifact("mesh.glb", "mesh.glb", "model/gltf-binary", "any glTF viewer, Blender"),
        Artifact("subject.glb", "subject.glb", "model/gltf-binary", "any glTF viewer, Blender"),
        Artifact("subject.jpg", "subject.jpg", "image/jpeg", "any viewer"),
        Artifact(
            "mesh.ply", "mesh.ply", "application/octet-stream", "MeshLab, CloudCompare, Blender"
        ),
        Artifact(
            "mesh.obj.zip",
            "mesh.obj.zip",
            "application/zip",
            "unpacked: any 3D program",
            on_request=True,
        ),
        Artifact("mesh.stl", "mesh.stl", "model/stl", "slicers for 3D printing", on_request=True),
        Artifact(
            "mesh.usdz",
            "mesh.usdz",
            "model/vnd.usdz+zip",
            "iPhone, iPad, Mac, Blender",
            on_request=True,
        ),
        *(
            Artifact(
                f"mesh-lod{level}.glb",
                f"mesh-lod{level}.glb",
                "model/gltf-binary",
                "any glTF viewer, Blender",
                on_request=True,
            )
            for level in (1, 2, 3)
        ),
    ),
)
