"""A method on a capture: PSNR and SSIM on the held-out images along the way, and time per step.

    python -m tests.benchmarks.methods ../shared/captures/blender-lego-reduced --method instant-ngp
        --steps 1500 --rays 1024 --small [--long-side 200] [--marks 100,300] [--views 1]
        [--set model.num_steps=512] [--threads 2] [--seed 0] [--json out/methods.json]

The method's own defaults, with the learning rates decaying over the run; on a synthetic scene the
settings that its paper has for bounded ones (`BOUNDED`); with `--small` networks and grids for a
CPU (`SMALL`). `--set` has the last word. The mark at the end is always taken.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pipelines.nerf.options.catalogue import methods
from pipelines.nerf.options.train import TrainConfig, default_train_config
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.runs import Run, run_with_marks, warm_up
from tests.benchmarks.settings import overridden
from tests.benchmarks.tables import markdown_table, number, write_json

BOUNDED: dict[str, dict[str, Any]] = {
    "nerf": {"contraction": "none", "spacing": "uniform"},
    "instant-ngp": {
        "contraction": "none",
        "num_cascades": 1,
        "cone_angle": 0.0,
        "alpha_threshold": 0.0,
    },
    "nerfacto": {"contraction": "none", "spacing": "uniform"},
}
"""By method, the model's options for a scene within [-1, 1]^3."""
SMALL: dict[str, list[str]] = {
    "nerf": ["model.num_layers=4", "model.hidden_dim=64"],
    "instant-ngp": [
        "model.grid.num_levels=10",
        "model.grid.max_res=512",
        "model.grid.log2_table_size=16",
        "model.num_steps=256",
        "model.max_samples=32768",
        "model.average_init_density=0.1",
        "model.occupancy_resolution=64",
        "model.occupancy_update_every=8",
        "model.occupancy_decay=0.9",
    ],
}
"""By method, what a CPU trains in minutes at 200 px."""


def settings(
    method: str, steps: int, rays: int | None, long_side_px: int, decay: bool
) -> TrainConfig:
    """The options of a run before what is known of the capture. decay: over the run's own steps."""
    config = default_train_config(method)
    optimizer = replace(config.optimizer, decay_steps=steps) if decay else config.optimizer
    return replace(
        config,
        max_steps=steps,
        rays_per_step=rays or config.rays_per_step,
        data=replace(config.data, long_side_px=long_side_px),
        optimizer=optimizer,
    )


def fitted(config: TrainConfig, capture: BenchmarkCapture) -> TrainConfig:
    """The options with what is known of the capture."""
    config = capture.suited(config)
    if capture.bounds is None:
        return config
    return replace(config, model=replace(config.model, **BOUNDED.get(config.method, {})))


def report(run: Run) -> str:
    """The curve as a table."""
    rows = [
        [str(mark.step), number(mark.train_s, 1), number(mark.mean_psnr()), _ssim(mark.mean_ssim())]
        for mark in run.marks
    ]
    return markdown_table(["steps", "training s", "PSNR", "SSIM"], rows)


def _ssim(value: float) -> str:
    return number(value, 3)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--method", choices=tuple(methods()), required=True)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--long-side", type=int, default=200)
    parser.add_argument("--marks", default="", help="steps to measure at, with commas between")
    parser.add_argument("--rays", type=int, help="rays per step, else the method's")
    parser.add_argument("--small", action="store_true", help="networks and grids for a CPU")
    parser.add_argument("--views", type=int, help="held-out images measured, else all")
    parser.add_argument("--whole-decay", action="store_true", help="the method's own decay_steps")
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    return parser.parse_args(arguments)


def main() -> None:
    """Train, measure and print."""
    arguments = parse()
    machine = describe(arguments.threads)
    print(heading(machine))
    config = settings(
        arguments.method,
        arguments.steps,
        arguments.rays,
        arguments.long_side,
        not arguments.whole_decay,
    )
    capture = load_capture(arguments.capture, config.data)
    small = SMALL.get(arguments.method, []) if arguments.small else []
    config = overridden(fitted(config, capture), [*small, *arguments.set])
    print(capture.describe(), flush=True)
    print(f"Start-up and compiling: {warm_up(capture, config):.1f} s, not counted below.")
    marks = [int(part) for part in arguments.marks.split(",") if part]
    images = capture.test[: arguments.views]
    run = run_with_marks(capture, config, seed=arguments.seed, images=images, steps=marks)
    per_step = run.train_s / run.steps
    print(f"\nMean over {len(images)} held-out images\n\n{report(run)}")
    print(f"\n{per_step * 1e3:.1f} ms a step of {config.rays_per_step} rays.")
    values: dict[str, Any] = {
        "benchmark": "methods",
        "machine": machine,
        "capture": capture.describe(),
        "config": asdict(config),
        "seconds_per_step": per_step,
        "run": run.as_dict(),
    }
    write_json(arguments.json, values)


if __name__ == "__main__":
    main()
