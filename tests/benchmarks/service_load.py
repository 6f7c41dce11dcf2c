"""What a long queue costs: claims and answers with few and with many jobs waiting.

    python -m tests.benchmarks.service_load [--few 100] [--many 10000] [--calls 60] [--seconds 20]

On SQLite and, where the wheel is installed, on PostgreSQL. Prints the median of choosing and
claiming the next stage, of a look at what waits, of reading one job with its place in the queue, as
`GET /v1/jobs/{id}` does, and of a page of jobs, with few and with many jobs queued; that of
claiming a CPU stage while a thousand stages wait that only a GPU worker may take, and while none
do; and what two hundred callers who poll a job get, of an API with the many jobs queued.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import statistics
import time
from collections import Counter
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import httpx
from sqlalchemy import Table, insert, select, text

from pipelines.registry import STAGES
from storage.claims import Claim, claim_next
from storage.db import Database
from storage.jobs import StageSeed, queue_key, stage_id
from storage.keys import job_root
from storage.leases import release_stage
from storage.models import Event, Job, JobGeneration, StageRow, new_id
from storage.queries import get_job, list_jobs, queue_position, ready_unclaimed
from storage.queue import RESOURCES
from storage.tenants import DEFAULT_TENANT
from tests.benchmarks.api_process import HEADERS, empty_databases, kinds, serving
from tests.factories import make_job

SEEDS = [StageSeed(stage.name, stage.after, stage.needs_gpu) for stage in STAGES]
GPU_SEEDS = [StageSeed("train", (), needs_gpu=True)]
CPU_SEEDS = [StageSeed("poses", ())]
LEASE_S = 60.0
AT_ONCE = 50
DEADLINE_S = 120.0
NUM_GPU_STAGES = 1000
POLLERS = 200
POLL_S = 1.0


def enqueue(database: Database, count: int, seeds: list[StageSeed]) -> list[str]:
    """So many queued jobs more, a millisecond apart: one made, the others its copies. Their ids."""
    with database.session_scope() as session:
        first = make_job(session, seeds)
        created_at, tenant_id = first.created_at, first.tenant_id
        ids = [first.id, *(new_id() for _ in range(count - 1))]
        tables = [model.__table__ for model in (Job, StageRow, JobGeneration, Event)]
        originals: list[tuple[Table, list[dict[str, Any]]]] = []
        for table in tables:
            key = table.c.id if table is Job.__table__ else table.c.job_id
            found = session.execute(select(table).where(key == first.id)).mappings()
            originals.append((table, [{**row} for row in found]))  # type: ignore[arg-type]
    for begin in range(1, count, AT_ONCE):
        with database.session_scope() as session:
            for table, rows in originals:
                made = [
                    copy_of(table.name, row, ids[place], created_at + place * MS, tenant_id)
                    for place in range(begin, min(begin + AT_ONCE, count))
                    for row in rows
                ]
                session.execute(insert(table), made)
    if database.engine.dialect.name == "postgresql":
        with database.engine.connect() as connection:  # as autovacuum does within a minute
            connection.execution_options(isolation_level="AUTOCOMMIT").execute(text("ANALYZE"))
    return ids


MS = timedelta(milliseconds=1)


def copy_of(
    table: str, row: dict[str, Any], job_id: str, created_at: Any, tenant_id: str
) -> dict[str, Any]:
    """The same row for another job."""
    if table == "jobs":
        root = job_root(tenant_id, job_id)
        return {**row, "id": job_id, "created_at": created_at, "object_root": root}
    made = {**row, "job_id": job_id}
    if table == "stages":
        made["id"] = stage_id(job_id, row["name"])
        made["queue_key"] = queue_key(created_at, job_id, row["seq"])
    made.pop("seq" if table == "events" else "", None)
    return made


class Calls:
    """What is timed on one database; its queue is afterwards what it was."""

    def __init__(
        self, database: Database, job_id: str, resources: tuple[str, ...] = RESOURCES
    ) -> None:
        self._database = database
        self._job_id = job_id
        self._resources = resources
        self._claims: list[Claim] = []

    def claim(self) -> None:
        """Choose and claim the next stage."""
        with self._database.session_scope() as session:
            made = claim_next(session, [list(self._resources)], "benchmark", LEASE_S)
        assert made is not None
        self._claims.append(made)

    def look(self) -> None:
        """Whether anything waits."""
        with self._database.read_scope() as session:
            ready_unclaimed(session, limit=1)

    def read(self) -> None:
        """A job and its place, as its tenant is told."""
        with self._database.of_tenant(DEFAULT_TENANT).read_scope() as session:
            queue_position(session, get_job(session, self._job_id, manifests=True))

    def page(self) -> None:
        """The newest jobs of a tenant."""
        with self._database.of_tenant(DEFAULT_TENANT).read_scope() as session:
            list_jobs(session, limit=20)

    def undo(self) -> None:
        """Give back what was claimed."""
        for held in self._claims:
            with self._database.session_scope() as session:
                release_stage(session, held)
        self._claims.clear()


def medians_ms(calls: list[Callable[[], None]], times: int) -> list[float]:
    """Milliseconds of each call. They take turns, so that a busy machine is busy for all."""
    spent: list[list[float]] = [[] for _ in calls]
    for _ in range(times):
        for call, noted in zip(calls, spent, strict=True):
            begun = time.perf_counter()
            call()
            noted.append(1000.0 * (time.perf_counter() - begun))
    return [statistics.median(noted) for noted in spent]


def compare(names: tuple[str, ...], one: Calls, other: Calls, times: int) -> None:
    """Print a line for each call."""
    for name in names:
        getattr(one, name)(), getattr(other, name)()  # statements are compiled once
        small, large = medians_ms([getattr(one, name), getattr(other, name)], times)
        print(f"  {name:<8}{small:8.2f}{large:8.2f}   x {large / small:.2f}", flush=True)
    one.undo()
    other.undo()


async def polled(address: str, job_id: str, seconds: float) -> tuple[Counter[str], list[float]]:
    """What POLLERS callers get, by its kind, and after how many milliseconds."""
    outcomes: Counter[str] = Counter()
    spent: list[float] = []
    limits = httpx.Limits(max_connections=POLLERS)
    async with httpx.AsyncClient(
        base_url=address, headers=HEADERS, timeout=120, limits=limits
    ) as http:
        end = time.monotonic() + seconds

        async def poll(place: int) -> None:
            await asyncio.sleep(POLL_S * place / POLLERS)
            while True:
                begun = time.perf_counter()
                try:
                    outcome = str((await http.get(f"/v1/jobs/{job_id}")).status_code)
                except httpx.HTTPError as error:
                    outcome = type(error).__name__
                outcomes[outcome] += 1
                spent.append(1000.0 * (time.perf_counter() - begun))
                if time.monotonic() > end:
                    return
                await asyncio.sleep(POLL_S)

        await asyncio.gather(*(poll(place) for place in range(POLLERS)))
    return outcomes, spent


def report_polling(url: str, job_id: str, seconds: float) -> None:
    """Print what pollers get."""
    with serving(url) as address:
        outcomes, spent = asyncio.run(polled(address, job_id, seconds))
    said = ", ".join(f"{count} x {outcome}" for outcome, count in outcomes.most_common())
    p50, p99 = statistics.median(spent), statistics.quantiles(spent, n=100)[98]
    print(f"{POLLERS} pollers for {seconds:.0f} s: {said}; p50 {p50:.1f} ms, p99 {p99:.1f} ms")


def report(kind: str, few: int, many: int, times: int, seconds: float) -> None:
    """Print all of one kind of database."""
    with empty_databases(kind, 4) as urls, contextlib.ExitStack() as stack:
        databases = [Database(url, DEADLINE_S) for url in urls]
        for database in databases:
            stack.callback(database.dispose)
        short, long, plain, starving = databases
        last = enqueue(long, many, SEEDS)[-1]
        one, other = Calls(short, enqueue(short, few, SEEDS)[-1]), Calls(long, last)
        print(f"{kind}: p50 in ms with {few} and {many} queued jobs")
        compare(("claim", "look", "read", "page"), one, other, times)
        enqueue(starving, NUM_GPU_STAGES, GPU_SEEDS)
        cpu = [
            Calls(database, enqueue(database, times + 1, CPU_SEEDS)[-1], ("cpu",))
            for database in (plain, starving)
        ]
        print(f"{kind}: p50 in ms of a CPU stage behind 0 and {NUM_GPU_STAGES} GPU stages")
        compare(("claim",), cpu[0], cpu[1], times)
        print(f"{kind}, {many} queued jobs: ", end="", flush=True)
        report_polling(urls[1], last, seconds)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--few", type=int, default=100)
    parser.add_argument("--many", type=int, default=10_000)
    parser.add_argument("--calls", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--only", choices=["sqlite", "postgresql"])
    chosen = parser.parse_args()
    for kind in kinds():
        if chosen.only in (None, kind):
            report(kind, chosen.few, chosen.many, chosen.calls, chosen.seconds)


if __name__ == "__main__":
    main()
