"""What a job costs beside the work of its stages, from upload to the last artifact.

    python -m tests.benchmarks.job_overhead [CAPTURE] [--preset preview] [--set stage.option=value]
        [--jobs 2] [--cache FOLDER] [--json out/job_overhead.json]

Starts the service as `make demo` does, in a folder of its own with an empty cache for compiled
kernels (`--cache` names another), and sends the capture, the sample where none is named, through
it several times over HTTP. The first job finds nothing warm; the others find the stage process with
its libraries and kernels loaded. The clock of the client and of the service is one.

Where the seconds go: the rows of the stages say when each became ready, was claimed and was
recorded as done, the timings in their manifests (`worker.laps.Laps`, `pipelines.manifest`) the
rest. The parts of a job sum to its wall time, if no two of its stages ran at once.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from api.client.client import Client
from deploy.demo import sample_capture
from deploy.embedded import Embedded, default_home, free_port
from pipelines.assignments import parse_assignments
from storage.db import Database
from storage.queries import get_job
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.tables import markdown_table, number, write_json

STAGE_PARTS = ("inputs", "start", "load", "compile", "work", "seal", "outputs", "record")
JOB_PARTS = ("upload", "first wait", *STAGE_PARTS, "gaps", "notice", "download")
TARGET_PARTS = ("first wait", "inputs", "start", "load", "seal", "outputs", "record", "gaps")
"""Start-up, transfers and queueing: what the service should keep below 2 %."""
TARGET = 0.02
MEANING = {
    "upload": "HTTP upload and creation of the job",
    "first wait": "until a worker claimed the first stage",
    "inputs": "inputs and checkpoint brought to the worker",
    "start": "until the stage process began",
    "load": "hashing of inputs, import of the stage's code",
    "compile": "kernels compiled, or waited for",
    "work": "the stage itself",
    "seal": "results hashed and published in the folder",
    "outputs": "results brought to the object store",
    "record": "claim and end written to the database",
    "gaps": "no stage claimed: the queue between stages",
    "notice": "until the client saw that the job was over",
    "download": "HTTP download of all artifacts",
}


@dataclass(frozen=True)
class StageTimes:
    """A stage that ran. started, finished: seconds since 1970. timings: of its manifest."""

    name: str
    started: float
    finished: float
    timings: Mapping[str, float]

    def parts(self) -> dict[str, float]:
        """Seconds of `STAGE_PARTS`; they sum to finished - started."""
        known = self.timings
        parts = {
            "inputs": known["fetch_s"],
            "start": known["start_s"],
            "load": known["load_s"],
            "compile": known["compile_s"],
            "work": known["wall_s"] - known["load_s"] - known["compile_s"],
            "seal": known["run_s"] - known["wall_s"],
            "outputs": known["store_s"],
        }
        return {**parts, "record": self.finished - self.started - sum(parts.values())}


@dataclass(frozen=True)
class JobTimes:
    """Moments of a job, seconds since 1970, in order.

    sent, seen, ended: by the client, when the upload began, when it saw the job's end, and when the
    last artifact was there. created, finished: by the service.
    """

    sent: float
    created: float
    finished: float
    seen: float
    ended: float
    stages: Sequence[StageTimes]

    @property
    def wall_s(self) -> float:
        """From the upload's first byte to the last artifact's last."""
        return self.ended - self.sent

    def parts(self) -> dict[str, float]:
        """Seconds of `JOB_PARTS`; they sum to `wall_s` where no two stages ran at once."""
        first = min(stage.started for stage in self.stages)
        parts = {
            "upload": self.created - self.sent,
            "first wait": first - self.created,
            **dict.fromkeys(STAGE_PARTS, 0.0),
            "gaps": self.finished - first - self._busy_s(),
            "notice": self.seen - self.finished,
            "download": self.ended - self.seen,
        }
        for stage in self.stages:
            for name, seconds in stage.parts().items():
                parts[name] += seconds
        return parts

    def _busy_s(self) -> float:
        """Seconds in which at least one stage was claimed."""
        busy, covered = 0.0, float("-inf")
        for stage in sorted(self.stages, key=lambda stage: stage.started):
            busy += max(stage.finished - max(stage.started, covered), 0.0)
            covered = max(covered, stage.finished)
        return busy


def share(parts: Mapping[str, float], names: Sequence[str], wall_s: float) -> float:
    """The share of the wall time that these parts take."""
    return sum(parts[name] for name in names) / wall_s


def run_job(
    client: Client,
    database: Database,
    capture: Path,
    preset: str,
    options: dict[str, Any],
    folder: Path,
) -> JobTimes:
    """One job over HTTP. Raises JobFailed where it does not succeed."""
    sent = time.time()
    uploaded = client.upload(capture)
    job_id = client.create_job(uploaded.id, preset, options).id
    client.wait(job_id, check=True)
    seen = time.time()
    client.download(job_id, folder)
    ended = time.time()
    with database.read_scope() as session:
        job = get_job(session, job_id, manifests=True)
    stages = [
        StageTimes(
            row.name,
            row.started_at.timestamp(),
            row.finished_at.timestamp(),
            row.manifest["timings"],
        )
        for row in job.stages
        if row.manifest and row.started_at and row.finished_at
    ]
    assert job.finished_at is not None
    return JobTimes(
        sent, job.created_at.timestamp(), job.finished_at.timestamp(), seen, ended, stages
    )


def measure(
    capture: Path | None, preset: str, options: dict[str, Any], num_jobs: int, cache: Path | None
) -> list[JobTimes]:
    """Jobs one after the other through a service of their own."""
    console = Console()
    base = Path(tempfile.mkdtemp(prefix="nerfworks-overhead-"))
    embedded = Embedded.at(base / "home", "127.0.0.1", free_port(), cache or base / "cache")
    clip = capture or sample_capture(default_home() / "cache", console)
    supervisor = embedded.supervisor(console.print)
    supervisor.start()
    database = Database(embedded.environment()["NERFWORKS_DATABASE_URL"])
    try:
        found = []
        with Client(embedded.url, embedded.secrets.api_key) as client:
            for index in range(num_jobs):
                out = base / f"out-{index}"
                found.append(run_job(client, database, clip, preset, options, out))
                console.print(f"job {index + 1}: {found[-1].wall_s:.1f} s")
        return found
    finally:
        database.dispose()
        supervisor.stop()
        shutil.rmtree(base, ignore_errors=True)


def print_report(jobs: Sequence[JobTimes]) -> None:
    """Parts of all jobs, stages of the last one, and the shares."""
    parts = [job.parts() for job in jobs]
    titles = ["first job, s", *(f"job {index}, s" for index in range(2, len(jobs) + 1))]
    rows = [
        [f"{name}: {MEANING[name]}", *(number(part[name]) for part in parts)] for name in JOB_PARTS
    ]
    rows.append(["all", *(number(job.wall_s) for job in jobs)])
    others = [name for name in JOB_PARTS if name != "work"]
    for label, names in (
        ("all but the stages' work, %", others),
        ("start-up, transfers, queueing, %", TARGET_PARTS),
    ):
        shares = (share(part, names, job.wall_s) for part, job in zip(parts, jobs, strict=True))
        rows.append([label, *(number(100.0 * value) for value in shares)])
    print("\n" + markdown_table(["", *titles], rows))
    stages = [
        [stage.name, *(number(stage.parts()[name]) for name in STAGE_PARTS)]
        for stage in jobs[-1].stages
    ]
    print(f"\nStages of job {len(jobs)}, s:\n\n" + markdown_table(["", *STAGE_PARTS], stages))
    last = share(parts[-1], TARGET_PARTS, jobs[-1].wall_s)
    verdict = "below" if last < TARGET else "NOT below"
    print(
        f"\nStart-up, transfers and queueing take {100 * last:.2f} % of job {len(jobs)}: "
        f"{verdict} {100 * TARGET:.0f} %."
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--set", nargs="*", default=[], metavar="stage.option=value")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cache", type=Path, help="folder with compiled kernels")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    machine = describe()
    print(heading(machine))
    options = parse_assignments(arguments.set)
    jobs = measure(arguments.capture, arguments.preset, options, arguments.jobs, arguments.cache)
    print_report(jobs)
    values = {
        "benchmark": "job_overhead",
        "machine": machine,
        "preset": arguments.preset,
        "options": options,
        "jobs": [
            {
                **asdict(job),
                "wall_s": job.wall_s,
                "parts": job.parts(),
                "overhead_share": share(
                    job.parts(), [name for name in JOB_PARTS if name != "work"], job.wall_s
                ),
                "target_share": share(job.parts(), TARGET_PARTS, job.wall_s),
            }
            for job in jobs
        ],
    }
    write_json(arguments.json, values)


if __name__ == "__main__":
    main()
