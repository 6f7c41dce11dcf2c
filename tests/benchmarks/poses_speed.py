"""Seconds, memory and quality of structure from motion: COLMAP's defaults, ours, and parts of it.

    python -m tests.benchmarks.poses_speed CAPTURE [CAPTURE ...] [--ways defaults,ours]
        [--preset preview] [--limit N] [--threads 2] [--truth cameras.json] [--json out/poses.json]

CAPTURE is a file as people upload it (video, .zip of photos, posed export), or `sample`, which is
filmed first. Its images are brought out once as the preset's job would; then each way finds their
poses in a process of its own. Where the true poses are known (the sample's, a posed export's, or
--truth with the same files or times) the errors after the best similarity are stated: of centres
relative to the largest distance between two of them, of rotations in degrees. A posed export's own
poses were measured too, so errors against them have a floor.

Ways: defaults (COLMAP's own), ours, ours with one option changed (upsample, coarse, exhaustive,
sequential, retrieval, subpixel), global (ours with global instead of incremental mapping).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.captures.sniff import sniff
from pipelines.manifest import run_job_locally
from pipelines.presets import PRESETS
from pipelines.sample.align import path_extent, similarity
from pipelines.sample.film import film_capture
from pipelines.scene.cameras_file import CamerasFile
from pipelines.workspace import Workspace
from tests.benchmarks.machine import GIB, describe, heading
from tests.benchmarks.poses_ways import DEFAULTS, OURS, PHASES, WAYS
from tests.benchmarks.tables import markdown_table, number, write_json

SAMPLE = "sample"
TIME_LIMIT_S = 3600


@dataclass(frozen=True)
class PoseErrors:
    """Against the truth after the best similarity. center: mean and largest, of the extent."""

    num_images: int
    mean_center: float
    max_center: float
    mean_rotation_deg: float


@dataclass(frozen=True)
class Measured:
    """One way on one capture; fields as `poses_ways.measure` returns them."""

    capture: str
    way: str
    num_images: int
    num_registered: int
    wall_s: float
    cpu_s: float
    peak_bytes: int
    phases_wall_s: dict[str, float]
    phases_cpu_s: dict[str, float]
    error_px: float | None
    track_length: float | None
    errors: PoseErrors | None


def pose_errors(
    found: Sequence[dict[str, Any]], truth: CamerasFile | None, *, by_time: bool
) -> PoseErrors | None:
    """Errors of found poses (file, timestamp_s, world_from_camera); None below 3 known ones.

    by_time: pair by the nearest timestamp, else by file.
    """
    if truth is None:
        return None
    pairs = []
    by_file = {image.file: image for image in truth.images}
    times = np.array([np.nan if i.timestamp_s is None else i.timestamp_s for i in truth.images])
    for pose in found:
        if by_time:
            image = truth.images[int(np.nanargmin(np.abs(times - pose["timestamp_s"])))]
        elif pose["file"] in by_file:
            image = by_file[pose["file"]]
        else:
            continue
        pairs.append((pose["world_from_camera"], image.world_from_camera))
    if len(pairs) < 3:
        return None
    ours, true = (np.array(side, np.float64) for side in zip(*pairs, strict=True))
    return compare_poses(ours, true)


def compare_poses(found: NDArray[np.float64], true: NDArray[np.float64]) -> PoseErrors:
    """Errors of poses [N, 3, 4] against the true ones, N >= 3."""
    moved = similarity(found[:, :, 3], true[:, :, 3]).apply_to_cameras(found)
    gaps = np.linalg.norm(moved[:, :, 3] - true[:, :, 3], axis=1) / path_extent(true[:, :, 3])
    cosines = ((moved[:, :, :3] * true[:, :, :3]).sum(axis=(1, 2)) - 1.0) / 2.0
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return PoseErrors(len(found), float(gaps.mean()), float(gaps.max()), float(angles.mean()))


@dataclass(frozen=True)
class Capture:
    """A capture whose images lie in a job folder. truth: None where poses are not known."""

    name: str
    job: Path
    truth: CamerasFile | None
    by_time: bool


def prepare(wanted: str, folder: Path, preset: str, truth: Path | None) -> Capture:
    """Bring out the images of a capture, as the preset's job would."""
    folder.mkdir(parents=True)
    known = None if truth is None else CamerasFile.load(truth)
    path = Path(wanted)
    if wanted == SAMPLE:
        path = folder / "sample.mp4"
        known = film_capture(path)
    job = Workspace(folder / "job")
    job.capture_file.parent.mkdir(parents=True)
    job.capture_file.symlink_to(path.resolve())
    kind = sniff(job.capture_file, path.name).kind
    text = json.dumps({"filename": path.name, "kind": kind, "seed": 0})
    job.job_file.write_text(text, "utf-8")
    run_job_locally(job, preset, {}, kind=kind, until="frames")
    given = job.stage("ingest") / "cameras.json"
    if known is None and given.is_file():
        known = CamerasFile.load(given)
    return Capture(path.stem, job.root, known, by_time=kind == "video")


def measure_apart(capture: Capture, way: str, arguments: argparse.Namespace) -> Measured:
    """One way on one capture, in a process of its own. Raises RuntimeError where that fails."""
    command = [
        *(sys.executable, "-m", "tests.benchmarks.poses_ways", str(capture.job), way),
        *(arguments.preset, str(arguments.threads), str(arguments.limit or 0)),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT_S)
    if answer.returncode != 0:
        raise RuntimeError(f"{way} on {capture.name} failed:\n{answer.stderr[-2000:]}")
    values = json.loads(answer.stdout.splitlines()[-1])
    errors = pose_errors(values.pop("poses"), capture.truth, by_time=capture.by_time)
    return Measured(capture=capture.name, way=way, errors=errors, **values)


def one_line(one: Measured) -> str:
    """A measurement in a line, for those who wait for the table."""
    return (
        f"{one.capture}, {one.way}: {one.wall_s:.1f} s, {one.cpu_s:.1f} s of CPU time, "
        f"{one.num_registered} of {one.num_images} images"
    )


def print_report(measured: Sequence[Measured]) -> None:
    """The table, and how many times faster ours is than COLMAP's defaults."""
    rows = [
        [
            f"{one.capture}, {one.way}",
            f"{one.num_registered}/{one.num_images}",
            number(one.wall_s, 1),
            number(one.cpu_s, 1),
            " + ".join(number(one.phases_cpu_s[phase], 0) for phase in PHASES),
            number(one.peak_bytes / GIB),
            number(one.error_px),
            number(one.track_length, 1),
            "-" if one.errors is None else number(100 * one.errors.mean_center, 3),
            "-" if one.errors is None else number(one.errors.mean_rotation_deg, 3),
        ]
        for one in measured
    ]
    header = ["", "registered", "wall s", "CPU s", "features + matching + mapping, CPU s"]
    header += ["peak GiB", "error px", "track", "centres %", "rotations deg"]
    print("\n" + markdown_table(header, rows))
    of_way = {(one.capture, one.way): one for one in measured}
    for name in dict.fromkeys(one.capture for one in measured):
        slow, fast = of_way.get((name, DEFAULTS)), of_way.get((name, OURS))
        if slow and fast:
            print(
                f"\n{name}: {slow.wall_s / fast.wall_s:.1f} times the speed of COLMAP's defaults "
                f"({slow.cpu_s / fast.cpu_s:.1f} in CPU time), "
                f"{fast.num_registered - slow.num_registered:+d} images registered"
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="+", metavar="CAPTURE")
    parser.add_argument("--ways", default=f"{DEFAULTS},{OURS}", help=", ".join(WAYS))
    parser.add_argument("--preset", choices=sorted(PRESETS), default="preview")
    parser.add_argument("--limit", type=int, metavar="N", help="only N images, evenly spread")
    parser.add_argument("--threads", type=int, default=-1)
    parser.add_argument("--truth", type=Path, metavar="JSON", help="true poses of one capture")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    ways = arguments.ways.split(",")
    unknown = sorted(set(ways) - set(WAYS))
    if unknown:
        parser.error(f"unknown ways: {', '.join(unknown)}; there are {', '.join(WAYS)}")
    for wanted in arguments.captures:
        if wanted != SAMPLE and not Path(wanted).is_file():
            parser.error(f"{wanted} is not a file: name a video or an archive, or {SAMPLE}")
    machine = describe(arguments.threads if arguments.threads > 0 else None)
    print(heading(machine))
    measured: list[Measured] = []
    with tempfile.TemporaryDirectory(prefix="poses-speed-") as temporary:
        for index, wanted in enumerate(arguments.captures):
            folder = Path(temporary) / str(index)
            capture = prepare(wanted, folder, arguments.preset, arguments.truth)
            for way in ways:
                measured.append(measure_apart(capture, way, arguments))
                print(one_line(measured[-1]), flush=True)
    print_report(measured)
    values: dict[str, Any] = {
        "benchmark": "poses_speed",
        "machine": machine,
        "preset": arguments.preset,
        "limit": arguments.limit,
        "threads": arguments.threads,
        "measured": [asdict(one) for one in measured],
    }
    write_json(arguments.json, values)


if __name__ == "__main__":
    main()
