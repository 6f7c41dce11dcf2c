"""A tiny job on disk: the analytic scene at 64 px, trained for a few steps with small networks."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

from PIL import Image

from pipelines.captures.record import CaptureRecord
from pipelines.manifest import RunHooks, run_stage
from pipelines.options import resolve_options
from pipelines.registry import get_stage
from pipelines.sample.film import SAMPLE_TAKE, phone_camera, render_all, walk
from pipelines.sample.takes import Take
from pipelines.workspace import MANIFEST, Workspace

NUM_IMAGES = 20
LONG_SIDE = 64
_GRID = {"num_levels": 4, "log2_table_size": 12, "max_res": 64}
OPTIONS: dict[str, Any] = {
    "train": {
        "max_steps": 400,
        "rays_per_step": 512,
        "device": "cpu",
        "preview_every_steps": 200,
        "model": {
            "num_proposal_samples": [32],
            "num_nerf_samples": 16,
            "proposals": [{"grid": _GRID}],
            "grid": {"num_levels": 8, "log2_table_size": 13, "max_res": 256},
            "hidden_dim": 32,
            "hidden_dim_color": 32,
            "appearance_dim": 4,
            "camera_mode": "so3xr3",
            "anneal_steps": 50,
        },
        "data": {"long_side_px": LONG_SIDE},
        # A rate that is still high at the end: these few steps are cut off from a longer run.
        "optimizer": {
            "decay": "exponential",
            "decay_steps": 1500,
            "lr_final": 1e-3,
            "table_decay": 0.0,
        },
    },
    "mesh": {"resolution": 64, "num_views": 12, "render_long_side_px": 64, "max_faces": 3000},
    "pointcloud": {"num_points": 4000},
    "video": {"num_frames": 12, "long_side_px": 64},
    "views": {"num_views": 3, "long_side_px": 64},
    "meshvideo": {"num_frames": 12, "long_side_px": 64},
}


def options_of(stage: str, **changes: Any) -> dict[str, Any]:
    """The tiny options of a stage, with changes laid over them."""
    overrides = {**OPTIONS, stage: {**OPTIONS.get(stage, {}), **changes}}
    return resolve_options("preview", overrides, is_request=False)[stage]


def make_capture(
    root: Path,
    num_images: int = NUM_IMAGES,
    take: Take = SAMPLE_TAKE,
    long_side_px: int = LONG_SIDE,
) -> Workspace:
    """A posed capture as `ingest` leaves it, with a manifest that says that it is complete."""
    workspace = Workspace(root)
    folder = workspace.stage("ingest")
    (folder / "images").mkdir(parents=True)
    truth = walk(max(num_images, 2), phone_camera(long_side_px), take=take)
    pictures = render_all(truth, 1, take)
    images = []
    for image, picture in zip(truth.images[:num_images], pictures, strict=False):
        file = f"images/{image.file}.png"
        Image.fromarray(picture).save(folder / file)
        images.append(dataclasses.replace(image, file=file))
    dataclasses.replace(truth, images=tuple(images)).save(folder / "cameras.json")
    CaptureRecord(
        kind="nerfstudio",
        filename="tiny.zip",
        sha256=hashlib.sha256(b"tiny").hexdigest(),
        num_images=num_images,
        images=[{"file": image.file} for image in images],
        details={"num_posed": num_images, "num_listed": num_images + 5, "num_missing": 3},
        warnings=["transforms.json lists 3 pictures that are not there."],
    ).save(folder)
    # The capture is made here instead of by ingest, so its manifest is, too.
    (folder / MANIFEST).write_text(
        '{"stage": "ingest", "content": "tiny", "summary": {"kind": "nerfstudio"},'
        ' "timings": {"wall_s": 0.5}, "options": {}, "files": []}',
        "utf-8",
    )
    return workspace


def run(workspace: Workspace, stage: str, **changes: Any) -> dict[str, Any]:
    """Run a stage with the tiny options and publish it; its manifest."""
    return run_stage(get_stage(stage), options_of(stage, **changes), workspace, seed=3)


def run_with(workspace: Workspace, stage: str, hooks: RunHooks, **changes: Any) -> dict[str, Any]:
    """The same with hooks."""
    values = options_of(stage, **changes)
    return run_stage(get_stage(stage), values, workspace, seed=3, hooks=hooks)
