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
from typing import Any

from rich.console import Console

from api.cli import print_results, watch_job
from api.client import Client, NerfworksError, parse_assignments
from deploy.embedded import Embedded, default_home, free_port
from deploy.supervisor import StartFailed


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
    options: dict[str, Any] = parse_assignments(os.environ.get("SET", "").split())
    with console.status(f"Uploading {capture.name}"):
        uploaded = client.upload(capture)
    console.print(f"Capture {uploaded.id}: {uploaded.kind}, {uploaded.bytes / 1e6:.1f} MB")
    job = client.create_job(uploaded.id, preset=os.environ.get("PRESET") or None, options=options)
    console.print(f"Job {job.id}: preset {job.preset} ({job.preset_reason})")
    job = watch_job(client, job.id, console)
    folder = Path("out") / job.id
    if job.state != "succeeded":
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "logs.txt").write_text("\n".join(client.logs(job.id)), "utf-8")
        error = job.error
        console.print(f"[red]The job {job.state}.[/red]", highlight=False)
        if error is not None:
            console.print(f"{error.message}\n{error.hint}", highlight=False)
        console.print(f"Its logs: {folder / 'logs.txt'}")
        return 1
    client.download(job.id, folder)
    report = json.loads((folder / "report.json").read_text("utf-8"))
    print_results(job, folder, report, console)
    return 0


def main() -> int:
    """Run the demo. Returns the process's exit status."""
    console = Console()
    wanted = os.environ.get("CAPTURE", "")
    if wanted and not Path(wanted).is_file():
        console.print(f"There is no file {wanted}. CAPTURE is a video, or a .zip of photos.")
        return 2
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
    except (StartFailed, NerfworksError, subprocess.CalledProcessError) as error:
        console.print(f"[red]The demo failed.[/red] {error}", highlight=False)
        return 1
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        supervisor.stop()
        shutil.rmtree(home, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
