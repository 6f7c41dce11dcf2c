"""The mesh: rendered depth fused into triangles, in the formats asked for.

All of them lie in one frame, the world of cameras.json unless another is asked for
(`pipelines.exports.frame`); GLB, USDZ and OBJ have +Y up.
GLB, OBJ and USDZ have a texture from the training photos or the trained field, PLY the field's
colours on its vertices, STL is shape alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipelines.exports.export import Export
from pipelines.exports.mesh_options import MeshOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.trained_scene import TrainedScene


def run(scene: TrainedScene, options: MeshOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the mesh.

    Raises ExportError `empty_mesh` where the model shows no surface, `export.empty` where there is
    none in the crop.
    """
    # Imported where it runs: the API reads this file too.
    from pipelines.exports.mesh_files import Painter, write_levels, write_mesh, write_subject
    from pipelines.exports.mesh_shape import finished, part_of, plan_of, surface_of
    from pipelines.exports.placement import placement_of
    from pipelines.exports.surface.surface_file import save_surface
    from pipelines.exports.surface.watertight import is_closed
    from pipelines.exports.texture.told import skin_told

    place = placement_of(options.frame, scene.cameras)
    plan = plan_of(scene, options, place, ctx)
    surface = surface_of(scene, options, plan, ctx)
    save_surface(ctx.out, surface.mesh, surface.shells)
    part = finished(part_of(options, plan, surface, ctx), options, ctx)
    paint = Painter(scene, options, ctx)
    # Without a texture to deliver there is none to be judged by either.
    skin = paint(part.mesh, 0) if paint.is_delivered or part.thing is not None else part.mesh
    delivered = skin if paint.is_delivered else part.mesh
    levels = write_levels(part.mesh, paint, place)
    write_mesh(part.mesh, delivered, options, place, ctx)
    subject = part.subject
    if part.thing is not None and subject is not None:
        subject |= write_subject(part, part.thing, skin, options, scene, ctx)
    shells = surface.shells
    return {
        "frame": place.as_dict(),
        "formats": list(options.formats),
        "method": surface.method,
        "num_vertices": len(part.mesh.vertices),
        **skin_told(delivered),
        "levels": levels,
        "num_views": len(plan.images),
        "voxel": round(shells[0].voxel, 9),
        "coarser": surface.coarser,
        "holes": surface.holes,
        "watertight": is_closed(part.mesh.faces),
        "subject": subject,
        "crop": plan.told_crop,
        "bounds": shells[0].bounds.as_dict(),
        "shells": [
            {"voxel": round(shell.voxel, 9), **shell.bounds.as_dict()} for shell in shells[1:]
        ],
    }


EXPORT = Export(
    kind="mesh",
    version=33,
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
