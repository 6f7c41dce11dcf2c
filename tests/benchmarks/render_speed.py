"""Rays per second of rendering; both engines alternating with `--vs plain`.

    python -m tests.benchmarks.render_speed [--sampling paper|preview] [--size 270x480]
        [--threads 2] [--rounds 3] [--vs plain] [--json out/render_speed.json]
    python -m tests.benchmarks.render_speed --model model.zip --capture CAPTURE [--long-side 480]

Without a model an untrained one is rendered: fog, where nothing can be left out; a trained one is
faster. With a model and its capture the held-out images are rendered in turn with all samples, with
each option of `RenderConfig` added to those before it, and as the job renders. Stated are the PSNR
of all, that against the picture with all samples, and the share of pixels whose depth is more than
5 % off from there. `parity --save-model` writes such a model.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipelines.nerf.devices import choose_device
from pipelines.nerf.judging.metrics import psnr
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.render import ALL_SAMPLES, RenderConfig
from pipelines.nerf.options.train import DataConfig
from pipelines.nerf.renderer import RenderedImage, Renderer
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.training.checkpoint import load_model
from tests.benchmarks import reference
from tests.benchmarks.capture_data import load_capture
from tests.benchmarks.machine import describe, heading, wait_for_gpu
from tests.benchmarks.made_capture import ring_pose
from tests.benchmarks.settings import SAMPLINGS, sampling_model
from tests.benchmarks.tables import markdown_table, mean, number, write_json

NUM_TRAIN_IMAGES = 45


@dataclass(frozen=True)
class Speed:
    """One way of rendering. seconds, cpu_seconds: of a picture, round by round.

    psnr, psnr_to_first: dB, against the truth and against the first way. depth_off: share of pixels
    whose median depth is more than 5 % from that of the first way.
    """

    label: str
    rays: int
    seconds: list[float]
    cpu_seconds: list[float] = field(default_factory=list)
    psnr: float | None = None
    psnr_to_first: float | None = None
    depth_off: float | None = None

    @property
    def rays_per_s(self) -> float:
        """Rays a second in the median round."""
        return self.rays / statistics.median(self.seconds)


class Stopwatch:
    """Seconds by the clock, and those of all threads of this process."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.cpu_seconds: list[float] = []

    def measure(self, renderer: Renderer, cameras: Cameras, index: int) -> RenderedImage:
        """Render a picture, and note what it took."""
        started, cpu_started = time.perf_counter(), time.process_time()
        seen = renderer.render(cameras, index)
        wait_for_gpu()
        self.seconds.append(time.perf_counter() - started)
        self.cpu_seconds.append(time.process_time() - cpu_started)
        return seen


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
    watches = {label: Stopwatch() for label in ways}
    for _ in range(rounds):
        for label, renderer in ways.items():
            watches[label].measure(renderer, cameras, 0)
    rays = int(np.prod(cameras.size[0].tolist()))
    return [
        Speed(label, rays, watch.seconds, watch.cpu_seconds) for label, watch in watches.items()
    ]


def options_in_turn() -> dict[str, RenderConfig]:
    """From all samples to the defaults, by adding one option after the other."""
    default = RenderConfig()
    config = replace(ALL_SAMPLES, block_px=1)
    ways = {"all samples": config}
    for name in ("block_px", "baked_cells", "skip_below", "early_stop", "color_weight"):
        value = getattr(default, name)
        config = replace(config, **{name: value})
        ways[f"+ {name} {value:g}"] = config
    return ways | {"as the job renders": default}


def of_trained(
    model_file: Path, folder: Path, long_side: int, engine: str, max_images: int
) -> list[Speed]:
    """The held-out images in all ways, alternating."""
    loaded = load_model(model_file)
    model = loaded.model.to(choose_device("auto"))
    capture = load_capture(folder, DataConfig(long_side_px=long_side))
    ways = {
        label: Renderer(model, loaded.scene, engine=engine, config=config)
        for label, config in options_in_turn().items()
    }
    small = capture.cameras.resized(16)
    for renderer in ways.values():
        renderer.render(small, 0)
    watches = {label: Stopwatch() for label in ways}
    values: dict[str, list[tuple[float, float, float]]] = {label: [] for label in ways}
    for index in capture.test[: max_images or None]:
        truth = capture.images.image(index)
        first: RenderedImage | None = None
        for label, renderer in ways.items():
            seen = watches[label].measure(renderer, capture.cameras, index)
            first = first or seen
            values[label].append((psnr(torch.as_tensor(seen.rgb), truth), *difference(seen, first)))
    rays = int(np.prod(capture.images.sizes[0].tolist()))
    means = {
        label: [mean(column) for column in zip(*rows, strict=True)]
        for label, rows in values.items()
    }
    return [
        Speed(label, rays, watch.seconds, watch.cpu_seconds, *means[label])
        for label, watch in watches.items()
    ]


def difference(one: RenderedImage, other: RenderedImage) -> tuple[float, float]:
    """PSNR of one against the other, and the share of pixels whose depth is more than 5 % off."""
    close = psnr(torch.as_tensor(one.rgb), torch.as_tensor(other.rgb))
    return close, float((np.abs(one.depth - other.depth) > 0.05 * other.depth).mean())


def print_report(speeds: Sequence[Speed]) -> None:
    """The table; ratios of speeds are medians over rounds."""
    rows = [
        [
            speed.label,
            number(statistics.median(speed.seconds), 3),
            number(1.0 / statistics.median(speed.seconds), 2),
            number(speed.rays_per_s, 0),
            number(1e6 * statistics.median(speed.cpu_seconds) / speed.rays, 1),
            number(speed.rays_per_s / reference.RENDER_RAYS_PER_S, 1),
            number(ratio(speed, speeds[0]), 2),
            number(speed.psnr),
            number(speed.psnr_to_first),
            "" if speed.depth_off is None else f"{100.0 * speed.depth_off:.1f} %",
        ]
        for speed in speeds
    ]
    header = ["", "s a picture", "pictures/s", "rays/s", "CPU us a ray"]
    header += ["times the reference", "times the first"]
    header += ["PSNR", "PSNR to the first", "depth off"]
    print("\n" + markdown_table(header, rows))


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
    parser.add_argument("--max-images", type=int, default=0, help="held-out images; 0 for all")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if (arguments.model is None) != (arguments.capture is None):
        parser.error("--model and --capture go together")
    machine = describe(arguments.threads)
    print(heading(machine))
    if arguments.model is not None:
        speeds = of_trained(
            arguments.model,
            arguments.capture,
            arguments.long_side,
            arguments.engine,
            arguments.max_images,
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
