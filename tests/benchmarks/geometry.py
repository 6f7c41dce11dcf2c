"""How good the delivered surfaces are: against exact scenes, sensors' depth and held-out photos.

    python -m tests.benchmarks.geometry [CAPTURE...] [--preset preview] [--set stage.option=value]
        [--seed 0] [--frames 120] [--long-side 960] [--posed] [--out out/geometry] [--json FILE]
    python -m tests.benchmarks.geometry CAPTURE --job FOLDER [...]

CAPTURE is an analytic scene (`bowl`, `room`, `object`, `furniture`, `cafe`, `monument`,
`exhibit`: all where none is named), or a real capture: a video, a .zip, or a folder, which is
packed. A scene is filmed; with `--posed` its exact poses and depths come with it, so that surfaces
are judged apart from poses;
`--set depth.source=stereo` leaves the depths to the judge. Each is put through a whole local
job below `--out`; what is complete there and still current is not run again. `--job` judges a job
that is finished already, made from that one CAPTURE; a scene's film must have had `--frames` and
`--long-side`.

Exact scenes: precision, recall and F-score of the mesh at 1 and 2 % of the size of the scene, only
where cameras saw (`pipelines.sample.judge`), the same of the cloud (the table: precision at 1 %,
and the median error per mille of the size), how far normals of mesh and cloud are off, and depth at
true cameras. Folders with depth: that at held-out views. All: what the job's report says of mesh
and cloud against held-out photos.
Pictures: `depth.png` (photo | truth | mesh | error: red too near, blue too far, black missing) and
`turntable.png` (the draft above the mesh, each coloured and shaded).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.sample.film import LONG_SIDE_PX, NUM_FRAMES, phone_camera, walk
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.workspace import Workspace
from tests.benchmarks.geometry_pictures import save_depths, save_turntable
from tests.benchmarks.geometry_truth import Compared, judge_scene, judge_sensor
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.scene_capture import scene_capture
from tests.benchmarks.tables import markdown_table, number, write_json

HEADER = (
    "capture", "F 1 %", "F 2 %", "precision", "recall", "things", "cloud 1 %", "cloud off",
    "mesh deg", "cloud deg",
    "depth right", "covered", "mesh dB", "with holes", "model dB", "inconsistency", "seconds",
)  # fmt: skip


def packed(capture: Path, folder: Path) -> Path:
    """The capture as one file: itself, or a .zip of the folder."""
    if not capture.is_dir():
        return capture
    archive = folder / f"{capture.name}.zip"
    if not archive.is_file():
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as made:
            for path in sorted(capture.rglob("*")):
                if path.is_file():
                    made.write(path, path.relative_to(capture).as_posix())
    return archive


def run_job(source: Path, job: Path, given: argparse.Namespace) -> float:
    """A whole local job as a process of its own; its wall time in seconds."""
    command = [sys.executable, "-m", "pipelines", "run", "all", str(job), "--input", str(source)]
    command += ["--preset", given.preset, "--seed", str(given.seed)]
    for assignment in given.assignments:
        command += ["--set", assignment]
    started = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - started


def judge(name: str, job: Workspace, folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """All that is known of a finished job, and its pictures in `folder`."""
    report = json.loads((job.stage("report") / "report.json").read_text("utf-8"))
    found: dict[str, Any] = {
        "capture": name,
        "metrics": {key: report["metrics"][key] for key in ("psnr", "ssim", "floaters")},
        "assets": report.get("assets"),
        "warnings": report.get("warnings", []),
        "timings": report["timings"],
        "job_s": sum(report["timings"].values()),
    }
    if name in TAKES:
        take = TAKES[name]
        truth = walk(given.frames, phone_camera(given.long_side), take=take)
        judged: tuple[dict[str, Any], Compared] | None = judge_scene(job, take, truth)
    else:
        judged = judge_sensor(job, Path(name))
    folder.mkdir(parents=True, exist_ok=True)
    if judged is not None:
        found |= judged[0]
        save_depths(judged[1], folder / "depth.png")
    save_turntable(job, folder / "turntable.png")
    return found


def run_capture(name: str, given: argparse.Namespace) -> dict[str, Any]:
    """Film or pack, run the job unless one is given, and judge it."""
    folder = given.out / (name if name in TAKES else Path(name).name)
    folder.mkdir(parents=True, exist_ok=True)
    if given.job is not None:
        return judge(name, Workspace(given.job.resolve()), folder, given)
    if name in TAKES:
        source = scene_capture(folder, TAKES[name], given.frames, given.long_side, given.posed)
    else:
        source = packed(Path(name), folder)
    kind = "-posed" if given.posed and name in TAKES else ""
    job = Workspace((folder / f"job-{given.preset}{kind}").resolve())
    run_job(source, job.root, given)
    return judge(name, job, folder, given)


def points_of(cloud: dict[str, Any] | None) -> list[str]:
    """What the table tells of a cloud: precision of its points at 1 %, and their median error, per
    mille of the scene's size.
    """
    if cloud is None:
        return [number(None), number(None)]
    return [number(cloud["precision"][0.01], 3), number(1e3 * cloud["accuracy"], 2)]


def row_of(found: dict[str, Any]) -> list[str]:
    """A line of the table."""
    surface, depth = found.get("surface"), found.get("depth") or {}
    mesh = (found.get("assets") or {}).get("mesh") or {}
    floaters = found["metrics"]["floaters"] or {}

    def angle(name: str) -> str:
        scores = None if surface is None else surface["normals"][name]
        return number(None if scores is None else scores["median_deg"], 1)

    def share(name: str, tolerance: float) -> str:
        return number(None if surface is None else surface[name][tolerance], 3)

    return [
        Path(found["capture"]).name,
        share("f_score", 0.01),
        share("f_score", 0.02),
        share("precision", 0.02),
        share("recall", 0.02),
        share("things_precision", 0.02),
        *points_of(found.get("cloud")),
        angle("mesh"),
        angle("cloud"),
        number(depth.get("covered_and_within_5_percent"), 3),
        number(mesh.get("coverage"), 3),
        number(mesh.get("psnr")),
        number(mesh.get("psnr_with_holes")),
        number(found["metrics"]["psnr"]),
        number(floaters.get("depth_inconsistency"), 4),
        number(found["job_s"], 0),
    ]


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("captures", nargs="*", metavar="CAPTURE", default=list(TAKES))
    parser.add_argument("--job", type=Path, metavar="FOLDER", help="a finished job to judge")
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--set", action="append", default=[], dest="assignments")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=NUM_FRAMES)
    parser.add_argument("--long-side", type=int, default=LONG_SIDE_PX)
    parser.add_argument(
        "--posed", action="store_true", help="scenes as pictures with exact poses, not as a film"
    )
    parser.add_argument("--out", type=Path, default=Path("out/geometry"))
    parser.add_argument("--json", type=Path)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark. Returns the process's exit status."""
    parser = build_parser()
    given = parser.parse_args(arguments)
    if given.job is not None and len(given.captures) != 1:
        parser.error("--job judges one job: name the one CAPTURE that it was made from")
    for name in given.captures:
        if name not in TAKES and not Path(name).exists():
            parser.error(f"{name} is neither a scene ({', '.join(TAKES)}) nor a file or folder")
    machine = describe()
    print(heading(machine))
    results = []
    for name in given.captures:
        results.append(run_capture(name, given))
        print(json.dumps({key: results[-1].get(key) for key in ("surface", "depth", "poses")}))
    print(markdown_table(HEADER, [row_of(found) for found in results]))
    write_json(given.json, {"machine": machine, "preset": given.preset, "results": results})
    return 0


if __name__ == "__main__":
    sys.exit(main())
