"""What `gpu_speed` measures of training: steps in several ways, phases, kernels, networks, a run.

Everything also works on a CPU, with its engines, which is how it is tested; a GPU's kernels and
graphs are only measured on one.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.devices import choose_device
from pipelines.nerf.engines.gpu.step import TrainingStep, capturable_adam, loss_scaler
from pipelines.nerf.models.base import Model
from pipelines.nerf.networks.fields import MLP
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import ModelConfig
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.training.loop import train
from tests.benchmarks.capture_data import BenchmarkCapture
from tests.benchmarks.machine import wait_for_gpu
from tests.benchmarks.phases import PhaseClock, watching
from tests.benchmarks.scores import evaluate
from tests.benchmarks.tables import number
from tests.benchmarks.train_speed import PHASES, REST, watched

PROFILED_STEPS, SHOWN_KERNELS, PHASE_STEPS = 20, 15, 20
NETWORK_POINTS, NETWORK_ROUNDS = 2**20, 20


@dataclass(frozen=True)
class Speed:
    """One way's steps of one round."""

    way: str
    steps: int
    step_s: float


def warmed_up(config: TrainConfig) -> TrainConfig:
    """The options, of a model as it trains after its warm-up and annealing."""
    assert isinstance(config.model, NerfactoConfig)
    return replace(config, model=replace(config.model, proposal_warmup_steps=1, anneal_steps=0))


class Run:
    """A new model and its training step in one of the ways."""

    def __init__(self, capture: BenchmarkCapture, config: TrainConfig, way: str) -> None:
        device = choose_device(config.device)
        torch.manual_seed(0)
        build = find_method(config.method).build
        self.model: Model = build(config.model, len(capture.train)).to(device).train()
        self.model.set_engine("plain" if way == "plain" else "fast")
        rates = config.optimizer
        groups = {
            "networks": (self.model.network_parameters(), rates.lr),
            "cameras": (self.model.cameras_delta.parameters(), rates.camera_lr),
        }
        cameras: Cameras = capture.cameras.select(capture.train).to(device)
        self.model.cameras_delta.keep_frame(cameras.scene_from_camera)
        self.step = TrainingStep(
            self.model,
            {
                name: capturable_adam(parameters, rate, rates.eps, device)
                for name, (parameters, rate) in groups.items()
            },
            loss_scaler(device, config.rays_per_step),
            PixelSampler(capture.images, capture.train, device, PlainLines.of(config)),
            cameras,
            config.rays_per_step,
            pixel_random=torch.Generator(device).manual_seed(0),
            model_random=torch.Generator(device).manual_seed(1),
            capture=None if way == "graph" else False,
        )
        self._rates = {name: rate for name, (_, rate) in groups.items()}
        self._done = 0

    def steps(self, count: int) -> float:
        """Run that many steps; seconds from the first start to the last end."""
        wait_for_gpu()
        began = time.perf_counter()
        for _ in range(count):
            self.step.run(self._done, self._rates)
            self._done += 1
        wait_for_gpu()
        return time.perf_counter() - began


def measure(
    capture: BenchmarkCapture,
    config: TrainConfig,
    ways: Sequence[str],
    *,
    steps: int,
    skip: int,
    rounds: int,
) -> tuple[list[Speed], dict[str, Run]]:
    """Rounds of all ways in turn, and the last round's runs. skip: steps that are not counted."""
    speeds, runs = [], {}
    for number_of_round in range(rounds):
        for way in ways:
            runs[way] = run = Run(capture, config, way)
            run.steps(skip)
            speed = Speed(way, steps, run.steps(steps) / steps)
            speeds.append(speed)
            rate = number(1.0 / speed.step_s, 1)
            print(f"round {number_of_round + 1}, {way}: {rate} steps/s, {run.step.losses().values}")
    return speeds, runs


def phase_times(run: Run, config: TrainConfig) -> dict[str, float]:
    """Seconds a step by phase, one kernel at a time, waiting for the GPU at each border."""
    clock = PhaseClock(wait=wait_for_gpu)
    run.steps(3)
    with watching(clock, watched(config), "optimiser"):
        clock.reset()
        seconds = run.steps(PHASE_STEPS)
    phases = {name: clock.wall_s[name] / PHASE_STEPS for name in PHASES}
    phases[REST] = max(0.0, seconds / PHASE_STEPS - sum(phases.values()))
    return phases


def kernel_times(run: Run) -> list[tuple[str, float]]:
    """(kernel, seconds a step on the device) of those that took most; none on a CPU."""
    if run.step.device.type != "cuda":
        return []
    activities = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        run.steps(PROFILED_STEPS)
    spent = [
        (event.key, event.self_device_time_total * 1e-6 / PROFILED_STEPS)
        for event in profile.key_averages()
    ]
    return sorted(spent, key=lambda item: -item[1])[:SHOWN_KERNELS]


def network_times(model: ModelConfig, device: torch.device) -> dict[str, dict[str, float]]:
    """Seconds of the model's networks on 2^20 points, fused and layer by layer."""
    # Imported here: Triton has no wheel for every platform.
    from pipelines.nerf.engines.gpu.parts.mlp import fused_mlp, has_room
    from tests.benchmarks.gpu_checks import networks

    assert isinstance(model, NerfactoConfig)
    times: dict[str, dict[str, float]] = {}
    for widths in networks(model) if has_room(device) else ():
        network = MLP(*widths).to(device)
        values = torch.randn(NETWORK_POINTS, widths[0], device=device).half().requires_grad_()
        ways: dict[str, Callable[[], Tensor]] = {
            "fused": partial(fused_mlp, values, network.layers),
            "by layers": partial(network, values),
        }
        found = times["-".join(map(str, widths))] = {}
        for name, apply in ways.items():

            def both(apply: Callable[[], Tensor] = apply) -> None:
                with torch.autocast(device.type, torch.float16):
                    outputs = apply()
                torch.autograd.backward(outputs.float().sum())

            with torch.no_grad(), torch.autocast(device.type, torch.float16):
                found[f"{name}, forward"] = _mean_seconds(apply)
            found[f"{name}, both ways"] = _mean_seconds(both)
    return times


def _mean_seconds(action: Callable[[], object]) -> float:
    for _ in range(3):
        action()
    wait_for_gpu()
    began = time.perf_counter()
    for _ in range(NETWORK_ROUNDS):
        action()
    wait_for_gpu()
    return (time.perf_counter() - began) / NETWORK_ROUNDS


@dataclass(frozen=True)
class WholeRun:
    """A run of the training loop. wall_s: from its call to its end, compiling included."""

    steps: int
    wall_s: float
    psnr: float
    ssim: float


def whole_run(capture: BenchmarkCapture, config: TrainConfig) -> tuple[WholeRun, Model]:
    """The training loop itself, and how well held-out images come out."""
    began = time.perf_counter()
    model = train(capture.images, capture.cameras, capture.train, config, seed=0)
    wait_for_gpu()
    wall_s = time.perf_counter() - began
    scores = list(evaluate(model, capture, capture.test).values())
    found = WholeRun(
        config.max_steps,
        wall_s,
        statistics.fmean(score.psnr for score in scores),
        statistics.fmean(score.ssim for score in scores),
    )
    print(
        f"\nthe paper's settings, {found.steps} steps: {wall_s:.1f} s, "
        f"held-out PSNR {found.psnr:.2f} dB, SSIM {found.ssim:.3f}"
    )
    return found, model
