"""Rays per second of rendering; both engines alternating with `--vs plain`.

    python -m tests.benchmarks.render_speed [--sampling paper|preview] [--size 270x480]
        [--threads 2] [--rounds 3] [--vs plain] [--json out/render_speed.json]
    python -m tests.benchmarks.render_speed --model model.zip --capture CAPTURE [--long-side 480]

Without a model an untrained one is rendered: fog, where early stops save nothing; a trained one is
faster. With a model and its capture the held-out images are rendered twice, with all samples and
with what the renderer may leave out, and the PSNR of both is stated: `parity --save-model` writes
such a model.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipelines.nerf.cameras import Cameras, SceneTransform
from pipelines.nerf.checkpoint import load_model
from pipelines.nerf.config import DataConfig
from pipelines.nerf.metrics import psnr
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.training_state import choose_device
from tests.benchmarks import reference
from tests.benchmarks.capture_data import load_capture
from tests.benchmarks.machine import describe, heading, wait_for_gpu
from tests.benchmarks.made_capture import ring_pose
from tests.benchmarks.settings import SAMPLINGS, sampling_model
from tests.benchmarks.tables import markdown_table, mean, number, write_json

NUM_TRAIN_IMAGES = 45


@dataclass(frozen=True)
class Speed:
    """One way of rendering. seconds: of a picture, round by round. psnr: dB, where known."""

    label: str
    rays: int
    seconds: list[float]
    psnr: float | None = None

    @property
    def rays_per_s(self) -> float:
        """Rays a second in the median round."""
        return self.rays / statistics.median(self.seconds)


def one_camera(width: int, height: int) -> Cameras:
    """A pinhole camera in scene space that looks at the centre."""
    focal = 0.7 * max(width, height)
    return Cameras.from_arrays(
        world_from_camera=ring_pose(0.5)[None],
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[width],
        heights=[height],
        focal=[(focal, focal)],
        principal=[(width / 2, height / 2)],
    )


def alternate(ways: dict[str, Renderer], cameras: Cameras, rounds: int) -> list[Speed]:
    """Render the same picture in each way in turn, after a small first one that compiles."""
    small = cameras.resized(16)
    for label, renderer in ways.items():
        started = time.perf_counter()
        renderer.render(small, 0)
        wait_for_gpu()
        print(f"{label}: first call {time.perf_counter() - started:.1f} s, not counted")
    times: dict[str, list[float]] = {label: [] for label in ways}
    for _ in range(rounds):
        for label, renderer in ways.items():
            started = time.perf_counter()
            renderer.render(cameras, 0)
            wait_for_gpu()
            times[label].append(time.perf_counter() - started)
    rays = int(np.prod(cameras.size[0].tolist()))
    return [Speed(label, rays, seconds) for label, seconds in times.items()]


def of_trained(model_file: Path, folder: Path, long_side: int, engine: str) -> list[Speed]:
    """The held-out images with all samples, and with what the renderer may leave out."""
    loaded = load_model(model_file)
    model = loaded.model.to(choose_device("auto"))
    capture = load_capture(folder, DataConfig(long_side_px=long_side))
    ways = {
        "all samples": Renderer(
            model, loaded.scene, engine=engine, early_stop=0.0, weight_threshold=0.0
        ),
        "as the job renders": Renderer(model, loaded.scene, engine=engine),
    }
    small = capture.cameras.resized(16)
    for renderer in ways.values():
        renderer.render(small, 0)
    times: dict[str, list[float]] = {label: [] for label in ways}
    values: dict[str, list[float]] = {label: [] for label in ways}
    for index in capture.test:
        truth = capture.images.image(index)
        for label, renderer in ways.items():
            started = time.perf_counter()
            seen = renderer.render(capture.cameras, index)
            wait_for_gpu()
            times[label].append(time.perf_counter() - started)
            values[label].append(psnr(torch.as_tensor(seen.rgb), truth))
    rays = int(np.prod(capture.images.sizes[0].tolist()))
    return [Speed(label, rays, times[label], mean(values[label])) for label in ways]


def print_report(speeds: Sequence[Speed]) -> None:
    """The table, and the ratio of the first two ways."""
    rows = [
        [
            speed.label,
            number(statistics.median(speed.seconds), 3),
            number(1.0 / statistics.median(speed.seconds), 2),
            number(speed.rays_per_s, 0),
            number(speed.rays_per_s / reference.RENDER_RAYS_PER_S, 1),
            number(speed.psnr),
        ]
        for speed in speeds
    ]
    header = ["", "s a picture", "pictures/s", "rays/s", "times the reference", "PSNR"]
    print("\n" + markdown_table(header, rows))
    for other in speeds[1:]:
        print(f"\n{speeds[0].label} / {other.label}: {ratio(speeds[0], other):.2f} times the speed")


def ratio(one: Speed, other: Speed) -> float:
    """Median over rounds of the ratio of speeds."""
    return statistics.median(b / a for a, b in zip(one.seconds, other.seconds, strict=True))


def untrained(arguments: argparse.Namespace) -> list[Speed]:
    """An untrained model in each wanted engine."""
    torch.manual_seed(0)
    config = sampling_model(arguments.sampling)
    model = Nerfacto(config, NUM_TRAIN_IMAGES).eval().to(choose_device("auto"))
    scene = SceneTransform((0.0, 0.0, 0.0), 1.0)
    engines = [arguments.engine] + ([arguments.vs] if arguments.vs else [])
    ways = {name: Renderer(model, scene, engine=name) for name in engines}
    width, height = (int(side) for side in arguments.size.split("x"))
    return alternate(ways, one_camera(width, height), arguments.rounds)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sampling", choices=SAMPLINGS, default="preview")
    parser.add_argument("--size", default="270x480", metavar="WIDTHxHEIGHT")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--vs", choices=("plain", "fast"))
    parser.add_argument("--model", type=Path)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--long-side", type=int, default=reference.LONG_SIDE_PX)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if (arguments.model is None) != (arguments.capture is None):
        parser.error("--model and --capture go together")
    machine = describe(arguments.threads)
    print(heading(machine))
    if arguments.model is not None:
        speeds = of_trained(
            arguments.model, arguments.capture, arguments.long_side, arguments.engine
        )
    else:
        speeds = untrained(arguments)
    print_report(speeds)
    values: dict[str, Any] = {
        "benchmark": "render_speed",
        "machine": machine,
        "sampling": arguments.sampling if arguments.model is None else None,
        "speeds": [{**asdict(speed), "rays_per_s": speed.rays_per_s} for speed in speeds],
        "reference_rays_per_s": reference.RENDER_RAYS_PER_S,
    }
    write_json(arguments.json, values)


if __name__ == "__main__":
    main()
