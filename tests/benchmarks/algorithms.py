"""What each training algorithm gains and costs: PSNR on held-out images over steps and CPU seconds.

    python -m tests.benchmarks.algorithms CAPTURE... [--steps 300] [--long-side 240] [--rays 512]
        [--seeds 2] [--only "coarse images,fine levels later"] [--preset preview]
        [--add "more rays: rays_per_step=1024"] [--json out/algorithms.json] [--png out/algorithms]

Each algorithm is a set of options laid over those of its method: Nerfacto's from the preset,
Instant-NGP's own. For every capture and seed all of them are trained one after the other in one
process, so that what else the machine does falls on all alike, and times are seconds of CPU, not of
the clock. A gain is against the base of the same method: the PSNR at equal steps and at equal CPU
seconds, and how many times sooner the quality at the end of the base's run is reached. Tables in
half precision change the file of a model, not its training: that line compares both files.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from PIL import Image

from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.training.checkpoint import load_model, save_model
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.chart import PALETTE, Point, Series, line_chart
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.psnr_over_time import measured_images, time_to_reach
from tests.benchmarks.runs import Run, run_with_marks, warm_up
from tests.benchmarks.scores import evaluate
from tests.benchmarks.settings import method_config, overridden
from tests.benchmarks.tables import markdown_table, mean, number, write_json

BASE = "base"
MARKS_PER_RUN = 4
NERFACTO, INSTANT_NGP = "nerfacto", "instant-ngp"


@dataclass(frozen=True)
class Algorithm:
    """Options laid over a method's. `{half}`, `{third}`, `{sixteenth}`: so much of the steps."""

    name: str
    options: tuple[str, ...] = ()
    method: str = NERFACTO

    def assignments(self, steps: int) -> list[str]:
        """As `settings.overridden` takes them."""
        parts = {"half": 2, "third": 3, "sixteenth": 16}
        shares = {name: max(1, steps // part) for name, part in parts.items()}
        return [option.format(**shares) for option in self.options]


ALGORITHMS = (
    Algorithm(BASE),
    Algorithm("coarse images", ("data.coarse_steps={half}", "data.coarse_halvings=2")),
    Algorithm(
        "fine levels later",
        ("model.grid.start_levels=8", "model.grid.steps_per_level={sixteenth}"),
    ),
    Algorithm("proposals always", ("model.proposal_update_every=1",)),
    Algorithm("proposals rarely", ("model.proposal_warmup_steps={third}",)),
    Algorithm(f"{INSTANT_NGP} {BASE}", (), INSTANT_NGP),
    Algorithm("batches by samples", ("model.samples_per_step=16384",), INSTANT_NGP),
)


@dataclass(frozen=True)
class Curve:
    """An algorithm on a capture, the mean over seeds at each mark."""

    name: str
    capture: str
    steps: list[int]
    cpu_s: list[float]
    psnr: list[float]
    psnr_by_seed: list[float]

    def over_cpu(self) -> list[Point]:
        """(CPU seconds, PSNR) of each mark."""
        return list(zip(self.cpu_s, self.psnr, strict=True))

    def over_steps(self) -> list[Point]:
        """(steps, PSNR) of each mark."""
        return [(float(step), value) for step, value in zip(self.steps, self.psnr, strict=True)]


@dataclass(frozen=True)
class Gain:
    """An algorithm against its base.

    at_steps: dB more after the same steps. at_cpu: dB more after the same CPU seconds, those of the
    shorter run. cpu_ratio: its CPU seconds per step in the base's. speed_up: how many times sooner
    the base's last PSNR is reached, None where it never is.
    """

    at_steps: float
    at_cpu: float
    cpu_ratio: float
    speed_up: float | None


@dataclass(frozen=True)
class HalfTables:
    """A model's file with tables in half precision against that with float32."""

    capture: str
    bytes_full: int
    bytes_half: int
    psnr_full: float
    psnr_half: float


def curve(name: str, capture: str, runs: Sequence[Run]) -> Curve:
    """The mean of runs that have marks at the same steps."""
    columns = list(zip(*(run.marks for run in runs), strict=True))
    return Curve(
        name,
        capture,
        [column[0].step for column in columns],
        [sum(mark.cpu_s for mark in column) / len(column) for column in columns],
        [sum(mark.mean_psnr() for mark in column) / len(column) for column in columns],
        [run.marks[-1].mean_psnr() for run in runs],
    )


def value_at(points: Sequence[Point], x: float) -> float:
    """A curve of increasing x at x, by straight lines; at its ends the value there."""
    if x <= points[0][0]:
        return points[0][1]
    for (x0, y0), (x1, y1) in pairwise(points):
        if x <= x1:
            return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
    return points[-1][1]


def gain(base: Curve, other: Curve) -> Gain:
    """What `other` has over `base`."""
    common = min(base.cpu_s[-1], other.cpu_s[-1])
    sooner = time_to_reach(other.over_cpu(), base.psnr[-1])
    per_step = [item.cpu_s[-1] / item.steps[-1] for item in (other, base)]
    return Gain(
        at_steps=other.psnr[-1] - base.psnr[-1],
        at_cpu=value_at(other.over_cpu(), common) - value_at(base.over_cpu(), common),
        cpu_ratio=per_step[0] / per_step[1],
        speed_up=None if sooner is None else base.cpu_s[-1] / sooner,
    )


def base_of(algorithm: Algorithm) -> str:
    """The name of what an algorithm is compared with."""
    return BASE if algorithm.method == NERFACTO else f"{algorithm.method} {BASE}"


def half_tables(
    model: Any, capture: BenchmarkCapture, images: Sequence[int], render_engine: str = "auto"
) -> HalfTables:
    """Save a model with float32 and with float16 tables, load both and measure them."""
    sizes, values = [], []
    before = model.config
    with tempfile.TemporaryDirectory() as folder:
        for half in (False, True):
            path = Path(folder) / "model.zip"
            model.config = replace(before, half_tables=half)
            save_model(path, model, capture.scene, {})
            sizes.append(path.stat().st_size)
            scores = evaluate(load_model(path).model, capture, images, render_engine)
            values.append(sum(score.psnr for score in scores.values()) / len(scores))
    model.config = before
    return HalfTables(capture.name, sizes[0], sizes[1], values[0], values[1])


def gains_table(curves: Sequence[Curve], algorithms: Sequence[Algorithm]) -> str:
    """A row for each algorithm and capture, and the mean over captures."""
    rows = []
    captures = list(dict.fromkeys(item.capture for item in curves))
    found = {(item.name, item.capture): item for item in curves}
    for algorithm in algorithms:
        gains = []
        for name in captures:
            base, own = found[base_of(algorithm), name], found[algorithm.name, name]
            compared = gain(base, own)
            gains.append(compared)
            rows.append([f"{algorithm.name}, {name}", number(own.psnr[-1]), *_cells(compared)])
        if len(captures) > 1:
            average = Gain(
                sum(item.at_steps for item in gains) / len(gains),
                sum(item.at_cpu for item in gains) / len(gains),
                sum(item.cpu_ratio for item in gains) / len(gains),
                mean([item.speed_up for item in gains]),
            )
            rows.append([f"{algorithm.name}, mean", "", *_cells(average)])
    header = ["", "PSNR", "at equal steps", "at equal CPU s", "CPU s a step", "sooner"]
    return markdown_table(header, rows)


def _cells(found: Gain) -> list[str]:
    return [
        f"{found.at_steps:+.2f} dB",
        f"{found.at_cpu:+.2f} dB",
        f"x {found.cpu_ratio:.2f}",
        "never" if found.speed_up is None else f"x {found.speed_up:.2f}",
    ]


def curves_table(curves: Sequence[Curve]) -> str:
    """PSNR at each mark, with the CPU seconds up to there."""
    steps = curves[0].steps
    rows = [
        [
            f"{item.name}, {item.capture}",
            *(f"{p:.2f} / {s:.1f}" for p, s in zip(item.psnr, item.cpu_s, strict=True)),
        ]
        for item in curves
    ]
    return markdown_table(["dB / CPU s after steps", *(str(step) for step in steps)], rows)


def draw(curves: Sequence[Curve], title: str) -> Image.Image:
    """Both pictures of one capture side by side: over steps and over CPU seconds."""
    pictures = []
    for over, label in ((Curve.over_steps, "steps"), (Curve.over_cpu, "CPU seconds of training")):
        series = [
            Series(item.name, over(item), PALETTE[i % len(PALETTE)], thick=item.name == BASE)
            for i, item in enumerate(curves)
        ]
        pictures.append(line_chart(series, title=title, x_label=label, y_label="PSNR, dB"))
    width, height = pictures[0].size
    both = Image.new("RGB", (2 * width, height), "white")
    for index, picture in enumerate(pictures):
        both.paste(picture, (index * width, 0))
    return both


def config_of(algorithm: Algorithm, arguments: argparse.Namespace) -> TrainConfig:
    """The options of an algorithm's runs."""
    steps: int = arguments.steps
    config = method_config(algorithm.method, arguments.preset)
    config = replace(
        config,
        max_steps=steps,
        rays_per_step=arguments.rays,
        data=replace(config.data, long_side_px=arguments.long_side),
        optimizer=replace(config.optimizer, decay_steps=steps),
    )
    return overridden(config, [*arguments.set, *algorithm.assignments(steps)])


def marks_of(steps: int) -> list[int]:
    """After which steps pictures are measured; the end is one of them."""
    every = max(1, steps // MARKS_PER_RUN)
    return [*range(every, steps - every + 1, every), steps]


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--long-side", type=int, default=240)
    parser.add_argument("--rays", type=int, default=512)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", default="", help="names with commas between; bases are added")
    parser.add_argument("--add", action="append", default=[], metavar="NAME:OPTION=VALUE ...")
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--images", type=int, default=3, help="most held-out images measured")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--png", type=Path, help="beginning of the pictures' names")
    arguments = parser.parse_args()
    try:
        arguments.algorithms = chosen(arguments.only, arguments.add)
    except ValueError as error:
        parser.error(str(error))
    return arguments


def chosen(only: str, added: Sequence[str]) -> list[Algorithm]:
    """The algorithms to run, each base before what is compared with it.

    only: names with commas between, "" for all that are known. added: "NAME: OPTION=VALUE ...".
    Raises ValueError for a name that is not known.
    """
    more = []
    for text in added:
        name, _, options = text.partition(":")
        more.append(Algorithm(name.strip(), tuple(options.split())))
    known = {item.name: item for item in (*ALGORITHMS, *more)}
    names = [name.strip() for name in only.split(",") if name.strip()] or list(known)
    names += [item.name for item in more if item.name not in names]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"no algorithm {', '.join(unknown)}; there are {', '.join(known)}")
    wanted = set(names) | {base_of(known[name]) for name in names}
    return [item for item in known.values() if item.name in wanted]


def main() -> None:
    """Train all, compare, print and draw."""
    arguments = parse()
    machine = describe(arguments.threads)
    print(heading(machine))
    algorithms: list[Algorithm] = arguments.algorithms
    configs = {item.name: config_of(item, arguments) for item in algorithms}
    curves: list[Curve] = []
    files: list[HalfTables] = []
    for folder in arguments.captures:
        capture = load_capture(folder, configs[algorithms[0].name].data)
        print(capture.describe(), flush=True)
        images = measured_images(capture)[0][: arguments.images]
        found = run_all(capture, algorithms, configs, arguments, images)
        files += found[1]
        curves += found[0]
        if arguments.png is not None:
            path = arguments.png.with_name(f"{arguments.png.name}-{capture.name}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            draw(found[0], f"{capture.name}, {arguments.steps} steps").save(path)
            print(f"Written: {path}")
    print("\n" + curves_table(curves) + "\n\n" + gains_table(curves, algorithms))
    for item in files:
        print(
            f"\n{item.capture}, model.zip with half-precision tables: "
            f"{item.bytes_half / 1e6:.1f} MB in place of {item.bytes_full / 1e6:.1f}, "
            f"{item.psnr_half - item.psnr_full:+.4f} dB"
        )
    values: dict[str, Any] = {
        "benchmark": "algorithms",
        "machine": machine,
        "configs": {name: asdict(config) for name, config in configs.items()},
        "curves": [asdict(item) for item in curves],
        "half_tables": [asdict(item) for item in files],
    }
    write_json(arguments.json, values)


def run_all(
    capture: BenchmarkCapture,
    algorithms: Sequence[Algorithm],
    configs: dict[str, TrainConfig],
    arguments: argparse.Namespace,
    images: Sequence[int],
) -> tuple[list[Curve], list[HalfTables]]:
    """All algorithms on one capture, seed by seed; and the files of the first base."""
    runs: dict[str, list[Run]] = {item.name: [] for item in algorithms}
    files = []
    for method in dict.fromkeys(item.method for item in algorithms):
        first = next(item for item in algorithms if item.method == method)
        warm_up(capture, capture.suited(configs[first.name]))
    for seed in range(arguments.seeds):
        for item in algorithms:
            run = run_with_marks(
                capture,
                capture.suited(configs[item.name]),
                seed=seed,
                images=images,
                steps=marks_of(arguments.steps),
            )
            if item.name == BASE and seed == 0:
                files.append(half_tables(run.model, capture, images))
            runs[item.name].append(replace(run, model=None))
            last = run.marks[-1]
            print(
                f"  seed {seed}, {item.name}: {last.mean_psnr():.2f} dB, {last.cpu_s:.1f} CPU s",
                flush=True,
            )
    return [curve(item.name, capture.name, runs[item.name]) for item in algorithms], files


if __name__ == "__main__":
    main()
