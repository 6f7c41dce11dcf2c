"""A GPU's correctness, training steps/s, a whole run and frames/s at 1080p, beside their bounds.

    python -m tests.benchmarks.gpu_speed [--vs plain] [--rays 4096] [--steps 500] [--rounds 2]
        [--run-steps 30000] [--frames 5] [--capture FOLDER] [--hbm-tb-s 4.8] [--half-tflops 989]
        [--l2-tb-s 5.5] [--json out/gpu_speed.json]

First every kernel against its plain twin, stereo, and whole steps of both engines (`gpu_checks`);
where one is wrong the rest is not measured. Then the paper's sampling (256, 96, 48) as it is after
its warm-up (proposals learn in every 5th step), a new model for each way, in turn: `graph`, the
captured step with Triton kernels; `eager`, the same kernels started one by one; with `--vs plain`
also PyTorch's definitions. The first steps of each (`--skip`: compiling, capturing) are not
counted. Then: time by phase and by kernel, networks fused and layer by layer, bytes and operations
from the shapes (`gpu_counts`) with the least time that a device could need, the paper's settings
as it is (`--run-steps`; 0 leaves it out) with the PSNR of its held-out images, and pictures of what
it learned. The capture is a scene in closed form unless `--capture` names a folder.

With `--vs plain` an H200 needs an estimated 8 minutes, most of them the whole run. Statuses: 2
where there is no GPU, 3 where the engine is wrong, 1 for other errors.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pipelines.nerf.engines.gpu.render import TileDrawer, can_draw
from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.metrics import psnr
from pipelines.nerf.models.base import Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.rays import Rays
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.gpu_counts import (
    PAIRED_ADDITIONS_FROM,
    SECTOR,
    Device,
    known_device,
    step_work,
    total,
)
from tests.benchmarks.gpu_scene import ball_capture, ring_cameras
from tests.benchmarks.gpu_training import (
    Run,
    Speed,
    WholeRun,
    kernel_times,
    measure,
    network_times,
    phase_times,
    warmed_up,
    whole_run,
)
from tests.benchmarks.machine import describe, heading, wait_for_gpu
from tests.benchmarks.tables import markdown_table, number, write_json

GOAL_STEPS_PER_S, GOAL_FRAMES_PER_S, GOAL_RUN_S = 150.0, 10.0, 240.0
RUN_STEPS = 30_000
WAYS = ("graph", "eager", "plain")
MADE_IMAGES, MADE_WIDTH, MADE_HEIGHT = 100, 960, 540
FRAME_WIDTH, FRAME_HEIGHT = 1920, 1080
FRAME_SAMPLES: tuple[tuple[int, ...] | None, ...] = (None, (64, 32, 24), (32, 24, 16))
CHECKED_POINTS = 20_000
STATUS_NO_GPU, STATUS_WRONG = 2, 3


@dataclass(frozen=True)
class Frames:
    """Pictures of one way. psnr: against the plain engine's, None for that itself."""

    seconds: list[float]
    psnr: float | None


def frame_times(model: Model, capture: BenchmarkCapture, frames: int) -> dict[str, Frames]:
    """1080p by way of rendering; the first picture of each is thrown away."""
    cameras = ring_cameras(1, FRAME_WIDTH, FRAME_HEIGHT)
    renderer = Renderer(model, capture.scene, engine="plain")
    model.eval()
    ways: dict[str, Callable[[], Tensor]] = {
        "plain": lambda: torch.as_tensor(renderer.render(cameras, 0).rgb)
    }
    if isinstance(model, Nerfacto) and can_draw(model):
        rays = cameras.to(next(model.parameters()).device).image_rays(0)
        for samples in FRAME_SAMPLES:
            drawer = TileDrawer(model, samples=samples)
            ways[f"tiles, samples {samples or 'of the model'}"] = partial(_draw, drawer, rays)
    found: dict[str, Frames] = {}
    truth: Tensor | None = None
    for name, render in ways.items():
        picture = render()
        gap = None if truth is None else psnr(picture.reshape(truth.shape), truth)
        truth = picture if truth is None else truth
        seconds = []
        for _ in range(frames):
            wait_for_gpu()
            began = time.perf_counter()
            render()
            wait_for_gpu()
            seconds.append(time.perf_counter() - began)
        found[name] = Frames(seconds, gap)
    return found


def _draw(drawer: TileDrawer, rays: Rays) -> Tensor:
    """All tiles of a picture, brought to the host as 8 bits a channel; in [0, 1]."""
    tiles = [
        drawer.draw(rays.select(slice(begin, begin + drawer.tile_rays)))["rgb"]
        for begin in range(0, len(rays), drawer.tile_rays)
    ]
    return (torch.cat(tiles) * 255.0).round().byte().cpu().float() / 255.0


def chosen_device(given: argparse.Namespace, device: torch.device) -> Device | None:
    """Rates from the arguments, else those known of the GPU."""
    if device.type != "cuda":
        return None
    name = torch.cuda.get_device_name(device)
    if given.hbm_tb_s is None or given.half_tflops is None:
        return known_device(name)
    major, minor = torch.cuda.get_device_capability(device)
    return Device(name, given.hbm_tb_s * 1e12, given.half_tflops * 1e12, 10 * major + minor)


def print_bounds(
    config: TrainConfig, device: Device | None, l2_bytes_per_s: float | None, step_s: float
) -> dict[str, float]:
    """The counted work of both kinds of steps and the share of the bound that was achieved."""
    model = config.model
    assert isinstance(model, NerfactoConfig)
    rows, least = [], {}
    for update in (True, False):
        arch = PAIRED_ADDITIONS_FROM if device is None else device.arch
        works = step_work(model, config.rays_per_step, update_proposals=update, arch=arch)
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


def report(
    speeds: Sequence[Speed], frames: dict[str, Frames], run: WholeRun | None, ways: Sequence[str]
) -> dict[str, float]:
    """Medians beside the goals; returns the ratios of ways, if the plain one was asked for."""
    rows, median_s = [], {}
    for way in ways:
        median_s[way] = statistics.median(s.step_s for s in speeds if s.way == way)
        rate = 1.0 / median_s[way]
        rows.append([f"training, {way}, steps/s", number(rate, 1), _goal(rate, GOAL_STEPS_PER_S)])
    if run is not None:
        text = f"{GOAL_RUN_S:.0f}: {'met' if run.wall_s < GOAL_RUN_S else 'missed'}"
        rows.append([f"{run.steps} steps of the paper's settings, s", number(run.wall_s, 1), text])
    for name, found in frames.items():
        rate = 1.0 / statistics.median(found.seconds)
        close = "" if found.psnr is None else f", {found.psnr:.1f} dB from plain"
        goal = _goal(rate, GOAL_FRAMES_PER_S)
        rows.append([f"1080p, {name}{close}, frames/s", number(rate, 2), goal])
    print()
    print(markdown_table(["what", "measured", "goal"], rows))
    if "plain" not in median_s:
        return {}
    ratios = {way: median_s["plain"] / median_s[way] for way in ways if way != "plain"}
    for way, ratio in ratios.items():
        print(f"\n{way} / plain: {ratio:.2f} times the steps/s")
    return ratios


def _goal(found: float, wanted: float) -> str:
    return f"{wanted:.0f}: {'met' if found >= wanted else 'missed'}"


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vs", choices=("plain",))
    for name, default in (
        ("rays", 4096),
        ("steps", 500),
        ("skip", 50),
        ("rounds", 2),
        ("run-steps", RUN_STEPS),
        ("frames", 5),
    ):
        parser.add_argument(f"--{name}", type=int, default=default)
    for name in ("hbm-tb-s", "half-tflops", "l2-tb-s"):
        parser.add_argument(f"--{name}", type=float)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def measured(
    given: argparse.Namespace, config: TrainConfig, device: torch.device, values: dict[str, Any]
) -> int:
    """Everything, printed as it comes and kept in `values`; the status of the process.

    config: of the whole run; the steps are those of the same model after its warm-up.
    """
    # Imported here: Triton has no wheel for every platform, and without a GPU nothing needs it.
    from tests.benchmarks.gpu_checks import kernel_checks, print_checks, step_check, stereo_checks

    model = config.model
    assert isinstance(model, NerfactoConfig)
    checks = [*kernel_checks(model, CHECKED_POINTS, device), *stereo_checks(device)]
    checks.append(step_check(config, device))
    values["checks"] = [{**asdict(check), "passed": check.passed} for check in checks]
    if not print_checks(checks):
        print("\nThe GPU engine is wrong here, so nothing was timed.")
        print("Use train.engine=plain, and depth.device=cpu where stereo is wrong.")
        return STATUS_WRONG
    if given.capture is None:
        capture = ball_capture(MADE_IMAGES, MADE_WIDTH, MADE_HEIGHT, device)
    else:
        capture = load_capture(given.capture, config.data)
    config = capture.suited(config)
    print(f"\n{capture.describe()}\n")
    ways = [way for way in WAYS if way != "plain" or given.vs == "plain"]
    speeds, runs = steps_measured(given, capture, warmed_up(config), ways, values)
    run, trained = None, runs["graph"].model
    if given.run_steps > 0:
        run, trained = whole_run(capture, replace(config, max_steps=given.run_steps))
        values["run"] = asdict(run)
    frames = frame_times(trained, capture, given.frames)
    values["frames"] = {name: asdict(found) for name, found in frames.items()}
    values["ratios_to_plain"] = report(speeds, frames, run, ways)
    # Last: of all this a profiler is the likeliest to fail where counters are locked.
    values["kernel_s"] = kernels = dict(kernel_times(runs["graph"]))
    print("\nkernels of the way graph, us a step on the device\n")
    rows = [[name[:80], number(1e6 * seconds, 0)] for name, seconds in kernels.items()]
    print(markdown_table(["kernel", "us"], rows))
    return 0


def steps_measured(
    given: argparse.Namespace,
    capture: BenchmarkCapture,
    config: TrainConfig,
    ways: Sequence[str],
    values: dict[str, Any],
) -> tuple[list[Speed], dict[str, Run]]:
    """Speeds of all rounds, and the last round's runs."""
    speeds, runs = measure(
        capture, config, ways, steps=given.steps, skip=given.skip, rounds=given.rounds
    )
    phases = phase_times(runs["eager"], config)
    device = runs["graph"].step.device
    networks = network_times(config.model, device)
    values |= {
        "speeds": [asdict(speed) for speed in speeds],
        "phase_s": phases,
        "network_s": networks,
    }
    print("\nms a step by phase, one kernel at a time, waiting at each border\n")
    print(markdown_table(["phase", "ms"], [[k, number(1e3 * v)] for k, v in phases.items()]))
    rows = [
        [f"{name}, {way}", number(1e6 * seconds, 0)]
        for name, found in networks.items()
        for way, seconds in found.items()
    ]
    print("\nnetworks on 2^20 points\n")
    print(markdown_table(["network", "us"], rows))
    step_s = statistics.median(speed.step_s for speed in speeds if speed.way == "graph")
    l2_bytes_per_s = None if given.l2_tb_s is None else given.l2_tb_s * 1e12
    values |= print_bounds(config, chosen_device(given, device), l2_bytes_per_s, step_s)
    return speeds, runs


def standard(rays: int) -> TrainConfig:
    """The paper's settings by the GPU engine with its images on the GPU."""
    base = TrainConfig()
    data = replace(base.data, images_on_gpu=True, long_side_px=max(MADE_WIDTH, MADE_HEIGHT))
    return replace(base, rays_per_step=rays, device="cuda", engine="fast", data=data)


def main() -> int:
    """Measure and print; the status of the process. What was measured before an error is kept."""
    given = arguments()
    config, machine = standard(given.rays), describe()
    print(heading(machine))
    if not torch.cuda.is_available():
        print("There is no CUDA GPU here that PyTorch can use: nothing was measured.")
        return STATUS_NO_GPU
    values: dict[str, Any] = {
        "benchmark": "gpu_speed",
        "machine": machine,
        "config": asdict(config),
        "goals": {
            "steps_per_s": GOAL_STEPS_PER_S,
            "run_s": GOAL_RUN_S,
            "frames_per_s": GOAL_FRAMES_PER_S,
        },
    }
    try:
        device = torch.device("cuda", torch.cuda.current_device())
        return measured(given, config, device, values)
    except NerfError as error:
        print(f"{error.message} {error.hint}", file=sys.stderr)
        values["error"] = {"code": error.code, "message": error.message}
        return 1
    finally:
        write_json(given.json, values)


if __name__ == "__main__":
    raise SystemExit(main())
