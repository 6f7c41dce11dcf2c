"""Time, memory and steadiness of progress of a long film's first stages.

    python -m tests.benchmarks.long_film FILM.mp4 [--frames 1000] [--preset preview]
        [--stages frames,poses] [--truth TRUTH.json] [--json out/long.json]

A film of 1,000 frames is made with `python -m pipelines.sample FILM.mp4 --frames 1000 --long-side
1920 --truth TRUTH.json`. `frames` keeps as many as are asked for, `poses` finds theirs. Each stage
is a process of its own. Stated are its seconds, the most memory that it held, the most that one
program it started held (ffmpeg; both by the kernel's own account), and the longest time between two
moves of its progress: of the fraction, and of anything it says (fraction, words or seconds left).
With the true cameras, also how far the poses are from them.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pipelines.manifest import RunHooks, run_stage
from pipelines.options import resolve_options
from pipelines.registry import get_stage
from pipelines.sample.judge import PosesJudgement, judge_poses
from pipelines.scene.cameras_file import CamerasFile
from pipelines.workspace import Workspace
from tests.benchmarks.machine import describe, heading, peak_memory_bytes
from tests.benchmarks.tables import markdown_table, number, write_json

MIB = 2**20


@dataclass(frozen=True)
class Measured:
    """What one stage took. Bytes of memory; pauses in seconds."""

    stage: str
    wall_s: float
    peak_bytes: int
    program_peak_bytes: int
    longest_pause_s: float
    longest_silence_s: float


@dataclass
class Pauses:
    """The longest times between two moves of the progress; `now` is in seconds of any clock."""

    moved_at: float
    said_at: float
    fraction: float = 0.0
    said: tuple[float, str, float | None] | None = None
    pause_s: float = 0.0
    silence_s: float = 0.0
    after: list[str] = field(default_factory=list)

    def report(self, now: float, fraction: float, message: str, eta_s: float | None) -> None:
        """Take the next report."""
        if fraction > self.fraction:
            if now - self.moved_at > self.pause_s:
                self.pause_s = now - self.moved_at
                self.after.append(f"{self.pause_s:.1f} s before {message}")
            self.fraction, self.moved_at = fraction, now
        if (fraction, message, eta_s) != self.said:
            self.silence_s = max(self.silence_s, now - self.said_at)
            self.said, self.said_at = (fraction, message, eta_s), now


def measure_here(stage: str, job: Path, preset: str, num_frames: int) -> Measured:
    """Run a stage of a job in this process."""
    options = resolve_options(preset, {"frames": {"num_frames": num_frames}})
    begun = time.monotonic()
    pauses = Pauses(begun, begun)

    def on_progress(fraction: float, message: str, eta_s: float | None) -> None:
        pauses.report(time.monotonic(), fraction, message, eta_s)

    run_stage(
        get_stage(stage), options[stage], Workspace(job), hooks=RunHooks(on_progress=on_progress)
    )
    print("\n".join(pauses.after), file=sys.stderr)
    return Measured(
        stage=stage,
        wall_s=time.monotonic() - begun,
        peak_bytes=peak_memory_bytes(),
        program_peak_bytes=_programs_peak_bytes(),
        longest_pause_s=pauses.pause_s,
        longest_silence_s=pauses.silence_s,
    )


def _programs_peak_bytes() -> int:
    """The most that one of the programs held which this process started and which have ended."""
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * scale


def measure_apart(stage: str, job: Path, preset: str, num_frames: int) -> Measured:
    """Run a stage in a process of its own."""
    command = [sys.executable, "-m", __spec__.name, str(job), "--here", stage]
    command += ["--preset", preset, "--frames", str(num_frames)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return Measured(**json.loads(done.stdout.splitlines()[-1]))


def judge(job: Path, truth: Path) -> PosesJudgement:
    """The poses of a job beside the film's true ones."""
    found = CamerasFile.load(Workspace(job).stage("poses") / "cameras.json")
    return judge_poses(found, CamerasFile.load(truth))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("film", type=Path)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--stages", default="frames,poses")
    parser.add_argument("--truth", type=Path, help="the film's true cameras")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.here:
        print(json.dumps(asdict(measure_here(given.here, given.film, given.preset, given.frames))))
        return
    machine = describe()
    print(heading(machine))
    rows = []
    with tempfile.TemporaryDirectory(prefix="long-film-") as folder:
        job = Path(folder)
        capture = Workspace(job).capture_file
        capture.parent.mkdir(parents=True)
        shutil.copyfile(given.film, capture)
        for stage in ("ingest", *given.stages.split(",")):
            rows.append(measure_apart(stage, job, given.preset, given.frames))
            print(asdict(rows[-1]), file=sys.stderr)
        judged = None if given.truth is None else judge(job, given.truth)
    header = ("stage", "s", "peak, MiB", "ffmpeg's, MiB", "longest pause, s", "silence, s")
    table = [
        (
            row.stage,
            number(row.wall_s, 0),
            number(row.peak_bytes / MIB, 0),
            number(row.program_peak_bytes / MIB, 0),
            number(row.longest_pause_s, 1),
            number(row.longest_silence_s, 1),
        )
        for row in rows
    ]
    print(markdown_table(header, table))
    if judged is not None:
        print(
            f"{judged.num_images} poses: rotations {judged.mean_rotation_error_deg:.3f} degrees, "
            f"centres {judged.mean_center_error:.3%} of the path's extent (means)"
        )
    write_json(given.json, {"machine": machine, "stages": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
