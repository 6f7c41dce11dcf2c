"""PSNR on held-out images against seconds of training: a table, JSON and a picture.

    python -m tests.benchmarks.psnr_over_time ../shared/captures/photos-fox
        [--preset paper] [--method nerfacto] [--seeds 3] [--seconds 5,10,20,45] [--steps 1000]
        [--marks 50,100] [--set model.x=1] [--png out/psnr.png] [--json out/psnr.json]

Marks are seconds of training or, with --marks, steps. On `photos-fox` the mean is over the images
that the reference was measured on, and its points are drawn; else over all held-out images. Prints
when each seed got to `--target` (the reference's 10-minute quality), by straight lines between
marks. Options of a preset come with their networks, codes and schedules; size and rays are set to
the reference's unless `--set` says otherwise.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from PIL import Image

from pipelines.nerf.options.train import TrainConfig
from tests.benchmarks import reference
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.chart import BLACK, PALETTE, Point, Series, line_chart
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.runs import Run, run_with_marks, warm_up
from tests.benchmarks.settings import method_config, overridden
from tests.benchmarks.tables import markdown_table, mean, number, write_json

DEFAULT_SECONDS = "5,10,15,20,30,45,60"
RED = (200, 30, 30)


def curve(run: Run, names: Sequence[str]) -> list[Point]:
    """(training seconds, mean PSNR over these images) of each mark."""
    return [(mark.train_s, mark.mean_psnr(names)) for mark in run.marks]


def time_to_reach(points: Sequence[Point], target: float) -> float | None:
    """When a curve first is at `target`, by straight lines between its points; None if never.

    A curve that begins above it reached it at its first point at the latest: that is what is said.
    """
    previous: Point | None = None
    for x, y in points:
        if y >= target:
            if previous is None or y == previous[1]:
                return x
            share = (target - previous[1]) / (y - previous[1])
            return previous[0] + share * (x - previous[0])
        previous = (x, y)
    return None


def draw(
    runs: Sequence[Run], names: Sequence[str], title: str, with_reference: bool, target: float
) -> Image.Image:
    """The picture: a curve for each seed, and the reference's points."""
    series = [
        Series(f"ours, seed {run.seed}", curve(run, names), PALETTE[index % len(PALETTE)])
        for index, run in enumerate(runs)
    ]
    times = [x for item in series for x, _ in item.points]
    if with_reference:
        single = [(point.train_s, point.psnr["0014"]) for point in reference.POINTS]
        whole = [(p.train_s, value) for p in reference.POINTS if (value := p.mean_psnr())]
        series.append(Series("reference, 0014 alone", single, (120, 120, 120), dots_only=True))
        series.append(Series("reference, same images", whole, RED, dots_only=True, thick=True))
        times += [x for x, _ in single]
    low, high = max(1e-3, min(times)), max(times)
    if with_reference:
        series.append(Series(f"{target:g} dB", [(low, target), (high, target)], BLACK))
    return line_chart(
        series,
        title=title,
        x_label="seconds of training",
        y_label="PSNR, dB",
        log_x=high > 20.0 * low,
    )


def settings(arguments: argparse.Namespace) -> TrainConfig:
    """The options of the runs."""
    config = method_config(arguments.method, arguments.preset)
    config = replace(
        config,
        rays_per_step=reference.RAYS_PER_STEP,
        data=replace(config.data, long_side_px=reference.LONG_SIDE_PX),
    )
    if arguments.steps:
        config = replace(config, max_steps=arguments.steps)
    elif not arguments.marks:
        config = replace(config, max_seconds=max(_floats(arguments.seconds)))
    else:
        config = replace(config, max_steps=max(_ints(arguments.marks)))
    return overridden(config, arguments.set)


def print_report(runs: Sequence[Run], names: Sequence[str], target: float) -> list[float | None]:
    """The table of marks and when the target was reached; returns the latter."""
    rows = [
        [
            f"seed {run.seed}",
            str(mark.step),
            number(mark.train_s, 1),
            number(mark.cpu_s, 1),
            number(mark.mean_psnr(names)),
            number(mark.mean_ssim(names), 3),
        ]
        for run in runs
        for mark in run.marks
    ]
    print(f"\nMean over {', '.join(names)}\n")
    print(markdown_table(["", "steps", "training s", "CPU s", "PSNR", "SSIM"], rows))
    reached = [time_to_reach(curve(run, names), target) for run in runs]
    shown = ", ".join("never" if value is None else f"{value:.1f} s" for value in reached)
    average = mean(reached)
    print(
        f"\n{target:g} dB reached after {shown}"
        + ("." if average is None else f"; mean {average:.1f} s.")
    )
    return reached


def measured_images(capture: BenchmarkCapture) -> tuple[list[int], bool]:
    """(the images measured, whether they are the reference's)."""
    known = capture.find(reference.MEASURED)
    held_out = set(capture.test)
    if len(known) == len(reference.MEASURED) and held_out.issuperset(known):
        return known, True
    return capture.test, False


def main() -> None:
    """Train, measure, print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--method", default="nerfacto")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", default=DEFAULT_SECONDS)
    parser.add_argument("--marks", default="")
    parser.add_argument("--steps", type=int, help="end of the run; else the last mark")
    parser.add_argument("--target", type=float, default=19.05)
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--png", type=Path)
    arguments = parser.parse_args()
    machine = describe(arguments.threads)
    print(heading(machine))
    config = settings(arguments)
    capture = load_capture(arguments.capture, config.data)
    config = capture.suited(config)
    print(capture.describe())
    images, is_reference = measured_images(capture)
    names = [capture.names[index] for index in images]
    print(f"Start-up and compiling: {warm_up(capture, config):.1f} s, not counted below.")
    runs = []
    for seed in range(arguments.seeds):
        run = run_with_marks(
            capture,
            config,
            seed=seed,
            images=images,
            steps=_ints(arguments.marks),
            seconds=[] if arguments.marks else _floats(arguments.seconds),
        )
        runs.append(replace(run, model=None))
        print(f"seed {seed}: {run.marks[-1].mean_psnr(names):.2f} dB, {run.train_s:.1f} s")
    reached = print_report(runs, names, arguments.target)
    if arguments.png is not None:
        arguments.png.parent.mkdir(parents=True, exist_ok=True)
        title = f"{capture.name}, {arguments.method} {arguments.preset}, {machine['cpu']}"
        draw(runs, names, title, is_reference, arguments.target).save(arguments.png)
        print(f"\nWritten: {arguments.png}")
    values: dict[str, Any] = {
        "benchmark": "psnr_over_time",
        "machine": machine,
        "capture": capture.describe(),
        "images": names,
        "config": asdict(config),
        "reference": [asdict(point) for point in reference.POINTS] if is_reference else None,
        "runs": [run.as_dict() for run in runs],
        "target_psnr": arguments.target,
        "seconds_to_target": reached,
        "mean_seconds_to_target": mean(reached),
    }
    write_json(arguments.json, values)


def _ints(text: str) -> list[int]:
    return [int(part) for part in text.split(",") if part]


def _floats(text: str) -> list[float]:
    return [float(part) for part in text.split(",") if part]


if __name__ == "__main__":
    main()
