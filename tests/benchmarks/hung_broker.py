"""What the API's callers notice of a broker that accepts, and never answers.

    python -m tests.benchmarks.hung_broker [--posts 100]

Starts the API as a process of its own, on SQLite, with such a broker; sends jobs from eight
connections and, meanwhile, reads a job and asks /livez. Prints the median, the 99th percentile and
the slowest of each, in milliseconds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx

from tests.services import Gate, free_port, stop, wait_for_port
from tests.unit.api.conftest import KEY, zip_of_pictures

CONNECTIONS = 8


def timed(http: httpx.Client, path: str, done: threading.Event) -> list[float]:
    """Milliseconds of one GET after the other, until it is done."""
    spent = []
    while not done.is_set():
        begun = time.perf_counter()
        http.get(path).raise_for_status()
        spent.append(1000.0 * (time.perf_counter() - begun))
        time.sleep(0.005)
    return spent


def measure(http: httpx.Client, posts: int) -> dict[str, list[float]]:
    """Milliseconds of each kind of call."""
    files = {"file": ("a.zip", zip_of_pictures())}
    capture = http.post("/v1/captures", files=files).raise_for_status().json()["id"]
    body = {"capture_id": capture}
    job = http.post("/v1/jobs", json=body).raise_for_status().json()["id"]

    def post(_: int) -> float:
        begun = time.perf_counter()
        http.post("/v1/jobs", json=body).raise_for_status()
        return 1000.0 * (time.perf_counter() - begun)

    done = threading.Event()
    with ThreadPoolExecutor(2) as pollers, ThreadPoolExecutor(CONNECTIONS) as posters:
        reads = pollers.submit(timed, http, f"/v1/jobs/{job}", done)
        lives = pollers.submit(timed, http, "/livez", done)
        posted = [*posters.map(post, range(posts))]
        done.set()
    got, alive = reads.result(), lives.result()
    return {"POST /v1/jobs": posted, "GET /v1/jobs/ID": got, "GET /livez": alive}


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--posts", type=int, default=100)
    chosen = parser.parse_args()
    broker, port = Gate(), free_port()
    with tempfile.TemporaryDirectory(prefix="nwhb") as home:
        environment = {
            **os.environ,
            "NERFWORKS_HOME": home,
            "NERFWORKS_REDIS_URL": f"redis://127.0.0.1:{broker.port}/0",
            "NERFWORKS_BOOTSTRAP_API_KEY": KEY,
        }
        with (Path(home) / "api.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "api", "--port", str(port)], env=environment, stderr=log
            )
        try:
            wait_for_port(port, process, 60.0)
            key = {"Authorization": f"Bearer {KEY}"}
            with httpx.Client(
                base_url=f"http://127.0.0.1:{port}", headers=key, timeout=120
            ) as http:
                found = measure(http, chosen.posts)
        finally:
            stop(process)
            broker.close()
    print(f"{'':<18}{'calls':>7}{'p50':>9}{'p99':>9}{'slowest':>9}  ms")
    for name, spent in found.items():
        p99 = statistics.quantiles(spent, n=100)[98]
        row = f"{statistics.median(spent):>9.1f}{p99:>9.1f}{max(spent):>9.1f}"
        print(f"{name:<18}{len(spent):>7}{row}")


if __name__ == "__main__":
    main()
