"""How far poses that the product finds are from the true ones, on captures of the analytic scenes.

    python -m tests.benchmarks.pose_accuracy [CASE...] [--ways plain,subpixel] [--preset preview]
        [--seeds 1] [--out out/poses] [--json FILE]

CASE is one of `tests.benchmarks.pose_captures`: films, photos, a fisheye, panoramas, and exports of
apps whose given poses drift; all where none is named. Each is written once below `--out` and put
through `ingest`, `frames` and `poses` as a job would be; what is complete there and still current
is not run again. `subpixel` is the same with `poses.subpixel`, not of panoramas and given poses.
`--seeds` runs each so many times with other seeds.

Errors are those left by the best similarity of the centres: rotations in degrees, centres in
percent of the path's extent, median and the one that nine in ten images are better than. Scale:
how much longer or shorter than the true ones lengths are, for sources that know metres. Wanted:
rotations under 0.2 degrees, centres under 0.5 % (medians), scale within 1 %.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.captures.record import CaptureRecord
from pipelines.captures.sniff import sniff
from pipelines.errors import PipelineError
from pipelines.manifest import run_job_locally
from pipelines.presets import PRESETS
from pipelines.sample.align import path_extent, similarity
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.panoramas import world_from_views
from pipelines.workspace import Workspace
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.pose_captures import CASES, Case, written
from tests.benchmarks.tables import markdown_table, number, write_json

Floats = NDArray[np.float64]

PLAIN, SUBPIXEL = "plain", "subpixel"
MOST_TURNED_DEG, MOST_MOVED_PERCENT, MOST_SCALED_PERCENT = 0.2, 0.5, 1.0
"""What is wanted of medians, and of the scale."""

_AXES = np.diag([1.0, -1.0, -1.0])
_HEADER = (
    "", "registered", "rotations, 90 %, deg", "centres, 90 %, %", "scale %", "error px",
    "frames + poses s", "by", "as wanted",
)  # fmt: skip


@dataclass(frozen=True)
class PoseErrors:
    """Medians, and the errors that nine in ten images are better than; scale: found over true."""

    num_images: int
    rotation_deg: float
    rotation_90_deg: float
    center_percent: float
    center_90_percent: float
    scale: float


@dataclass(frozen=True)
class Judged:
    """One capture found in one way. rungs: of the ladder, or the verdict on given poses.

    scale_percent: of metric sources, how much too long lengths are. failed: the error's code.
    """

    case: str
    way: str
    seed: int
    num_images: int
    num_registered: int
    errors: PoseErrors | None
    scale_percent: float | None
    error_px: float | None
    frames_s: float
    poses_s: float
    rungs: str
    failed: str | None = None

    @property
    def is_as_wanted(self) -> bool:
        """Whether the errors are within what is wanted."""
        return (
            self.errors is not None
            and self.errors.rotation_deg < MOST_TURNED_DEG
            and self.errors.center_percent < MOST_MOVED_PERCENT
            and abs(self.scale_percent or 0.0) < MOST_SCALED_PERCENT
        )


def compare(found: Floats, true: Floats) -> PoseErrors:
    """Errors of poses [N, 3, 4] against the true ones, N >= 3, after the best similarity."""
    move = similarity(found[:, :, 3], true[:, :, 3])
    moved = move.apply_to_cameras(found)
    gaps = np.linalg.norm(moved[:, :, 3] - true[:, :, 3], axis=1)
    percent = 100.0 * gaps / path_extent(true[:, :, 3])
    # By the chord: the angle of a cosine near 1 is lost in rounding.
    chords = np.linalg.norm(moved[:, :, :3] - true[:, :, :3], axis=(1, 2)) / np.sqrt(8.0)
    degrees = np.degrees(2.0 * np.arcsin(np.clip(chords, 0.0, 1.0)))
    return PoseErrors(
        len(found),
        float(np.median(degrees)),
        float(np.percentile(degrees, 90)),
        float(np.median(percent)),
        float(np.percentile(percent, 90)),
        1.0 / move.scale,
    )


def true_poses(job: Workspace, found: CamerasFile, truth: CamerasFile, case: Case) -> Floats:
    """The true pose of each image of a job, [N, 3, 4]; of a panorama's views, each view's own.

    Raises ValueError for an image that is none of the truth's.
    """
    views = _places_of_views(job)
    sources = {
        item["file"]: item["source"] for item in CaptureRecord.load(job.stage("ingest")).images
    }
    times = np.array([np.nan if i.timestamp_s is None else i.timestamp_s for i in truth.images])
    poses = []
    for image in found.images:
        if case.by_time:
            true = truth.images[_nearest(times, image)]
        else:
            true = _named(truth, sources[image.file])
        pose = np.asarray(true.world_from_camera, np.float64)
        if image.file in views:
            place, num = views[image.file]
            panorama = np.column_stack([pose[:, :3] @ _AXES, pose[:, 3]])
            view = world_from_views(panorama, num)[place]
            pose = np.column_stack([view[:, :3] @ _AXES, view[:, 3]])
        poses.append(pose)
    return np.array(poses)


def _nearest(times: Floats, image: PosedImage) -> int:
    if image.timestamp_s is None:
        raise ValueError(f"{image.file} has no time to find its true pose by")
    index = int(np.nanargmin(np.abs(times - image.timestamp_s)))
    if abs(times[index] - image.timestamp_s) > 0.5 * float(np.nanmedian(np.diff(times))):
        raise ValueError(f"{image.file} at {image.timestamp_s:.3f} s is no frame of the truth")
    return index


def _named(truth: CamerasFile, source: str) -> PosedImage:
    for image in truth.images:
        if image.file == source or image.file.endswith(f"/{source}"):
            return image
    raise ValueError(f"{source} is no picture of the truth")


def _places_of_views(job: Workspace) -> dict[str, tuple[int, int]]:
    """By file: which of how many views of its panorama it is."""
    listing = job.stage("frames") / "frames.json"
    if not listing.is_file():
        return {}
    rows = json.loads(listing.read_text("utf-8"))["frames"]
    return {
        file: (place, len(row["views"]))
        for row in rows
        for place, file in enumerate(row.get("views") or [])
    }


@dataclass(frozen=True)
class Seconds:
    """Wall time of `frames` (0 without any) and `poses`."""

    frames: float
    poses: float


def judge(
    case: Case, way: str, seed: int, job: Workspace, truth: CamerasFile, s: Seconds
) -> Judged:
    """A job whose `poses` is complete."""
    report = json.loads((job.stage("poses") / "report.json").read_text("utf-8"))
    found = CamerasFile.load(job.stage("poses") / "cameras.json")
    poses = np.array([image.world_from_camera for image in found.images], np.float64)
    errors = compare(poses, true_poses(job, found, truth, case)) if len(poses) >= 3 else None
    scale = 100.0 * (errors.scale - 1.0) if errors is not None and case.metric else None
    return Judged(
        case.name,
        way,
        seed,
        report["num_images"],
        report["num_registered"],
        errors,
        scale,
        error_px_of(report),
        s.frames,
        s.poses,
        rungs_of(report),
    )


def error_px_of(report: dict[str, Any]) -> float | None:
    """The mean reprojection error; of given poses by how much matches miss them, the median of
    pairs: those that were set aside, where poses were refined."""
    given = report.get("given")
    if not given:
        return float(report["mean_reprojection_error_px"])
    refinement = given["refinement"]
    fit = (
        refinement["after" if refinement["taken"] else "before"] if refinement else given["sampled"]
    )
    return None if fit is None else float(fit["error_px"])


def rungs_of(report: dict[str, Any]) -> str:
    """The rungs that were climbed, or what was decided of given poses."""
    given = report.get("given")
    if given:
        return str(given["verdict"])
    return ", ".join(f"{one['rung']} {one['num_registered']}" for one in report["attempts"])


def run_case(case: Case, way: str, seed: int, given: argparse.Namespace) -> Judged:
    """Write the capture, find its poses unless that is done, and compare them."""
    capture, truth = written(case, given.out / "captures")
    job = Workspace((given.out / f"{case.name}-{given.preset}-{seed}").resolve())
    put_capture(capture, job, seed)
    kind = sniff(job.capture_file, capture.name).kind
    if way == SUBPIXEL:
        other = Workspace(job.root.with_name(f"{job.root.name}-{way}"))
        if not other.root.is_dir():
            shutil.copytree(
                job.root, other.root, ignore=shutil.ignore_patterns("poses"), symlinks=True
            )
        job = other
    overrides = {"poses": {"subpixel": way == SUBPIXEL}}
    try:
        done = run_job_locally(job, given.preset, overrides, kind=kind, seed=seed, until="poses")
    except PipelineError as error:
        return Judged(case.name, way, seed, 0, 0, None, None, None, 0.0, 0.0, "-", error.code)
    wall = {name: float(manifest["timings"]["wall_s"]) for name, manifest in done.items()}
    return judge(case, way, seed, job, truth, Seconds(wall.get("frames", 0.0), wall["poses"]))


def put_capture(capture: Path, job: Workspace, seed: int) -> None:
    """The capture where a job expects it."""
    job.capture_file.parent.mkdir(parents=True, exist_ok=True)
    if not job.capture_file.exists():
        job.capture_file.symlink_to(capture.resolve())
    kind = sniff(job.capture_file, capture.name).kind
    text = json.dumps({"filename": capture.name, "kind": kind, "seed": seed})
    job.job_file.write_text(text, "utf-8")


def row_of(one: Judged) -> list[str]:
    """A line of the table."""
    errors = one.errors
    name = one.case if one.way == PLAIN else f"{one.case}, {one.way}"
    return [
        name if one.seed == 0 else f"{name}, seed {one.seed}",
        f"{one.num_registered}/{one.num_images}",
        "-" if errors is None else f"{errors.rotation_deg:.3f}, {errors.rotation_90_deg:.3f}",
        "-" if errors is None else f"{errors.center_percent:.3f}, {errors.center_90_percent:.3f}",
        "-" if one.scale_percent is None else f"{one.scale_percent:+.2f}",
        number(one.error_px),
        f"{one.frames_s:.0f} + {one.poses_s:.0f}",
        one.failed or one.rungs,
        "yes" if one.is_as_wanted else "no",
    ]


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", default=list(CASES))
    parser.add_argument("--ways", default=f"{PLAIN},{SUBPIXEL}")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="preview")
    parser.add_argument("--seeds", type=int, default=1, metavar="N")
    parser.add_argument("--out", type=Path, default=Path("out/poses"))
    parser.add_argument("--json", type=Path)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark. Returns the process's exit status."""
    parser = build_parser()
    given = parser.parse_args(arguments)
    unknown = sorted(set(given.cases) - set(CASES))
    if unknown:
        parser.error(f"no such cases: {', '.join(unknown)}; there are {', '.join(CASES)}")
    ways = given.ways.split(",")
    if not set(ways) <= {PLAIN, SUBPIXEL}:
        parser.error(f"--ways are {PLAIN} and {SUBPIXEL}, not {given.ways}")
    machine = describe()
    print(heading(machine))
    judged: list[Judged] = []
    for name in given.cases:
        for seed in range(given.seeds):
            for way in ways:
                if way == SUBPIXEL and not CASES[name].is_plain:
                    continue
                judged.append(run_case(CASES[name], way, seed, given))
                print(" | ".join(row_of(judged[-1])), flush=True)
    print("\n" + markdown_table(_HEADER, [row_of(one) for one in judged]))
    measured = [{**asdict(one), "is_as_wanted": one.is_as_wanted} for one in judged]
    write_json(given.json, {"machine": machine, "preset": given.preset, "measured": measured})
    return 0


if __name__ == "__main__":
    sys.exit(main())
