"""Rays per second of training, split by phase; both engines alternating with `--vs plain`.

    python -m tests.benchmarks.train_speed [--capture ../shared/captures/photos-fox]
        [--sampling paper|preview] [--rays 1024] [--steps 15] [--rounds 2] [--vs plain]
        [--schedule early|late] [--set model.x=1] [--json out/train_speed.json]

Each round trains a new model from the start, after two steps that are thrown away; the first steps
of a round (`--skip`) are not counted. `early` is the start of a run, where the proposal networks
are updated in every step, `late` the paper's schedule after its warm-up: every 5th step. Without a
capture, a made-up one of 45 images of 270x480 is trained on. "rest" is what no watched function
did. On a GPU the split comes from a run of its own that waits at each border of a phase.
"""

from __future__ import annotations

import argparse
import importlib
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.devices import choose_device
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.training.loop import TrainProgress, train
from tests.benchmarks import reference
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.machine import describe, heading, wait_for_gpu
from tests.benchmarks.made_capture import write_made_capture
from tests.benchmarks.phases import PhaseClock, Target, watching
from tests.benchmarks.runs import warm_up
from tests.benchmarks.settings import SAMPLINGS, overridden, sampling_model
from tests.benchmarks.tables import markdown_table, number, write_json

PHASES = ("pixels and rays", "forward", "backward", "optimiser")
REST = "rest"
MADE_IMAGES, MADE_WIDTH, MADE_HEIGHT = 45, 270, 480


@dataclass(frozen=True)
class Round:
    """One engine's steps of one round: rates of the whole, seconds a step by phase."""

    engine: str
    steps: int
    step_s: float
    step_cpu_s: float
    rays_per_s: float
    phase_s: dict[str, float]
    phase_cpu_s: dict[str, float]


def speed_config(sampling: str, rays: int, steps: int, schedule: str) -> TrainConfig:
    """What is trained: the paper's model, or with the samples and grids of the preview preset."""
    model = replace(sampling_model(sampling), camera_mode="off")
    if schedule == "late":
        model = replace(model, proposal_warmup_steps=1)
    base = TrainConfig()
    return replace(
        base,
        max_steps=steps,
        rays_per_step=rays,
        preview_every_steps=steps,
        model=model,
        data=replace(base.data, long_side_px=reference.LONG_SIDE_PX),
    )


def watched(config: TrainConfig) -> list[Target]:
    """The functions of the training loop that make up the phases."""
    module, _, name = find_method(config.method).model.partition(":")
    model = getattr(importlib.import_module(module), name)
    return [
        (PixelSampler, "draw", "pixels and rays"),
        (Cameras, "generate_rays", "pixels and rays"),
        (model, "forward", "forward"),
        (model, "loss_dict", "forward"),
        (torch.autograd, "backward", "backward"),
    ]


def measure(capture: BenchmarkCapture, config: TrainConfig, skip: int, *, split: bool) -> Round:
    """Train, and count all steps but the first. split: by phase, waiting for a GPU in between."""
    clock = PhaseClock(wait_for_gpu)
    seen: list[tuple[int, float, float]] = []

    def hear(progress: TrainProgress) -> None:
        if progress.step >= skip:
            if not seen:
                clock.reset()
            seen.append((progress.step, progress.elapsed_s, time.process_time()))

    def run() -> None:
        train(capture.images, capture.cameras, capture.train, config, seed=0, on_progress=hear)

    if split:
        with watching(clock, watched(config), "optimiser"):
            run()
    else:
        run()
    (first, began_s, began_cpu), (last, ended_s, ended_cpu) = seen[0], seen[-1]
    steps = last - first
    if steps < 1:
        raise ValueError(f"no step was reported after the first {skip}: give more --steps")
    step_s, step_cpu_s = (ended_s - began_s) / steps, (ended_cpu - began_cpu) / steps
    phase_s = {name: clock.wall_s[name] / steps for name in PHASES} if split else {}
    phase_cpu_s = {name: clock.cpu_s[name] / steps for name in PHASES} if split else {}
    if split:
        phase_s[REST] = max(0.0, step_s - sum(phase_s.values()))
        phase_cpu_s[REST] = max(0.0, step_cpu_s - sum(phase_cpu_s.values()))
    return Round(
        config.engine,
        steps,
        step_s,
        step_cpu_s,
        config.rays_per_step / step_s,
        phase_s,
        phase_cpu_s,
    )


def alternate(
    capture: BenchmarkCapture,
    config: TrainConfig,
    engines: Sequence[str],
    rounds: int,
    skip: int,
    say: Callable[[str], None] = print,
) -> list[Round]:
    """Rounds of each engine in turn, so that a noisy neighbour slows all of them."""
    on_gpu = choose_device(config.device).type == "cuda"
    measured = []
    for engine in engines:
        seconds = warm_up(capture, replace(config, engine=engine))
        say(f"{engine}: start-up and compiling {seconds:.1f} s, not counted")
    for number_of_round in range(rounds):
        for engine in engines:
            chosen = replace(config, engine=engine)
            result = measure(capture, chosen, skip, split=not on_gpu)
            if on_gpu:
                parts = measure(capture, chosen, skip, split=True)
                result = replace(result, phase_s=parts.phase_s, phase_cpu_s=parts.phase_cpu_s)
            measured.append(result)
            say(f"round {number_of_round + 1}, {engine}: {result.rays_per_s:,.0f} rays/s")
    return measured


def median_of(rounds: Sequence[Round], engine: str) -> Round:
    """The round of an engine with the median speed (the slower one of an even number)."""
    own = sorted((r for r in rounds if r.engine == engine), key=lambda r: r.rays_per_s)
    return own[(len(own) - 1) // 2]


def ratio_of(rounds: Sequence[Round], engine: str, other: str) -> float:
    """Median over rounds of the ratio of both engines' speeds in the same round."""
    ours = [r.rays_per_s for r in rounds if r.engine == engine]
    theirs = [r.rays_per_s for r in rounds if r.engine == other]
    return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))


def print_report(rounds: Sequence[Round], engines: Sequence[str], config: TrainConfig) -> None:
    """The table: a column for each engine, milliseconds of wall time, of CPU time in brackets."""
    middle = [median_of(rounds, engine) for engine in engines]

    def cell(wall_s: float, cpu_s: float) -> str:
        return f"{1e3 * wall_s:,.1f} ({1e3 * cpu_s:,.1f})"

    rows = [
        [name, *(cell(r.phase_s[name], r.phase_cpu_s[name]) for r in middle)]
        for name in (*PHASES, REST)
    ]
    rows.append(["**step**", *(cell(r.step_s, r.step_cpu_s) for r in middle)])
    rows.append(["**rays/s**", *(number(r.rays_per_s, 0) for r in middle)])
    rows.append(["steps/s", *(number(1.0 / r.step_s, 2) for r in middle)])
    print(f"\n{config.rays_per_step} rays a step; ms a step, in brackets of CPU time\n")
    print(markdown_table(["phase", *engines], rows))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--sampling", choices=SAMPLINGS, default="paper")
    parser.add_argument("--rays", type=int, default=reference.RAYS_PER_STEP)
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--skip", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--vs", choices=("plain", "fast"))
    parser.add_argument("--schedule", choices=("early", "late"), default="early")
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    machine = describe(arguments.threads)
    print(heading(machine))
    config = speed_config(arguments.sampling, arguments.rays, arguments.steps, arguments.schedule)
    config = overridden(config, arguments.set)
    with tempfile.TemporaryDirectory() as temporary:
        made = Path(temporary) / "made-up"
        if arguments.capture is None:
            write_made_capture(made, MADE_IMAGES, MADE_WIDTH, MADE_HEIGHT)
        capture = load_capture(arguments.capture or made, config.data)
    print(capture.describe())
    engines = [arguments.engine] + ([arguments.vs] if arguments.vs else [])
    rounds = alternate(capture, capture.suited(config), engines, arguments.rounds, arguments.skip)
    print_report(rounds, engines, config)
    values: dict[str, Any] = {
        "benchmark": "train_speed",
        "machine": machine,
        "sampling": arguments.sampling,
        "schedule": arguments.schedule,
        "config": asdict(config),
        "rounds": [asdict(item) for item in rounds],
        "reference_rays_per_s": reference.TRAIN_RAYS_PER_S,
    }
    if arguments.vs:
        values["ratio"] = ratio_of(rounds, *engines)
        print(f"\n{engines[0]} is {values['ratio']:.2f} times as fast as {engines[1]}.")
    speed = median_of(rounds, engines[0]).rays_per_s
    if arguments.sampling == "paper":
        print(
            f"Reference, on another day: {reference.TRAIN_RAYS_PER_S:.0f} rays/s; "
            f"ours {speed / reference.TRAIN_RAYS_PER_S:.1f} times that."
        )
    write_json(arguments.json, values)


if __name__ == "__main__":
    main()
