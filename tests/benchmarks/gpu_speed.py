"""Steps per second of training and frames per second at 1080p on a GPU, beside their bounds.

    python -m tests.benchmarks.gpu_speed [--rays 4096] [--steps 500] [--rounds 2] [--ways graph,...]
        [--frames 5] [--capture FOLDER] [--hbm-tb-s 4.8] [--half-tflops 989] [--l2-tb-s 5.5]
        [--json out/gpu_speed.json]

Trains the paper's sampling (256, 96, 48) as it is after its warm-up (proposals learn in every 5th
step) in up to three ways, a new model each, in turn: `graph`, the captured step with Triton
kernels; `eager`, the same kernels started one by one; `plain`, PyTorch's definitions one by one.
The first steps of each (`--skip`: compiling, capturing) are not counted. Then: milliseconds by
phase (one by one, waiting at each border, so launches count), the kernels that took most of the
graph's time, and bytes and operations from the shapes (`gpu_counts`) with the least time that a
device could need. Ends with status 2 where there is no GPU.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.nerf.cameras import Cameras
from pipelines.nerf.config import NerfactoConfig, TrainConfig, find_method
from pipelines.nerf.data import PixelSampler
from pipelines.nerf.gpu.render import TileDrawer, can_draw
from pipelines.nerf.gpu.step import TrainingStep, capturable_adam, loss_scaler
from pipelines.nerf.models.base import Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.rays import Rays
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.training_state import choose_device
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.gpu_counts import SECTOR, Device, known_device, step_work, total
from tests.benchmarks.machine import describe, heading, wait_for_gpu
from tests.benchmarks.made_capture import write_made_capture
from tests.benchmarks.phases import PhaseClock, watching
from tests.benchmarks.render_speed import one_camera
from tests.benchmarks.tables import markdown_table, number, write_json
from tests.benchmarks.train_speed import PHASES, REST, watched

GOAL_STEPS_PER_S, GOAL_FRAMES_PER_S = 150.0, 10.0
WAYS = ("graph", "eager", "plain")
MADE_IMAGES, MADE_WIDTH, MADE_HEIGHT = 100, 960, 540
FRAME_WIDTH, FRAME_HEIGHT = 1920, 1080
FRAME_SAMPLES: tuple[tuple[int, ...] | None, ...] = (None, (64, 32, 24), (32, 24, 16))
PROFILED_STEPS, SHOWN_KERNELS, PHASE_STEPS = 20, 15, 20
STATUS_NO_GPU = 2


@dataclass(frozen=True)
class Speed:
    """One way's steps of one round."""

    way: str
    steps: int
    step_s: float


def paper_config(rays: int) -> TrainConfig:
    """The paper's model as it trains after its warm-up and annealing."""
    model = replace(NerfactoConfig(), proposal_warmup_steps=1, anneal_steps=0)
    base = TrainConfig()
    data = replace(base.data, long_side_px=max(MADE_WIDTH, MADE_HEIGHT))
    return replace(base, rays_per_step=rays, device="cuda", model=model, data=data)


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
        self.step = TrainingStep(
            self.model,
            {
                name: capturable_adam(parameters, rate, rates.eps, device)
                for name, (parameters, rate) in groups.items()
            },
            loss_scaler(device, config.rays_per_step),
            PixelSampler(capture.images, capture.train, device),
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
    capture: BenchmarkCapture, config: TrainConfig, ways: Sequence[str], given: argparse.Namespace
) -> tuple[list[Speed], dict[str, Run]]:
    """Rounds of all ways in turn, and the last round's runs."""
    speeds, runs = [], {}
    for number_of_round in range(given.rounds):
        for way in ways:
            runs[way] = run = Run(capture, config, way)
            run.steps(given.skip)
            speed = Speed(way, given.steps, run.steps(given.steps) / given.steps)
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
    """(kernel, seconds a step on the device) of those that took most."""
    activities = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        run.steps(PROFILED_STEPS)
    spent = [
        (event.key, event.self_device_time_total * 1e-6 / PROFILED_STEPS)
        for event in profile.key_averages()
    ]
    return sorted(spent, key=lambda item: -item[1])[:SHOWN_KERNELS]


def frame_times(model: Model, capture: BenchmarkCapture, frames: int) -> dict[str, list[float]]:
    """Seconds a frame of 1080p by way of rendering, the first one of each thrown away."""
    cameras = one_camera(FRAME_WIDTH, FRAME_HEIGHT)
    renderer = Renderer(model, capture.scene, engine="plain")
    ways: dict[str, Callable[[], Any]] = {"plain": lambda: renderer.render(cameras, 0)}
    if isinstance(model, Nerfacto) and can_draw(model):
        rays = cameras.to(next(model.parameters()).device).image_rays(0)
        model.eval()
        for samples in FRAME_SAMPLES:
            drawer = TileDrawer(model, samples=samples)
            ways[f"tiles, samples {samples or 'of the model'}"] = partial(_draw, drawer, rays)
    times: dict[str, list[float]] = {}
    for name, render in ways.items():
        render()
        for _ in range(frames):
            wait_for_gpu()
            began = time.perf_counter()
            render()
            wait_for_gpu()
            times.setdefault(name, []).append(time.perf_counter() - began)
    return times


def _draw(drawer: TileDrawer, rays: Rays) -> NDArray[np.uint8]:
    """All tiles of a picture, its colours as 8 bits on the host."""
    tiles = [
        drawer.draw(rays.select(slice(begin, begin + drawer.tile_rays)))["rgb"]
        for begin in range(0, len(rays), drawer.tile_rays)
    ]
    pixels: NDArray[np.uint8] = (torch.cat(tiles) * 255.0).round().byte().cpu().numpy()
    return pixels


def chosen_device(given: argparse.Namespace) -> Device | None:
    """Rates from the arguments, else those known of the GPU."""
    name = torch.cuda.get_device_name()
    known = known_device(name)
    if given.hbm_tb_s is not None and given.half_tflops is not None:
        return Device(name, given.hbm_tb_s * 1e12, given.half_tflops * 1e12)
    return known


def print_bounds(
    config: TrainConfig, device: Device | None, l2_bytes_per_s: float | None, step_s: float
) -> dict[str, float]:
    """The counted work of both kinds of steps and the share of the bound that was achieved."""
    model = config.model
    assert isinstance(model, NerfactoConfig)
    rows, least = [], {}
    for update in (True, False):
        works = step_work(model, config.rays_per_step, update_proposals=update)
        kind = "with" if update else "without"
        bounds = [
            None if device is None else work.bound_s(device, l2_bytes_per_s) for work in works
        ]
        known = [bound for bound in bounds if bound is not None]
        whole_s = sum(known) if known else None
        if whole_s is not None:
            least[kind] = whole_s
        shown = list(zip(works, bounds, strict=True)) if update else []
        for work, bound_s in [*shown, (total(works, f"**step {kind} update**"), whole_s)]:
            cells = [number(work.hbm_bytes / 1e6, 0), number(SECTOR * work.sectors / 1e6, 0)]
            cells += [number(work.flops / 1e9, 2)]
            cells += [number(None if bound_s is None else 1e6 * bound_s, 0)]
            rows.append([work.phase, *cells])
    header = ["phase", "MB through memory", "MB scattered in L2", "Gflop", "least us"]
    print(f"\nCounted from the shapes{'' if device is None else f', bounds of {device.name}'}\n")
    print(markdown_table(header, rows))
    if not least:
        print("\nNo rates of this GPU are known: give --hbm-tb-s and --half-tflops.")
        return {}
    every = model.proposal_update_every
    mean_s = (least["with"] + (every - 1) * least["without"]) / every
    print(f"\nLeast mean step {1e3 * mean_s:.2f} ms; achieved share {100 * mean_s / step_s:.0f} %.")
    return {"least_step_s": mean_s, "share": mean_s / step_s}


def report(speeds: Sequence[Speed], frames: dict[str, list[float]], ways: Sequence[str]) -> None:
    """Medians beside the goals."""
    rows = []
    for way in ways:
        step_s = statistics.median(s.step_s for s in speeds if s.way == way)
        rows.append(
            [
                f"training, {way}, steps/s",
                number(1 / step_s, 1),
                _goal(1 / step_s, GOAL_STEPS_PER_S),
            ]
        )
    for name, seconds in frames.items():
        rate = 1.0 / statistics.median(seconds)
        rows.append([f"1080p, {name}, frames/s", number(rate, 2), _goal(rate, GOAL_FRAMES_PER_S)])
    print()
    print(markdown_table(["what", "measured", "goal"], rows))


def _goal(found: float, wanted: float) -> str:
    return f"{wanted:.0f}: {'met' if found >= wanted else 'missed'}"


def main() -> int:
    """Measure and print; the status of the process."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--skip", type=int, default=50)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--hbm-tb-s", type=float)
    parser.add_argument("--half-tflops", type=float)
    parser.add_argument("--l2-tb-s", type=float)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    machine = describe()
    print(heading(machine))
    if not torch.cuda.is_available():
        print("There is no CUDA GPU here that PyTorch can use: nothing was measured.")
        return STATUS_NO_GPU
    config = paper_config(given.rays)
    with tempfile.TemporaryDirectory() as temporary:
        made = Path(temporary) / "made-up"
        if given.capture is None:
            write_made_capture(made, MADE_IMAGES, MADE_WIDTH, MADE_HEIGHT)
        capture = load_capture(given.capture or made, config.data)
    print(capture.describe())
    ways = [way for way in given.ways.split(",") if way in WAYS]
    speeds, runs = measure(capture, config, ways, given)
    kernels = kernel_times(runs[ways[0]])
    phases = phase_times(runs.get("eager") or Run(capture, config, "eager"), config)
    frames = frame_times(runs[ways[0]].model, capture, given.frames)
    print("\nms a step by phase, one kernel at a time, waiting at each border\n")
    print(markdown_table(["phase", "ms"], [[k, number(1e3 * v)] for k, v in phases.items()]))
    print(f"\nkernels of the way {ways[0]}, us a step on the device\n")
    print(markdown_table(["kernel", "us"], [[k[:80], number(1e6 * v, 0)] for k, v in kernels]))
    step_s = statistics.median(s.step_s for s in speeds if s.way == ways[0])
    l2_bytes_per_s = None if given.l2_tb_s is None else given.l2_tb_s * 1e12
    bounds = print_bounds(config, chosen_device(given), l2_bytes_per_s, step_s)
    report(speeds, frames, ways)
    values = {
        "benchmark": "gpu_speed",
        "machine": machine,
        "config": asdict(config),
        "speeds": [asdict(speed) for speed in speeds],
        "phase_s": phases,
        "kernel_s": dict(kernels),
        "frame_s": frames,
        "goals": {"steps_per_s": GOAL_STEPS_PER_S, "frames_per_s": GOAL_FRAMES_PER_S},
        **bounds,
    }
    write_json(given.json, values)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
