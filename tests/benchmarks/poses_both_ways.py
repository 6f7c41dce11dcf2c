"""How far poses that a capture brought and those that matching finds for its pictures are apart.

    python -m tests.benchmarks.poses_both_ways CAPTURE ... [--preset preview] [--seed 0]
        [--out out/poses-both] [--json FILE]

CAPTURE is a folder or a zip that brings poses, as `photos-fox` and `photos-juicebox-white-table`
do. It goes through `ingest` and `poses` as it is, and so do its pictures alone, which then get
their poses by structure from motion; what is complete in `--out` and current is not run again.
Errors are those of `tests.benchmarks.pose_accuracy`, with the poses that came along for the true
ones. Wanted: nine in ten centres within 0.5 % of the path's extent of each other.
"""

from __future__ import annotations

import argparse
import json
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipelines.captures.record import CaptureRecord
from pipelines.captures.sniff import sniff
from pipelines.manifest import run_job_locally
from pipelines.presets import PRESETS
from pipelines.scene.cameras_file import CamerasFile
from pipelines.workspace import Workspace
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.pose_accuracy import Floats, PoseErrors, compare, put_capture, rungs_of
from tests.benchmarks.tables import markdown_table, write_json

MOST_APART_PERCENT = 0.5
_HEADER = (
    "", "pictures with poses", "found", "centres, 90 %, %", "rotations, 90 %, deg", "given poses",
    "by", "as wanted",
)  # fmt: skip


@dataclass(frozen=True)
class BothWays:
    """A capture by its own poses and by matching. verdict: on its own poses. rungs: of matching."""

    name: str
    num_given: int
    num_found: int
    errors: PoseErrors
    verdict: str
    rungs: str

    @property
    def is_as_wanted(self) -> bool:
        """Whether both agree, and nearly all pictures were found."""
        return (
            self.errors.center_90_percent < MOST_APART_PERCENT
            and self.num_found >= 0.9 * self.num_given
        )


def archived(capture: Path, out: Path) -> Path:
    """The capture as one file; a folder becomes a zip in `out`."""
    if capture.is_file():
        return capture
    path = out / f"{capture.name}.zip"
    if not path.is_file():
        out.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        with zipfile.ZipFile(partial, "w") as archive:
            for file in sorted(capture.rglob("*")):
                if file.is_file():
                    archive.write(file, file.relative_to(capture).as_posix())
        partial.replace(path)
    return path


def pictures_of(job: Workspace, path: Path) -> Path:
    """A zip of nothing but the pictures that a capture has poses for."""
    if not path.is_file():
        names = {row["source"] for row in CaptureRecord.load(job.stage("ingest")).images}
        partial = path.with_suffix(".partial")
        with zipfile.ZipFile(job.capture_file) as source, zipfile.ZipFile(partial, "w") as archive:
            for name in sorted(names):
                archive.writestr(name, source.read(name))
        partial.replace(path)
    return path


def poses_by_source(job: Workspace) -> dict[str, Floats]:
    """The pose [3, 4] of each picture of the archive that has one."""
    sources = {row["file"]: row["source"] for row in CaptureRecord.load(job.stage("ingest")).images}
    images = CamerasFile.load(job.stage("poses") / "cameras.json").images
    return {sources[i.file]: np.array(i.world_from_camera, np.float64) for i in images}


def apart(found: dict[str, Floats], given: dict[str, Floats]) -> PoseErrors:
    """Of the pictures that have both. Raises ValueError for fewer than three."""
    both = sorted(found.keys() & given.keys())
    if len(both) < 3:
        raise ValueError(f"{len(both)} pictures have poses both ways; three are needed")
    return compare(np.array([found[n] for n in both]), np.array([given[n] for n in both]))


def _posed(capture: Path, root: Path, preset: str, seed: int) -> Workspace:
    job = Workspace(root.resolve())
    put_capture(capture, job, seed)
    kind = sniff(job.capture_file, capture.name).kind
    run_job_locally(job, preset, {}, kind=kind, seed=seed, until="poses")
    return job


def run_capture(capture: Path, out: Path, preset: str, seed: int) -> BothWays:
    """Find the poses both ways. Raises PipelineError where one of them fails."""
    name = capture.stem if capture.is_file() else capture.name
    root = out / f"{name}-{preset}-{seed}"
    given = _posed(archived(capture, out), root / "given", preset, seed)
    found = _posed(pictures_of(given, root / "pictures.zip"), root / "found", preset, seed)
    reports = [
        json.loads((job.stage("poses") / "report.json").read_text("utf-8"))
        for job in (given, found)
    ]
    errors = apart(poses_by_source(found), poses_by_source(given))
    return BothWays(
        name,
        reports[0]["num_registered"],
        reports[1]["num_registered"],
        errors,
        rungs_of(reports[0]),
        rungs_of(reports[1]),
    )


def row_of(one: BothWays) -> list[str]:
    """A line of the table."""
    errors = one.errors
    return [
        one.name,
        str(one.num_given),
        str(one.num_found),
        f"{errors.center_percent:.3f}, {errors.center_90_percent:.3f}",
        f"{errors.rotation_deg:.3f}, {errors.rotation_90_deg:.3f}",
        one.verdict,
        one.rungs,
        "yes" if one.is_as_wanted else "no",
    ]


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="preview")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/poses-both"))
    parser.add_argument("--json", type=Path)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark. Returns the process's exit status."""
    given = build_parser().parse_args(arguments)
    machine = describe()
    print(heading(machine))
    measured = []
    for capture in given.captures:
        measured.append(run_capture(capture, given.out, given.preset, given.seed))
        print(" | ".join(row_of(measured[-1])), flush=True)
    print("\n" + markdown_table(_HEADER, [row_of(one) for one in measured]))
    rows = [{**asdict(one), "is_as_wanted": one.is_as_wanted} for one in measured]
    write_json(given.json, {"machine": machine, "preset": given.preset, "measured": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
