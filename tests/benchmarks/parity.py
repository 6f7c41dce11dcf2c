"""Ours beside the reference implementation: same data, split, size, samples and rays.

    python -m tests.benchmarks.parity ../shared/captures/photos-fox
        [--steps 301] [--seeds 3] [--marks 57,146,301] [--set model.x=1] [--json out/parity.json]

The reference's rows are those of `reference.py`. Ours are the defaults with the camera optimiser
off, 1,024 rays and 480 pixels; `--set` changes them. Prints PSNR and SSIM of the five held-out
images at each mark, for each seed and in the mean.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pipelines.nerf.options.train import DataConfig, TrainConfig
from pipelines.nerf.training.checkpoint import save_model
from tests.benchmarks import reference
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.machine import describe, heading, peak_memory_bytes
from tests.benchmarks.runs import Mark, Run, run_with_marks, warm_up
from tests.benchmarks.settings import overridden
from tests.benchmarks.tables import markdown_table, mean, number, write_json


def parity_config(steps: int) -> TrainConfig:
    """The reference's settings: our defaults, fewer rays, no camera optimiser."""
    base = TrainConfig()
    return replace(
        base,
        max_steps=steps,
        rays_per_step=reference.RAYS_PER_STEP,
        model=replace(base.model, camera_mode="off"),
        data=DataConfig(
            long_side_px=reference.LONG_SIDE_PX, eval_mode="fraction", eval_fraction=0.1
        ),
    )


def score_rows(
    runs: Sequence[Run], marks: Sequence[int], names: Sequence[str], kind: str
) -> list[list[str]]:
    """Rows of one table: the reference's and ours at each mark, then the mean of our seeds.

    kind: "psnr" or "ssim". Columns: row, steps, one per name, mean of the measured three, mean of
    all.
    """
    digits = 2 if kind == "psnr" else 3
    measured = [name for name in reference.MEASURED if name in names]
    rows = []

    def row(label: str, step: int, value: Callable[[str], float | None]) -> list[str]:
        values = [value(name) for name in names]
        three = mean([value(name) for name in measured])
        cells = [*values, three, mean(values)]
        return [label, str(step), *(number(cell, digits) for cell in cells)]

    for step in marks:
        for point in reference.POINTS:
            if point.step == step:
                rows.append(row("reference", step, getattr(point, kind).get))
        ours = [mark for run in runs for mark in run.marks if mark.step == step]
        for run in runs:
            for mark in run.marks:
                if mark.step == step:
                    rows.append(row(f"ours, seed {run.seed}", step, _scores(mark, kind).get))
        averaged = {name: mean([_scores(mark, kind)[name] for mark in ours]) for name in names}
        if len(runs) > 1:
            rows.append(row("ours, mean", step, averaged.get))
    return rows


def _scores(mark: Mark, kind: str) -> dict[str, float]:
    return {name: float(getattr(score, kind)) for name, score in mark.scores.items()}


def print_report(runs: Sequence[Run], marks: Sequence[int], names: Sequence[str]) -> None:
    """The tables: PSNR, SSIM, speed, and whether the floor is reached."""
    header = ["", "steps", *names, "mean of 3", "mean of all"]
    print("\nPSNR, dB\n\n" + markdown_table(header, score_rows(runs, marks, names, "psnr")))
    print("\nSSIM\n\n" + markdown_table(header, score_rows(runs, marks, names, "ssim")))
    last = reference.POINTS[-1]
    speed = [
        [
            "reference",
            str(last.step),
            number(last.train_s, 0),
            number(reference.TRAIN_RAYS_PER_S, 0),
        ]
    ]
    for run in runs:
        label = f"ours, seed {run.seed}"
        speed.append([label, str(run.steps), number(run.train_s, 1), number(run.rays_per_s, 0)])
    print("\nSpeed\n\n" + markdown_table(["", "steps", "training s", "rays/s"], speed))


def floor_reached(runs: Sequence[Run]) -> tuple[float, bool] | None:
    """(mean PSNR over seeds and the measured images at the reference's last step, is it enough)."""
    marks = [m for run in runs for m in run.marks if m.step == reference.POINTS[-1].step]
    known = [mark for mark in marks if set(reference.MEASURED) <= set(mark.scores)]
    if not known:
        return None
    value = sum(mark.mean_psnr(reference.MEASURED) for mark in known) / len(known)
    return value, value >= reference.MIN_MEAN_PSNR


def main() -> None:
    """Train, measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--steps", type=int, default=reference.POINTS[-1].step)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--marks", help="steps at which to measure, with commas between")
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--save-model", type=Path, help="where to leave the last seed's model.zip")
    arguments = parser.parse_args()
    machine = describe(arguments.threads)
    print(heading(machine))
    config = overridden(parity_config(arguments.steps), arguments.set)
    capture = load_capture(arguments.capture, config.data)
    config = capture.suited(config)
    print(capture.describe())
    marks = _marks(arguments.marks, config.max_steps)
    print(f"Start-up and compiling: {warm_up(capture, config):.1f} s, not counted below.")
    runs, model = [], None
    for seed in range(arguments.seeds):
        run = run_with_marks(capture, config, seed=seed, images=capture.test, steps=marks)
        model = run.model
        runs.append(replace(run, model=None))
        print(
            f"seed {seed}: {run.marks[-1].mean_psnr():.2f} dB after {run.steps} steps "
            f"in {run.train_s:.1f} s of training",
            flush=True,
        )
    names = [capture.names[index] for index in capture.test]
    print_report(runs, marks, names)
    reached = floor_reached(runs)
    if reached is not None:
        value, enough = reached
        print(
            f"\nMean of seeds over {', '.join(reference.MEASURED)}: {value:.2f} dB; at least "
            f"{reference.MIN_MEAN_PSNR} wanted: {'reached' if enough else 'NOT reached'}."
        )
    if arguments.save_model is not None and model is not None:
        save_model(arguments.save_model, model, capture.scene, {"benchmark": "parity"})
    write_json(arguments.json, _as_json(machine, config, capture, runs, reached))


def _marks(given: str | None, steps: int) -> list[int]:
    wanted = [int(part) for part in given.split(",")] if given else []
    wanted = wanted or [point.step for point in reference.POINTS]
    return sorted({*(step for step in wanted if step <= steps), steps})


def _as_json(
    machine: dict[str, Any],
    config: TrainConfig,
    capture: BenchmarkCapture,
    runs: Sequence[Run],
    reached: tuple[float, bool] | None,
) -> dict[str, Any]:
    return {
        "benchmark": "parity",
        "machine": machine,
        "capture": capture.describe(),
        "held_out": [capture.names[index] for index in capture.test],
        "config": asdict(config),
        "reference": [asdict(point) for point in reference.POINTS],
        "runs": [run.as_dict() for run in runs],
        "mean_psnr": None if reached is None else reached[0],
        "floor_psnr": reference.MIN_MEAN_PSNR,
        "floor_reached": None if reached is None else reached[1],
        "peak_memory_bytes": peak_memory_bytes(),
    }


if __name__ == "__main__":
    main()
