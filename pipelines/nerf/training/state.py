"""What a training run carries from step to step: model, optimisers, random numbers; its device.

Whatever a resumed run needs is in `TrainingState.as_dict`, as tensors and plain values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import nn

from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.networks.decay import decay_gradients, set_table_decay
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.train import TrainConfig

IMAGE_SHARE = 0.5
"""Of a GPU's free memory, for the images."""

MakeAdam = Callable[..., torch.optim.Adam]
"""Called with parameters, `lr` and `eps`."""


def learning_rate(
    step: int, initial: float, final: float, decay_steps: int, decay: str = "exponential"
) -> float:
    """exp((1 - t) ln initial + t ln final), t = step / decay_steps in [0, 1].

    linear: (1 - t) initial + t final.
    """
    t = min(step / decay_steps, 1.0)
    if decay == "linear":
        return (1.0 - t) * initial + t * final
    return math.exp((1.0 - t) * math.log(initial) + t * math.log(final))


def learning_rates(config: TrainConfig, step: int) -> dict[str, float]:
    """The rate of each optimiser, by its name."""
    rates = config.optimizer
    decay_steps = rates.decay_steps or config.max_steps
    camera_steps = rates.camera_decay_steps or config.max_steps
    return {
        "networks": learning_rate(step, rates.lr, rates.lr_final, decay_steps, rates.decay),
        "cameras": learning_rate(step, rates.camera_lr, rates.camera_lr_final, camera_steps),
    }


@dataclass
class TrainingState:
    """All that changes from step to step."""

    model: Model
    optimizers: dict[str, torch.optim.Adam]
    scaler: torch.amp.GradScaler
    pixel_random: torch.Generator
    model_random: torch.Generator
    step: int = 0
    elapsed_s: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        return {
            "model": self.model.state_dict(),
            "optimizers": {name: item.state_dict() for name, item in self.optimizers.items()},
            "scaler": self.scaler.state_dict(),
            "pixel_random": self.pixel_random.get_state(),
            "model_random": self.model_random.get_state(),
            "step": self.step,
            "schedule": self.model.schedule_state(),
            "elapsed_s": self.elapsed_s,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        self.model.load_state_dict(saved["model"])
        for name, item in self.optimizers.items():
            restore_optimizer(item, saved["optimizers"][name])
        if saved["scaler"] and self.scaler.is_enabled():
            restore_scaler(self.scaler, saved["scaler"])
        for name in ("pixel_random", "model_random"):
            random: torch.Generator = getattr(self, name)
            if saved[name].shape == random.get_state().shape:  # else: another kind of device
                random.set_state(saved[name])
        self.step = int(saved["step"])
        self.model.load_schedule_state(saved["schedule"])
        self.elapsed_s = float(saved["elapsed_s"])


def restore_optimizer(optimizer: torch.optim.Adam, saved: dict[str, Any]) -> None:
    """Take over moments and counts of steps, and keep the optimiser's own options.

    saved: `state_dict` of any kind of Adam with the same parameters: torch's plain, fused or
    capturable one, or `FusedAdam`. What the groups say beside their parameters (rates, epsilon,
    betas, which kernel runs) belongs to this run's options and device, not to those of the run that
    was saved. Torch goes by the groups when it decides where a count of steps lives: on the device
    for fused and capturable optimisers, on the host for others.
    """
    groups = [
        {**own, "params": theirs["params"]}
        for own, theirs in zip(optimizer.param_groups, saved["param_groups"], strict=True)
    ]
    optimizer.load_state_dict({"state": saved["state"], "param_groups": groups})


def restore_scaler(scaler: torch.amp.GradScaler, saved: dict[str, Any]) -> None:
    """Take over the scale of the loss, and keep the rules by which this run changes it."""
    reached = {name: saved[name] for name in ("scale", "_growth_tracker")}
    scaler.load_state_dict({**scaler.state_dict(), **reached})


def is_fast(config: TrainConfig, device: torch.device) -> bool:
    """Whether the compiled engine trains.

    That of GPUs is tried out before it is trusted (`engines.gpu.self_check`, seconds, once a
    process): where it fails, "auto" trains with PyTorch, and "fast" raises NerfError `gpu_failed`.
    """
    if config.engine == "plain" or device.type == "cpu":
        return config.engine != "plain"
    # Imported here: a machine without a GPU needs no Triton.
    from pipelines.nerf.engines.gpu.self_check import engine_problem

    problem = engine_problem(config, device)
    if problem is not None and config.engine == "fast":
        raise NerfError(
            "gpu_failed",
            f"The compiled engine does not work on {device}: {problem}.",
            "Set train.engine to plain, or auto.",
        )
    return problem is None


def _plain_adam(parameters: Iterable[nn.Parameter], lr: float, eps: float) -> torch.optim.Adam:
    adam = torch.optim.Adam(parameters, lr=lr, eps=eps, fused=True)
    adam.register_step_pre_hook(decay_gradients)
    return adam


def pixel_device(config: TrainConfig, device: torch.device, image_bytes: int) -> torch.device:
    """Where the images lie and pixels are drawn: on the GPU where they leave it enough memory."""
    if device.type != "cuda" or not config.data.images_on_gpu:
        return torch.device("cpu")
    free, _ = torch.cuda.mem_get_info(device)
    return device if image_bytes <= IMAGE_SHARE * free else torch.device("cpu")


def initial_state(
    config: TrainConfig,
    num_images: int,
    seed: int,
    device: torch.device,
    pixels_on: torch.device | None = None,
) -> TrainingState:
    """The state before the first step; the seed decides it.

    pixels_on: as `pixel_device` says; None for the CPU.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model: Model = find_method(config.method).build(config.model, num_images).to(device)
    on_gpu = device.type == "cuda"
    fast = is_fast(config, device)
    model.set_engine("fast" if fast else "plain")
    networks = list(model.network_parameters())
    rates = config.optimizer
    scaler = torch.amp.GradScaler(device.type, enabled=on_gpu)
    # Imported where they are chosen: nobody loads the compiler of the other kind of device.
    if fast and on_gpu:
        from pipelines.nerf.engines.gpu.step import capturable_adam, loss_scaler

        scaler = loss_scaler(device, config.rays_per_step)
        adam: MakeAdam = partial(capturable_adam, device=device)
    elif fast:
        from pipelines.nerf.engines.cpu.train.gradients import accumulate_in_place
        from pipelines.nerf.engines.cpu.train.twins import make_adam

        accumulate_in_place(model)
        adam = make_adam
    else:
        adam = _plain_adam
    optimizers = {"networks": adam(networks, lr=rates.lr, eps=rates.eps)}
    if config.model.camera_mode != "off":
        cameras = list(model.cameras_delta.parameters())
        # A few hundred numbers: no need of a compiled pass, but of one that can be captured.
        few = adam if on_gpu and fast else torch.optim.Adam
        optimizers["cameras"] = few(cameras, lr=rates.camera_lr, eps=rates.eps)
    for optimizer in optimizers.values():
        for group in optimizer.param_groups:
            group["betas"] = (group["betas"][0], rates.beta2)
    set_table_decay(optimizers["networks"], model, rates.table_decay)
    return TrainingState(
        model=model,
        optimizers=optimizers,
        scaler=scaler,
        pixel_random=torch.Generator(pixels_on or "cpu").manual_seed(seed),
        model_random=torch.Generator(device).manual_seed(seed + 1),
    )
