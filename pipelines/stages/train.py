"""The train stage: fit the model to the posed images.

Reads `cameras.json` of `poses` or `ingest`, the images beside it and the maps of `depth`. Writes
`model.zip` (all that is needed to render again without the capture), `cameras.json` (world frame;
training cameras as training corrected them, held-out ones as they came) and `previews/`, pictures
of a held-out view as training goes on. Goes on from its checkpoint after a failed attempt.
"""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pipelines.captures.minimum import MIN_POSED_IMAGES
from pipelines.errors import TrainingError
from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.data.images import ImageData, load_images, split_indices
from pipelines.nerf.data.plain_share import unknown_plain_share
from pipelines.nerf.devices import choose_device
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.camera_optimizer import CameraOptimizer, se3_exp, so3_exp
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.training.checkpoint import load_checkpoint, save_model
from pipelines.nerf.training.loop import TrainProgress, train
from pipelines.nerf.training.state import is_fast
from pipelines.option_models import StageOptions
from pipelines.options import resolve_options, stage_options, train_config
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.natural_order import natural_key
from pipelines.scene.trained_scene import (
    as_uint8,
    nerf_cameras,
    nerf_errors_as,
    use_all_cores,
)
from pipelines.stage import StageContext

_PREVIEW_LONG_SIDE = 320
_PSNR_STEPS = 50
_CHECKPOINT, _PROGRESS = "training.pt", "progress.json"
_TRAIN_SHARE = 0.98
_LEAST_UNKNOWN = 0.36
"""Of what is plain, that no map knows, for plain lines: where maps know the most of it, what they
mistake at the rims of things goes on into the rest (docs/surfaces-experiments.md)."""


@dataclass(frozen=True)
class _Inputs:
    """What training sees.

    capture: sorted by name, with the split marked. depth: of the images that are trained on.
    """

    capture: CamerasFile
    cameras: Cameras
    images: ImageData
    train: list[int]
    test: list[int]
    scene: SceneTransform
    depth: DepthMaps | None


def run(options: StageOptions, ctx: StageContext) -> dict[str, Any]:
    """Train. Raises TrainingError: too_few_images, bad_image, non_finite_loss and the like."""
    use_all_cores()
    config = train_config(options)
    with nerf_errors_as(TrainingError):
        _compile_kernels(config, ctx)
        ctx.progress(0.0, "loading images")
        inputs = _load(config, ctx)
        unknown = _unknown(config, inputs)
        config = decided(config, unknown)
        watcher = _Watcher(inputs, ctx)
        model = _train(inputs, config, ctx, watcher)
    ctx.progress(_TRAIN_SHARE, "saving the model")
    capture, deltas = corrected_cameras(inputs.capture, inputs.train, model.cameras_delta, inputs)
    capture.save(ctx.out / "cameras.json")
    width, height = _typical_size(inputs.images)
    device = next(model.parameters()).device
    extras = {
        "cameras": capture.as_dict(),
        "train": asdict(config),
        "width": width,
        "height": height,
        "seed": ctx.seed,
    }
    save_model(ctx.out / "model.zip", model, inputs.scene, extras)
    return {
        **watcher.summary(),
        "num_train": len(inputs.train),
        "num_test": len(inputs.test),
        "width": width,
        "height": height,
        "device": device.type,
        "engine": model.engine,
        "warnings": engine_warnings(config, device, model.engine),
        "plain_unknown": unknown,
        "plain_lines": config.flat.when == "always",
        "camera_deltas": deltas,
    }


def decided(config: TrainConfig, unknown: float | None) -> TrainConfig:
    """The run with what is to be decided by the capture.

    unknown: share of what is plain in its pictures that depth maps do not know; None where the
    options decide.
    """
    if unknown is None:
        return config
    when = "always" if unknown >= _LEAST_UNKNOWN else "never"
    return replace(config, flat=replace(config.flat, when=when))


def _unknown(config: TrainConfig, inputs: _Inputs) -> float | None:
    """What `decided` is to be told."""
    if config.flat.when != "unknown" or config.flat.weight == 0.0:
        return None
    found = unknown_plain_share(
        inputs.images, inputs.train, inputs.cameras, inputs.depth, config.flat
    )
    return round(found, 3)


def engine_warnings(config: TrainConfig, device: torch.device, engine: str) -> list[dict[str, Any]]:
    """What a person should know of how a GPU trained: {code, message, hint, details}.

    engine: that trained. "auto" trains with PyTorch's own operations where ours do not work.
    """
    if device.type != "cuda" or config.engine != "auto" or engine == "fast":
        return []
    # Imported here: a machine without a GPU needs no Triton.
    from pipelines.nerf.engines.gpu.self_check import engine_problem

    problem = engine_problem(config, device)
    if problem is None:
        return []
    return [
        {
            "code": "slow_engine",
            "message": "The GPU trained some ten times slower than it can, since its compiled "
            f"engine did not work: {problem}",
            "hint": "The job's log of `train` says more, and the worker's log at its start. Most "
            "often a C compiler or the headers of Python are missing, or closed to stages.",
            "details": {"problem": problem},
        }
    ]


def preload() -> None:
    """Load compiled kernels, so that the first run of this process need not: for idle moments."""
    config = train_config(stage_options("train", resolve_options("preview", {})["train"]))
    if _uses_kernels(config):
        from pipelines.nerf.compiling import load_compiled

        load_compiled(config)


def _compile_kernels(config: TrainConfig, ctx: StageContext) -> None:
    """Wait for the kernels where this machine has not compiled them yet.

    Before the first step, so that no estimate of the time left counts it.
    """
    if _uses_kernels(config):
        # Imported here: a machine that trains on a GPU never loads the compiler.
        from pipelines.nerf.compiling import compile_kernels

        def on_progress(done: int, known: int) -> None:
            count = f" {done}/{known}" if known else ""
            ctx.progress(0.0, f"compiling kernels{count}, only the first time")

        compile_kernels(config, on_progress)


def _uses_kernels(config: TrainConfig) -> bool:
    device = choose_device(config.device)
    return device.type == "cpu" and is_fast(config, device)


def _load(config: TrainConfig, ctx: StageContext) -> _Inputs:
    """Images and cameras at the training size, the split, and the scene's place in the world."""
    given = CamerasFile.load(ctx.workspace.posed_cameras)
    ordered = tuple(sorted(given.images, key=lambda image: natural_key(image.file)))
    if len(ordered) < MIN_POSED_IMAGES:
        raise TrainingError(
            f"{len(ordered)} posed images are too few to train on, at least {MIN_POSED_IMAGES} are "
            "needed.",
            code="too_few_images",
            hint="Send a longer video or more photos, with overlap.",
        )
    train_indices, test_indices = split_indices(len(ordered), config.data)
    held_out = set(test_indices)
    maps = _held_maps(ctx)
    lit = ordered if maps is None else maps.lit(ordered)
    marked = tuple(
        replace(image, split="test" if index in held_out else "train")
        for index, image in enumerate(lit)
    )
    capture = replace(given, images=marked)
    poses = np.asarray([image.world_from_camera for image in marked], np.float64)
    scene = SceneTransform.fit(poses[:, :, 3], scale_poses=config.data.scale_poses)
    lenses = [capture.cameras[image.camera] for image in marked]
    cameras = nerf_cameras(lenses, poses, scene).resized(config.data.long_side_px)
    root = ctx.workspace.images_root
    images = load_images(
        [_inside(root, image.file) for image in marked],
        config.data.long_side_px,
        [None if image.mask is None else _inside(root, image.mask) for image in marked],
        lights=[image.light for image in marked],
        max_bytes=int(config.data.max_memory_gib * 2**30),
    )
    depth = _depth_maps(maps, [marked[index].file for index in train_indices], scene, config)
    return _Inputs(capture, cameras, images, train_indices, test_indices, scene, depth)


def _held_maps(ctx: StageContext) -> DepthMapsFile | None:
    """What the stage `depth` left, if it ran."""
    if not ctx.workspace.is_complete("depth"):
        return None
    return DepthMapsFile(ctx.workspace.stage("depth"))


def _depth_maps(
    held: DepthMapsFile | None, files: list[str], scene: SceneTransform, config: TrainConfig
) -> DepthMaps | None:
    """The maps of the images that are trained on, or None without any."""
    if held is None or config.depth.weight == 0.0 or len(held) == 0:
        return None
    if [image.file for image in held.images] != files:
        raise TrainingError(
            "The depth maps are not those of the images that are trained on.",
            code="depth_maps_outdated",
            hint="Run depth again with the same train.data: maps must not know held-out images.",
        )
    lenses = [image.lens for image in held.images]
    return DepthMaps.from_arrays(
        [np.where(found.is_void, np.float32(np.inf), found.z) for _, found in held],
        [(lens.fl_x, lens.fl_y, lens.cx, lens.cy) for lens in lenses],
        scene.scale,
    )


def _inside(root: Path, relative: str) -> Path:
    """The file, which must exist below `root`."""
    path = root / relative
    if not path.is_file():
        raise TrainingError(
            f"The image {relative} is named by cameras.json and is not there.",
            code="bad_image",
            hint="Start the job again from its capture.",
        )
    return path


def _train(inputs: _Inputs, config: TrainConfig, ctx: StageContext, watcher: _Watcher) -> Model:
    """Train, going on from the checkpoint; one that cannot be used is dropped."""
    checkpoint = ctx.checkpoint / _CHECKPOINT
    ctx.checkpoint.mkdir(parents=True, exist_ok=True)
    if checkpoint.exists():
        try:
            step = load_checkpoint(checkpoint)["step"]
            ctx.logger.info("going on from step %s", step)
            watcher.resume(int(step))
        except NerfError as error:
            ctx.logger.warning("training starts again: %s", error.message)
            checkpoint.unlink()
    try:
        return _fit(inputs, config, ctx, watcher)
    except NerfError as error:
        if error.code != "bad_checkpoint" or not checkpoint.exists():
            raise
        ctx.logger.warning("training starts again: %s", error.message)
        checkpoint.unlink()
        return _fit(inputs, config, ctx, watcher)


def _fit(inputs: _Inputs, config: TrainConfig, ctx: StageContext, watcher: _Watcher) -> Model:
    return train(
        inputs.images,
        inputs.cameras,
        inputs.train,
        config,
        seed=ctx.seed,
        depth=inputs.depth,
        checkpoint_path=ctx.checkpoint / _CHECKPOINT,
        on_progress=watcher.on_progress,
        on_preview=watcher.on_preview,
        on_checkpoint=watcher.on_checkpoint,
        wants_checkpoint=ctx.is_shutdown,
    )


class _Watcher:
    """Turns the loop's calls into progress, previews, a kept checkpoint, and at last a summary."""

    def __init__(self, inputs: _Inputs, ctx: StageContext) -> None:
        self._inputs = inputs
        self._ctx = ctx
        self._psnr: deque[float] = deque(maxlen=_PSNR_STEPS)
        self._last: dict[str, Any] = {"num_steps": 0}

    def resume(self, step: int) -> None:
        """Recall what was last known, for a run that had already reached its end."""
        kept = self._ctx.checkpoint / _PROGRESS
        self._last = {"num_steps": step}
        if kept.is_file():
            self._last = {**json.loads(kept.read_text("utf-8")), "num_steps": step}

    def on_progress(self, progress: TrainProgress) -> None:
        if math.isfinite(progress.psnr):
            self._psnr.append(progress.psnr)
        psnr = sum(self._psnr) / max(1, len(self._psnr))
        self._last = {
            "num_steps": progress.step,
            "losses": {name: round(value, 6) for name, value in progress.losses.items()},
            "train_psnr": round(psnr, 3),
            "rays_per_s": round(progress.rays_per_s, 1),
            "elapsed_s": round(progress.elapsed_s, 2),
        }
        if progress.loss_scale is not None:
            self._last["loss_scale"] = progress.loss_scale
        message = f"step {progress.step}/{progress.max_steps}, {psnr:.1f} dB"
        self._ctx.progress(_TRAIN_SHARE * progress.fraction, message, progress.eta_s)

    def on_preview(self, step: int, model: Model) -> None:
        self._ctx.check_cancelled()
        watched = (self._inputs.test or self._inputs.train)[0]
        cameras = self._inputs.cameras.select([watched]).resized(_PREVIEW_LONG_SIDE)
        picture = Renderer(model, self._inputs.scene).render(cameras, 0)
        folder = self._ctx.out / "previews"
        folder.mkdir(exist_ok=True)
        Image.fromarray(as_uint8(picture.rgb)).save(folder / f"step_{step:06d}.jpg", quality=85)

    def on_checkpoint(self) -> None:
        (self._ctx.checkpoint / _PROGRESS).write_text(json.dumps(self._last), "utf-8")
        self._ctx.checkpoint_saved()

    def summary(self) -> dict[str, Any]:
        return dict(self._last)


def corrected_cameras(
    capture: CamerasFile, train_indices: list[int], delta: CameraOptimizer, inputs: _Inputs
) -> tuple[CamerasFile, dict[str, float]]:
    """The capture with training's corrections applied to its training cameras, and their size.

    A correction turns about the camera centre in world axes and shifts in scene units.
    """
    rotations, shifts = _corrections(delta, len(train_indices))
    shifts = shifts / inputs.scene.scale
    images: list[PosedImage] = list(capture.images)
    for row, index in enumerate(train_indices):
        pose = np.asarray(images[index].world_from_camera, np.float64)
        moved = np.column_stack((rotations[row] @ pose[:, :3], pose[:, 3] + shifts[row]))
        plain = tuple(tuple(float(value) for value in line) for line in moved)
        images[index] = replace(images[index], world_from_camera=plain)
    traces = np.trace(rotations, axis1=1, axis2=2)
    angles = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    lengths = np.linalg.norm(shifts, axis=1)
    deltas = {
        "mean_translation": float(lengths.mean()),
        "max_translation": float(lengths.max()),
        "mean_rotation_deg": float(angles.mean()),
        "max_rotation_deg": float(angles.max()),
    }
    notes = {
        **capture.notes,
        "training": "Poses of the training images carry the corrections that training found; "
        "poses of the held-out images are as they came.",
        "camera_optimizer": delta.mode,
        "camera_deltas": deltas,
    }
    return replace(capture, images=tuple(images), notes=notes), deltas


def _corrections(
    delta: CameraOptimizer, num: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations [N, 3, 3] and translations [N, 3], scene units, of the training cameras."""
    if delta.mode == "off":
        return np.tile(np.eye(3), (num, 1, 1)), np.zeros((num, 3))
    tangent = delta.corrections().detach().cpu().double()
    if delta.mode == "se3":
        rotation, shift = se3_exp(tangent)
    else:
        rotation, shift = so3_exp(tangent[:, 3:]), tangent[:, :3]
    return rotation.numpy(), shift.numpy()


def _typical_size(images: ImageData) -> tuple[int, int]:
    """The most common (width, height) that was trained on."""
    sizes, counts = torch.unique(images.sizes, dim=0, return_counts=True)
    width, height = sizes[int(counts.argmax())].tolist()
    return int(width), int(height)
