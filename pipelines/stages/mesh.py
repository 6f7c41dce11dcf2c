"""The mesh stage: rendered depth fused into a coloured mesh, as PLY and GLB.

Reads `train/model.zip`. Writes `mesh.ply` (world frame of cameras.json, vertex colours and normals)
and `mesh.glb` (+Y up, as glTF demands).
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.depth_views import Pinhole, ViewStore
from pipelines.errors import ExportError
from pipelines.glb import write_glb
from pipelines.options import MeshOptions, render_config
from pipelines.ply import write_mesh
from pipelines.scene_bounds import SceneBounds
from pipelines.stage import StageContext
from pipelines.trained_scene import TrainedScene
from pipelines.tsdf import TriangleMesh, clean, fuse

_RENDER_SHARE, _FUSE_SHARE = 0.75, 0.95


def run(options: MeshOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the mesh. Raises ExportError `empty_mesh` where the model shows no surface."""
    scene = TrainedScene.load(ctx.workspace.stage("train") / "model.zip", render_config(options))
    ctx.progress(0.0, "looking for the scene's bounds")
    bounds = scene.bounds(options.max_distance, ctx.check_cancelled)
    if bounds is None:
        raise _empty("no ray of the training views met a surface")
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder:
        store = _render(scene, options, ctx, Path(folder))

        def on_view(done: int) -> None:
            share = _FUSE_SHARE - _RENDER_SHARE
            ctx.progress(_RENDER_SHARE + share * done / len(store), "fusing depth", None)

        fused = fuse(store, bounds, options.resolution, on_view)
    ctx.progress(_FUSE_SHARE, f"cleaning {len(fused.faces)} faces")
    mesh = clean(fused, bounds, options.max_faces)
    if len(mesh.faces) == 0:
        raise _empty(f"{len(store)} views show no surface within the bounds that two agree on")
    ctx.progress(0.98, "writing")
    _write(mesh, ctx.out)
    return _summary(mesh, bounds, len(store), options.resolution)


def _render(
    scene: TrainedScene, options: MeshOptions, ctx: StageContext, folder: Path
) -> ViewStore:
    """Depth views of training cameras, evenly picked, in a store on disk."""
    images = scene.training_images()
    wanted = min(options.num_views or len(images), len(images))
    picked = np.unique(np.linspace(0, len(images) - 1, wanted).round().astype(int))
    store = ViewStore(folder)
    started = time.monotonic()
    for done, index in enumerate(picked, start=1):
        image = images[index]
        lens = Pinhole.of(scene.lens_of(image), options.render_long_side_px)
        store.append(scene.depth_view(lens, np.asarray(image.world_from_camera, np.float64)))
        eta = (time.monotonic() - started) / done * (len(picked) - done)
        ctx.progress(_RENDER_SHARE * done / len(picked), f"view {done}/{len(picked)}", eta)
    return store


def _write(mesh: TriangleMesh, folder: Path) -> None:
    colors = np.rint(255.0 * mesh.colors).astype(np.uint8)
    write_mesh(folder / "mesh.ply", mesh.vertices, mesh.faces, colors, mesh.normals)
    write_glb(folder / "mesh.glb", mesh.vertices, mesh.faces, mesh.colors, mesh.normals)


def _summary(
    mesh: TriangleMesh, bounds: SceneBounds, num_views: int, resolution: int
) -> dict[str, Any]:
    return {
        "num_vertices": len(mesh.vertices),
        "num_faces": len(mesh.faces),
        "num_views": num_views,
        "voxel": round(bounds.longest_side / resolution, 9),
        "bounds": bounds.as_dict(),
    }


def _empty(why: str) -> ExportError:
    return ExportError(
        f"The mesh is empty: {why}.",
        code="empty_mesh",
        hint="Train longer, or raise mesh.max_distance; a low PSNR in evaluate means that the "
        "capture itself needs more overlap and light.",
    )
