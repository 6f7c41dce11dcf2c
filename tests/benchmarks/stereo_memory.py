"""Peak memory of the stage `depth` against the number of views.

    python -m tests.benchmarks.stereo_memory [--views 40,150,300] [--long-side 640]
        [--distinct 24] [--swept 8] [--scene room] [--json out/stereo_memory.json]

Every number of views is a process of its own, which runs the whole stage on pictures of an analytic
scene with exact poses and says what it held at most, and by which step. `--distinct` many pictures
are drawn; more views are these again, in the same places, which changes no size of anything. Only
`--swept` views are compared with their neighbours, what the others would find is the scene's true
depth with some noise: that step takes a view at a time and most of the hours. 0 compares all.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.manifest import RunHooks, run_stage
from pipelines.nerf.stereo import maps
from pipelines.nerf.stereo.views import StereoView
from pipelines.options import resolve_options
from pipelines.registry import get_stage
from pipelines.sample.film import phone_camera, render_all, walk
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.scene.cameras_file import CamerasFile
from pipelines.workspace import MANIFEST, Workspace
from tests.benchmarks.machine import peak_memory_bytes
from tests.benchmarks.tables import markdown_table, number, write_json

MIB = 2**20
_NOISE = 0.004


def make_capture(root: Path, scene: str, num_views: int, distinct: int, long_side_px: int) -> None:
    """A posed capture as `ingest` leaves it."""
    take = TAKES[scene]
    folder = Workspace(root).stage("ingest")
    (folder / "images").mkdir(parents=True)
    truth = walk(min(distinct, num_views), phone_camera(long_side_px), take=take)
    pictures = list(render_all(truth, take=take))
    images = []
    for index in range(num_views):
        file = f"images/{index:05d}.jpg"
        Image.fromarray(pictures[index % len(pictures)]).save(folder / file, quality=95)
        images.append(replace(truth.images[index % len(pictures)], file=file))
    replace(truth, images=tuple(images)).save(folder / "cameras.json")
    (folder / MANIFEST).write_text('{"stage": "ingest", "content": "made"}', "utf-8")


def take_truth_for_most(root: Path, scene: str, swept: int) -> None:
    """Have the true depth found of all views but the first few, and by no comparison."""
    capture = CamerasFile.load(Workspace(root).stage("ingest") / "cameras.json")
    compare, done = maps._sweep, 0
    known: dict[bytes, NDArray[np.float32]] = {}
    images = {np.array(pose_matrix(image)[:, 3]).tobytes(): image for image in capture.images}

    def sweep(view: StereoView, *told: Any) -> NDArray[np.float32]:
        nonlocal done
        lens, place = capture.cameras[0], np.ascontiguousarray(view.center).tobytes()
        if view.picture.shape != (lens.height, lens.width) or done < swept:
            done += view.picture.shape == (lens.height, lens.width)
            return compare(view, *told)
        if place not in known:
            z = depth_image(lens, pose_matrix(images[place]), TAKES[scene].scene)
            noise = np.random.default_rng(0).normal(1.0, _NOISE, z.shape)
            known[place] = np.where(np.isfinite(z), z * noise, 0.0).astype(np.float32)
        return known[place].copy()

    maps._sweep = sweep  # type: ignore[assignment]


def measure_here(root: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Run the stage in this process: bytes after its imports, and at most by each message."""
    __import__("pipelines.stages.depth")
    long_side_px = given.long_side
    if given.swept:
        take_truth_for_most(root, given.scene, given.swept)
    begun, started = time.monotonic(), peak_memory_bytes()
    peaks: dict[str, int] = {}

    def note(fraction: float, message: str, eta_s: float | None) -> None:
        name = message if not message.startswith("depth ") else "matching"
        peaks[name.rstrip("0123456789/ ")] = peak_memory_bytes()

    held_out = {"train": {"data": {"eval_mode": "none"}}}
    options = resolve_options("preview", {"depth": {"long_side_px": long_side_px}} | held_out)
    stage, hooks = get_stage("depth"), RunHooks(on_progress=note)
    manifest = run_stage(stage, options["depth"], Workspace(root), hooks=hooks)
    return {
        "num_views": manifest["summary"]["num_maps"],
        "started_bytes": started,
        "peaks": peaks,
        "peak_bytes": peak_memory_bytes(),
        "wall_s": time.monotonic() - begun,
        "cpu_s": time.process_time(),
    }


def measure_apart(num_views: int, given: argparse.Namespace) -> dict[str, Any]:
    """`measure_here` in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "job"
        make_capture(root, given.scene, num_views, given.distinct, given.long_side)
        command = [sys.executable, "-m", "tests.benchmarks.stereo_memory", "--child", str(root)]
        command += ["--long-side", str(given.long_side), "--scene", given.scene]
        command += ["--swept", str(given.swept)]
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        raise RuntimeError(f"{num_views} views failed:\n{answer.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(answer.stdout.splitlines()[-1])
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.stereo_memory", description=__doc__
    )
    parser.add_argument("--views", default="40,150,300")
    parser.add_argument("--long-side", type=int, default=640)
    parser.add_argument("--distinct", type=int, default=24)
    parser.add_argument("--swept", type=int, default=8)
    parser.add_argument("--scene", choices=sorted(TAKES), default="room")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.child is not None:
        print(json.dumps(measure_here(given.child, given)))
        return
    found = [measure_apart(int(views), given) for views in given.views.split(",")]
    names = list(dict.fromkeys(name for one in found for name in one["peaks"]))
    rows = [
        [
            str(one["num_views"]),
            number(one["started_bytes"] / MIB, 0),
            *(number(one["peaks"].get(name, 0) / MIB, 0) for name in names),
            number(one["peak_bytes"] / MIB, 0),
            number(one["wall_s"], 0),
            number(one["cpu_s"], 0),
        ]
        for one in found
    ]
    print(f"MiB held at most by the end of each step, long side {given.long_side} px\n")
    print(markdown_table(["views", "imports", *names, "peak", "s", "CPU s"], rows))
    write_json(given.json, {"benchmark": "stereo_memory", "runs": found})


if __name__ == "__main__":
    main()
