"""`make demo`: one capture through the whole service, over HTTP, and back as files.

Starts an embedded service of its own in HOME/demo-<random> on free ports, so that a service that
runs from the same folder is not disturbed; stops everything it started and removes that folder at
the end, also on Ctrl-C and on failure. Results land in out/<job id>/.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType

from rich.console import Console

from api.client.client import Client, NerfworksError
from api.client.display import print_error, print_results, transfer_bar, watch_job
from deploy.embedded import Embedded, default_home, free_port
from deploy.supervisor import StartFailed
from pipelines.assignments import AssignmentError, parse_assignments


class Stopped(Exception):
    """SIGTERM or SIGHUP arrived: unwind as Ctrl-C does."""


def _raise_stopped(number: int, frame: FrameType | None) -> None:
    del frame
    raise Stopped(signal.Signals(number).name)


def sample_capture(cache: Path, console: Console) -> Path:
    """The sample clip, filmed once and kept in the cache."""
    clip = cache / "sample.mp4"
    if not clip.is_file():
        console.print("Filming the sample capture")
        cache.mkdir(parents=True, exist_ok=True)
        filmed = cache / f".sample-{os.getpid()}.mp4"
        subprocess.run([sys.executable, "-m", "pipelines.sample", str(filmed)], check=True)
        filmed.replace(clip)
    return clip


def run_job(client: Client, capture: Path, console: Console) -> int:
    """Upload, run, download, show. Returns the process's exit status."""
    options = parse_assignments(os.environ.get("SET", "").split())
    with transfer_bar(console, "upload") as report:
        uploaded = client.upload(capture, lambda done, total: report(capture.name, done, total))
    console.print(f"Capture {uploaded.id}: {uploaded.kind}", highlight=False)
    job = client.create_job(uploaded.id, os.environ.get("PRESET") or None, options)
    console.print(f"Job {job.id}: preset {job.preset} ({job.preset_reason})", highlight=False)
    job = watch_job(client, job.id, console)
    folder = Path("out") / job.id
    if job.state != "succeeded":
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "logs.txt").write_text("\n".join(client.logs(job.id)) + "\n", "utf-8")
        print_error(job, console)
        console.print(f"The job is {job.state}. Its logs: {folder / 'logs.txt'}", highlight=False)
        return 1
    with transfer_bar(console, "download") as report:
        client.download(job.id, folder, progress=report)
    print_results(job, folder, json.loads((folder / "report.json").read_text("utf-8")), console)
    return 0


def main() -> int:
    """Run the demo. Returns the process's exit status."""
    console = Console()
    wanted = os.environ.get("CAPTURE", "")
    signal.signal(signal.SIGTERM, _raise_stopped)
    signal.signal(signal.SIGHUP, _raise_stopped)
    base = default_home()
    base.mkdir(parents=True, exist_ok=True)
    cache = base / "cache"
    home = Path(tempfile.mkdtemp(prefix="demo-", dir=base))
    embedded = Embedded.at(home, "127.0.0.1", free_port(), cache)
    supervisor = embedded.supervisor(lambda line: console.print(line, highlight=False))
    try:
        capture = Path(wanted) if wanted else sample_capture(cache, console)
        console.print("Starting the service")
        supervisor.start()
        with Client(embedded.url, embedded.secrets.api_key) as client:
            return run_job(client, capture, console)
    except (KeyboardInterrupt, Stopped):
        console.print("Stopped: nothing is left running.")
        return 130
    except (StartFailed, NerfworksError, AssignmentError, subprocess.CalledProcessError) as error:
        console.print(f"[red]The demo failed.[/red] {error}", highlight=False)
        return 1
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        supervisor.stop()
        shutil.rmtree(home, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
