"""What the API's callers, and leases, notice of a broker that accepts, and never answers.

    python -m tests.benchmarks.hung_broker [--posts 100]

Starts the API as a process of its own with such a broker, on SQLite and, where the wheel is
installed, on PostgreSQL; sends jobs from eight connections and, meanwhile, reads a job and asks
/livez. Beside it a worker's housekeeping, which rings the same broker, takes back leases that run
out. Prints the median, the 99th percentile and the slowest of each, in milliseconds; of the leases
what passed between their end and their taking back, of which up to a round (`tick_s`) is meant to.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import httpx
from sqlalchemy import select

from storage.bell import Bell
from storage.claims import claim_stage
from storage.db import Database, now
from storage.jobs import stage_id
from storage.models import Event, StageRow
from storage.objects_local import LocalObjectStore
from tests.benchmarks.api_process import HEADERS, empty_databases, kinds, serving
from tests.factories import make_job
from tests.services import Gate
from tests.unit.api.conftest import zip_of_pictures
from worker.housekeeping import Housekeeping
from worker.settings import WorkerSettings

CONNECTIONS = 8
NUM_LEASES = 20
LEASE_STEP_S = 0.25
SETTLE_S = 2.0
"""An API that started just now imports the broker's library (`storage.bell.Bell.prepare`)."""
TICK_S = 1.0


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
        try:
            posted = [*posters.map(post, range(posts))]
        finally:
            done.set()
    got, alive = reads.result(), lives.result()
    return {"POST /v1/jobs": posted, "GET /v1/jobs/ID": got, "GET /livez": alive}


@contextmanager
def reaping(database: Database, broker_port: int, folder: Path) -> Iterator[list[float]]:
    """Leases that run out one by one, and housekeeping that takes them back, around a block.

    After it: the milliseconds that each was late.
    """
    ends = {}
    with database.session_scope() as session:
        jobs = [make_job(session).id for _ in range(NUM_LEASES)]
        for job in jobs:
            assert claim_stage(session, stage_id(job, "first"), "gone", 3600.0) is not None
    with database.session_scope() as session:
        begun = now(session)
        for place, job in enumerate(jobs):
            ends[job] = begun + timedelta(seconds=(place + 1) * LEASE_STEP_S)
            session.get_one(StageRow, stage_id(job, "first")).lease_until = ends[job]
    keeper = Housekeeping(
        database,
        LocalObjectStore(folder / "objects", public_url="", signing_key=b""),
        Bell(f"redis://127.0.0.1:{broker_port}/0", database),
        WorkerSettings(tick_s=TICK_S),
        work_dir=folder / "work",
        register=lambda: None,
        offer=lambda: None,
    )
    late: list[float] = []
    keeper.start()
    yield late
    end = time.monotonic() + 120.0
    taken = select(Event.job_id, Event.created_at).where(Event.reason == "lease_expired")
    while True:
        with database.read_scope() as session:
            found = session.execute(taken).all()
        if len(found) == NUM_LEASES or time.monotonic() > end:
            break
        time.sleep(TICK_S)
    keeper.stop(10.0)
    assert len(found) == NUM_LEASES, "leases that ran out were not taken back"
    late += [1000.0 * (moment - ends[job_id]).total_seconds() for job_id, moment in found]


def report(kind: str, posts: int) -> None:
    """Print the table of one kind of database."""
    broker = Gate()
    try:
        with (
            empty_databases(kind, 1) as (url,),
            tempfile.TemporaryDirectory(prefix="nwhb") as folder,
            serving(url, broker.port) as address,
            httpx.Client(base_url=address, headers=HEADERS, timeout=120) as http,
        ):
            time.sleep(SETTLE_S)
            database = Database(url)
            with reaping(database, broker.port, Path(folder)) as late:
                found = measure(http, posts)
            database.dispose()
    finally:
        broker.close()
    print(f"{kind:<18}{'calls':>7}{'p50':>9}{'p99':>9}{'slowest':>9}  ms")
    for name, spent in {**found, f"reaping (/{TICK_S:.0f} s)": late}.items():
        p99 = statistics.quantiles(spent, n=100, method="inclusive")[98]
        row = f"{statistics.median(spent):>9.1f}{p99:>9.1f}{max(spent):>9.1f}"
        print(f"{name:<18}{len(spent):>7}{row}", flush=True)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--posts", type=int, default=100)
    parser.add_argument("--only", choices=["sqlite", "postgresql"])
    chosen = parser.parse_args()
    for kind in kinds():
        if chosen.only in (None, kind):
            report(kind, chosen.posts)


if __name__ == "__main__":
    main()
