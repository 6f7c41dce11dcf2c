"""Peak memory of loading and training against the number and size of images.

    python -m tests.benchmarks.memory [--points 10x480,45x480,200x480,45x960,45x1920]
        [--sampling paper|preview] [--steps 3] [--capture FOLDER] [--json out/memory.json]

Every point (images x long side) is a process of its own that loads a made-up capture in portrait
format 9:16, trains a few steps and says what it held at most. Slopes are fitted by least squares,
peak = base + slope * pixels, with the number of images varied at one size and the reverse; the
images themselves are 3 bytes a pixel. With a capture, its own images at the sizes are measured too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tests.benchmarks.tables import markdown_table, number, write_json

MIB = 2**20
DEFAULT_POINTS = "10x480,45x480,150x480,400x480,45x960,45x1920"


@dataclass(frozen=True)
class MemoryPoint:
    """What one process held. Bytes: after its imports, after loading, at most."""

    label: str
    num_images: int
    width: int
    height: int
    started_bytes: int
    loaded_bytes: int
    peak_bytes: int

    @property
    def pixels(self) -> int:
        """Pixels of all images."""
        return self.num_images * self.width * self.height


@dataclass(frozen=True)
class Line:
    """peak = base + slope * pixels. varied: the number or the size of images; fixed: the other."""

    varied: str
    fixed: str
    base_bytes: float
    bytes_per_pixel: float


def fitted_line(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """(base, slope) of the least-squares line through (x, y). Raises ValueError below two x."""
    xs, ys = [x for x, _ in points], [y for _, y in points]
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    spread = sum((x - mean_x) ** 2 for x in xs)
    if spread == 0.0:
        raise ValueError("a slope needs two different numbers of pixels")
    slope = sum((x - mean_x) * (y - mean_y) for x, y in points) / spread
    return mean_y - slope * mean_x, slope


def fitted_lines(points: Sequence[MemoryPoint]) -> list[Line]:
    """A line for each size with several numbers of images, and each number with several sizes."""
    lines = []
    for size in dict.fromkeys((point.width, point.height) for point in points):
        same = [point for point in points if (point.width, point.height) == size]
        lines += _line("number", f"{size[0]}x{size[1]}", same)
    for count in dict.fromkeys(point.num_images for point in points):
        same = [point for point in points if point.num_images == count]
        lines += _line("size", f"{count} images", same)
    return lines


def _line(varied: str, fixed: str, points: Sequence[MemoryPoint]) -> list[Line]:
    if len({point.pixels for point in points}) < 2:
        return []
    base, slope = fitted_line([(point.pixels, point.peak_bytes) for point in points])
    return [Line(varied, fixed, base, slope)]


def measure_here(folder: Path, long_side: int, sampling: str, steps: int, rays: int) -> MemoryPoint:
    """Load and train in this process. What torch takes to be imported is in every figure."""
    from pipelines.nerf.training.loop import train
    from tests.benchmarks.capture_data import load_capture
    from tests.benchmarks.machine import peak_memory_bytes
    from tests.benchmarks.train_speed import speed_config

    started = peak_memory_bytes()
    config = speed_config(sampling, rays, steps, "early")
    config = replace(config, data=replace(config.data, long_side_px=long_side))
    capture = load_capture(folder, config.data)
    loaded = peak_memory_bytes()
    config = capture.suited(config)
    train(capture.images, capture.cameras, capture.train, config, seed=0)
    width, height = (int(side) for side in capture.images.sizes[0].tolist())
    return MemoryPoint(
        folder.name, len(capture.images), width, height, started, loaded, peak_memory_bytes()
    )


def measure_apart(
    folder: Path, label: str, long_side: int, arguments: argparse.Namespace
) -> MemoryPoint:
    """`measure_here` in a process of its own."""
    command = [
        *(sys.executable, "-m", "tests.benchmarks.memory", "--child", str(folder)),
        *("--long-side", str(long_side), "--sampling", arguments.sampling),
        *("--steps", str(arguments.steps), "--rays", str(arguments.rays)),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=3600)
    if answer.returncode != 0:
        raise RuntimeError(f"the process of point {label} failed:\n{answer.stderr[-2000:]}")
    values = json.loads(answer.stdout.splitlines()[-1])
    return MemoryPoint(**{**values, "label": label})


def print_report(points: Sequence[MemoryPoint]) -> list[Line]:
    """The table and the slopes."""
    rows = [
        [
            point.label,
            f"{point.width}x{point.height}",
            number(point.pixels / 1e6, 1),
            *(
                number(value / MIB, 0)
                for value in (
                    3 * point.pixels,
                    point.started_bytes,
                    point.loaded_bytes,
                    point.peak_bytes,
                )
            ),
        ]
        for point in points
    ]
    header = ["images", "size", "Mpx", "images MiB", "imports MiB", "loaded MiB", "peak MiB"]
    print("\n" + markdown_table(header, rows))
    lines = fitted_lines(points)
    for line in lines:
        print(
            f"\n{line.varied} varied, {line.fixed}: peak = {line.base_bytes / MIB:,.0f} MiB "
            f"+ {line.bytes_per_pixel:.2f} bytes a pixel (the images are 3)"
        )
    return lines


def main() -> None:
    """Measure all points and print; as a child, one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", default=DEFAULT_POINTS)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--sampling", choices=("paper", "preview"), default="paper")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--long-side", type=int, default=480, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        point = measure_here(
            arguments.child,
            arguments.long_side,
            arguments.sampling,
            arguments.steps,
            arguments.rays,
        )
        print(json.dumps(asdict(point)))
        return
    from tests.benchmarks.machine import describe, heading

    machine = describe()
    print(heading(machine))
    wanted = [tuple(int(part) for part in text.split("x")) for text in arguments.points.split(",")]
    points = []
    for num_images, long_side in wanted:
        points.append(_made_point(num_images, long_side, arguments))
        print(f"{points[-1].label}: {points[-1].peak_bytes / MIB:,.0f} MiB", flush=True)
    lines = print_report(points)
    own = []
    if arguments.capture is not None:
        sizes = sorted({long_side for _, long_side in wanted})
        name = arguments.capture.resolve().name
        own = [measure_apart(arguments.capture, name, size, arguments) for size in sizes]
        print_report(own)
    values: dict[str, Any] = {
        "benchmark": "memory",
        "machine": machine,
        "sampling": arguments.sampling,
        "rays_per_step": arguments.rays,
        "points": [asdict(point) for point in points],
        "capture": [asdict(point) for point in own],
        "lines": [asdict(line) for line in lines],
    }
    write_json(arguments.json, values)


def _made_point(num_images: int, long_side: int, arguments: argparse.Namespace) -> MemoryPoint:
    from tests.benchmarks.made_capture import write_made_capture

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "made-up"
        write_made_capture(folder, num_images, long_side * 9 // 16, long_side)
        return measure_apart(folder, f"{num_images} of {long_side} px", long_side, arguments)


if __name__ == "__main__":
    main()
