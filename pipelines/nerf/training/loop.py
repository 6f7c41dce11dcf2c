"""Fitting a model to images: one loop, top to bottom.

A run is decided by its images, cameras, config and seed. What it needs to go on is in the
checkpoint, so a resumed run on a CPU ends with the parameters of an uninterrupted one. Which images
are used and where the files lie is left to the caller.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from pipelines.nerf.data.depth_maps import DepthMaps, DepthSupervision
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import PixelSampler, block_side
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.devices import choose_device
from pipelines.nerf.engines.gpu.step import StepLosses
from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.metrics import psnr_from_mse
from pipelines.nerf.models.base import Model
from pipelines.nerf.options.train import GuidedConfig, TrainConfig, validate
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.training.checkpoint import load_checkpoint, save_checkpoint
from pipelines.nerf.training.gpu_steps import EngineLost, GpuSteps, StepShape
from pipelines.nerf.training.guided_steps import GuidedSteps
from pipelines.nerf.training.state import (
    TrainingState,
    initial_state,
    is_fast,
    learning_rates,
    pixel_device,
)

TIMED_STEPS = 50
STEPS_PER_CUDA_REPORT = 20
PREVIEWS_PER_RUN = 10
LEAST_SCALE = 2.0**-10
"""Of the loss: every gradient since it was 8 per ray, or more, was not finite."""


@dataclass(frozen=True)
class TrainProgress:
    """How far training is, after `step` of `max_steps` steps.

    fraction: share of the run that is done, [0, 1]; by time where `max_seconds` ends it earlier.
    losses: weighted terms of the last step by name. psnr: of its batch, dB. elapsed_s: training
    time of all attempts. eta_s: time left at the pace of the last steps, or None before any.
    loss_scale: what the loss is multiplied by for half precision; None where it is not.
    """

    step: int
    max_steps: int
    fraction: float
    losses: dict[str, float]
    psnr: float
    elapsed_s: float
    eta_s: float | None
    rays_per_s: float
    loss_scale: float | None = None


def train(
    images: ImageData,
    cameras: Cameras,
    train_indices: Sequence[int],
    config: TrainConfig,
    *,
    seed: int,
    depth: DepthMaps | None = None,
    checkpoint_path: Path | None = None,
    on_progress: Callable[[TrainProgress], None] = lambda progress: None,
    on_preview: Callable[[int, Model], None] = lambda step, model: None,
    on_checkpoint: Callable[[], None] = lambda: None,
    wants_checkpoint: Callable[[], bool] = lambda: False,
) -> Model:
    """Fit a model; returned in `eval()` on the device it was trained on.

    images, cameras: all N, of the same sizes (`Cameras.resized`). train_indices: those learned
    from; appearance codes and camera corrections follow this order.
    depth: maps of the images that are learned from, in their order; `config.depth` says what they
        are used for. seed: decides the start and every draw.
    checkpoint_path: gone on from where it exists and fits these options, written every
        `checkpoint_seconds` and at the end.
    on_progress: after each step on a CPU, every 20th on a GPU; may raise, which ends the run and
    leaves the last checkpoint as it was. on_preview: step and model in `eval()`, at the preview
    interval; its time does not count as training. on_checkpoint: a checkpoint is complete.
    wants_checkpoint: asked before each report of progress; the state is saved where it says so.
    Raises NerfError: bad_config, bad_cameras, bad_checkpoint, too_few_images, non_finite_loss,
    bad_depth_maps, gpu_failed, gpu_lost.
    """
    validate(config)
    _check_sizes(images, cameras, train_indices)
    device = choose_device(config.device)
    supervision = _supervision(depth, len(train_indices), config, device)
    posed = cameras.select(train_indices)
    fingerprint = _fingerprint(config, seed, posed, supervision)
    pixels_on = pixel_device(config, device, images.nbytes)
    state = initial_state(config, len(train_indices), seed, device, pixels_on)
    state.model.cameras_delta.keep_frame(posed.scene_from_camera)
    if checkpoint_path is not None and checkpoint_path.exists():
        _resume(state, checkpoint_path, fingerprint)
    pixels_on = state.pixel_random.device
    sampler = PixelSampler(images, train_indices, pixels_on, PlainLines.of(config))
    posed = posed.to(device)
    state.model.train()
    graphs = _gpu_steps(state, sampler, posed, config, supervision)
    guided = None if graphs is not None else GuidedSteps.of(config, state.model, supervision)
    preview_every = config.preview_every_steps or max(1, config.max_steps // PREVIEWS_PER_RUN)
    step_times: deque[float] = deque(maxlen=TIMED_STEPS)
    step_rays: deque[int] = deque(maxlen=TIMED_STEPS)
    last_saved = time.monotonic()

    def save() -> None:
        if checkpoint_path is not None:
            save_checkpoint(checkpoint_path, {"fingerprint": fingerprint, **state.as_dict()})
            on_checkpoint()

    while state.step < config.max_steps and not _time_is_up(state.elapsed_s, config):
        started = time.monotonic()
        is_reported = device.type == "cpu" or state.step % STEPS_PER_CUDA_REPORT == 0
        shape = begin_step(state, config)
        num_rays = shape.num_rays if guided is None else guided.num_rays(state.step, shape.num_rays)
        try:
            if graphs is not None:
                losses = graphs.run(config, shape, check=is_reported)
                _require_learning(losses)
            else:
                losses = optimise_once(
                    state,
                    sampler,
                    posed,
                    config,
                    shape,
                    depth=supervision,
                    guided=guided,
                    check=is_reported,
                )
        except EngineLost:
            graphs = None
            continue  # the state is that of an earlier step, for the plain engine
        except NonFiniteLoss:
            if _is_finite(state.model):
                save()
            raise
        step_times.append(time.monotonic() - started)
        step_rays.append(num_rays)
        state.elapsed_s += step_times[-1]
        if losses is not None:
            if wants_checkpoint():
                save()
                last_saved = time.monotonic()
            on_progress(_progress(state, config, losses, step_times, step_rays))
        if time.monotonic() - last_saved >= config.checkpoint_seconds:
            save()
            last_saved = time.monotonic()
        if state.step % preview_every == 0:
            with torch.no_grad():
                on_preview(state.step, state.model.eval())
            state.model.train()
    save()
    for parameter in state.model.parameters():
        parameter.grad = None
    return state.model.eval()


def _supervision(
    maps: DepthMaps | None, num_images: int, config: TrainConfig, device: torch.device
) -> DepthSupervision | None:
    """The maps as a loss, where there are any and the options use them."""
    if maps is None or config.depth.weight == 0.0 or maps.num_known == 0:
        return None
    if len(maps) != num_images:
        raise NerfError(
            "bad_depth_maps",
            f"There are {len(maps)} depth maps for {num_images} training images.",
            "Give one for each image that is learned from, in their order.",
        )
    return DepthSupervision(maps.to(device), config.depth, config.max_steps)


def _gpu_steps(
    state: TrainingState,
    sampler: PixelSampler,
    cameras: Cameras,
    config: TrainConfig,
    depth: DepthSupervision | None,
) -> GpuSteps | None:
    """The steps of the GPU engine, where it trains this run."""
    device = cameras.focal.device
    if device.type != "cuda" or not is_fast(config, device):
        return None
    return GpuSteps(state, sampler, cameras, depth=depth)


def begin_step(state: TrainingState, config: TrainConfig) -> StepShape:
    """Bring the model to the step that is due."""
    levels = state.model.begin_step(state.step)
    num_rays = state.model.rays_of_step(config.rays_per_step)
    return StepShape(num_rays, block_side(state.step, config.data), levels)


def optimise_once(
    state: TrainingState,
    sampler: PixelSampler,
    cameras: Cameras,
    config: TrainConfig,
    shape: StepShape,
    *,
    depth: DepthSupervision | None = None,
    guided: GuidedSteps | None = None,
    check: bool,
) -> StepLosses | None:
    """One step: pixels -> rays -> model -> losses -> Adam.

    guided: which steps are told where to look. check: read the losses, which waits for the GPU;
    None unread.
    """
    model = state.model
    device = cameras.focal.device
    rates = learning_rates(config, state.step)
    for name, optimizer in state.optimizers.items():
        for group in optimizer.param_groups:
            group["lr"] = rates[name]
    plan = model.plan_step(state.step, state.model_random)

    sampler.block = shape.block
    known = None
    if guided is not None and guided.is_due(state.step):
        known = guided.batch(state, plan, sampler, cameras)
    lines = sampler.lines if known is None else None
    if known is not None:
        plan, rays, colors = known
    else:
        drawn = sampler.draw_batch(shape.num_rays, state.pixel_random)
        index, pixels, colors, plain = (item.to(device) for item in drawn)
        rays = cameras.generate_rays(index, pixels)
    with torch.autocast(device.type, dtype=torch.float16, enabled=device.type == "cuda"):
        outputs = model(rays, plan=plan, generator=state.model_random)
        losses = model.loss_dict(outputs, colors, plan=plan)
    if depth is not None:
        term = depth.loss(outputs, rays, cameras, *depth.schedule(state.step))
        losses = losses if term is None else {**losses, "depth": term}
    if lines is not None:
        weight = lines.weight(state.step)
        maps = None if depth is None else depth.maps
        term = lines.loss(outputs, rays, cameras, plain, weight, maps)
        losses = losses if term is None else {**losses, "flat": term}
    values = _checked_values(losses, state.step) if check else {}
    scale = state.scaler.get_scale() if check and state.scaler.is_enabled() else None

    for optimizer in state.optimizers.values():
        optimizer.zero_grad()  # what gets no gradient is left alone: proposals between updates
    total = torch.stack(list(losses.values())).sum()
    torch.autograd.backward(state.scaler.scale(total))
    for optimizer in state.optimizers.values():
        state.scaler.step(optimizer)
    state.scaler.update()

    state.step += 1
    if known is None:  # the sampler's own networks count the steps that ask them
        model.finish_step(plan)
    return StepLosses(state.step - 1, values, scale) if check else None


def _resume(state: TrainingState, path: Path, fingerprint: str) -> None:
    saved = load_checkpoint(path)
    if saved["fingerprint"] != fingerprint:
        raise NerfError(
            "bad_checkpoint",
            "The checkpoint belongs to a run with other options, images or seed.",
            "Remove it to train from the start.",
        )
    state.restore(saved)


class NonFiniteLoss(NerfError):
    """A loss is NaN or infinite; nothing was learned from that step."""


def _checked_values(losses: dict[str, Tensor], step: int) -> dict[str, float]:
    values = {name: float(loss.detach()) for name, loss in losses.items()}
    _require_finite(values, step)
    return values


def _require_finite(values: dict[str, float], step: int) -> None:
    for name, value in values.items():
        if not math.isfinite(value):
            raise NonFiniteLoss(
                "non_finite_loss",
                f"The {name} loss became {value} at step {step}.",
                "Train with a lower train.optimizer.lr, from the checkpoint of the step before or "
                "from the start, and check the camera poses.",
            )


def _require_learning(found: StepLosses | None) -> None:
    """Finite losses, and gradients that some scale of half precision can hold."""
    if found is None:
        return
    _require_finite(found.values, found.step)
    if found.scale is not None and found.scale < LEAST_SCALE:
        raise NonFiniteLoss(
            "non_finite_loss",
            f"The gradients are not finite, also at a loss scale of {found.scale:.1g}, at step "
            f"{found.step}: nothing is learned any more.",
            "Train with a lower train.optimizer.lr, from the checkpoint or from the start, and "
            "check the camera poses.",
        )


def _is_finite(model: Model) -> bool:
    """Whether a checkpoint of the model is worth keeping."""
    return all(bool(parameter.isfinite().all()) for parameter in model.parameters())


def _time_is_up(elapsed_s: float, config: TrainConfig) -> bool:
    return config.max_seconds > 0.0 and elapsed_s >= config.max_seconds


def _progress(
    state: TrainingState,
    config: TrainConfig,
    found: StepLosses,
    step_times: deque[float],
    step_rays: deque[int],
) -> TrainProgress:
    per_step = sum(step_times) / len(step_times)
    eta_s = (config.max_steps - state.step) * per_step
    fraction = state.step / config.max_steps
    if config.max_seconds > 0.0:
        eta_s = min(eta_s, max(0.0, config.max_seconds - state.elapsed_s))
        fraction = max(fraction, min(1.0, state.elapsed_s / config.max_seconds))
    return TrainProgress(
        step=state.step,
        max_steps=config.max_steps,
        fraction=fraction,
        losses=found.values,
        psnr=psnr_from_mse(found.values["rgb"]),
        elapsed_s=state.elapsed_s,
        eta_s=eta_s,
        rays_per_s=sum(step_rays) / max(sum(step_times), 1e-9),
        loss_scale=found.scale,
    )


def _fingerprint(
    config: TrainConfig, seed: int, cameras: Cameras, depth: DepthSupervision | None
) -> str:
    """What must be the same for a checkpoint to fit.

    cameras: of the images that are learned from, in their order: a model that was begun in one
    frame cannot go on in another.
    Limits, habits and learning rates may change in between: a run that went astray goes on with a
    lower rate.
    """
    values = asdict(config)
    free = ("max_steps", "max_seconds", "checkpoint_seconds", "preview_every_steps", "device")
    for name in (*free, "optimizer"):
        del values[name]
    if config.guided == GuidedConfig():  # as of runs from before there were such steps
        del values["guided"]
    known = 0 if depth is None else depth.maps.num_known
    run = {
        "config": values,
        "seed": seed,
        "num_images": len(cameras),
        "known_depths": known,
        "cameras": _digest(cameras),
    }
    if config.model.camera_mode != "off":
        # Earlier versions' models drifted with their cameras: all alike, later (True) evenly.
        run["keeps_frame"] = "evenly"
    return json.dumps(run, sort_keys=True)


def _digest(cameras: Cameras) -> str:
    """SHA-256 of poses, lenses, sizes and times."""
    found = hashlib.sha256()
    for name, values in sorted(vars(cameras).items()):
        if isinstance(values, Tensor):
            found.update(name.encode() + values.cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


def _check_sizes(images: ImageData, cameras: Cameras, train_indices: Sequence[int]) -> None:
    if not train_indices:
        raise NerfError("too_few_images", "There is no image to train on.", "Send more images.")
    if len(images) != len(cameras) or not torch.equal(images.sizes, cameras.size.cpu()):
        raise NerfError(
            "bad_cameras",
            "Images and cameras differ in number or size.",
            "Load the images at the size of the cameras (Cameras.resized).",
        )
