"""One run: start, shake, heal, wait, sweep, judge."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from storage.db import Database, now
from storage.deletions import drain_deletions
from storage.models import Job, PendingDeletion, StageRow, StageRun
from storage.objects_s3 import S3ObjectStore
from storage.open_objects import open_object_store
from storage.reconciling import sweep_orphans
from storage.settings import StorageSettings
from storage.states import JOB_TERMINAL
from tests.chaos import verdict
from tests.chaos.faults import Faults
from tests.chaos.load import Callers
from tests.chaos.plans import make_plans
from tests.chaos.schedule import APIS, PARTIES, make_schedule
from tests.chaos.servers import Cluster
from tests.e2e.processes import processes_mentioning

SUBMIT_SHARE = 0.8
STILL_S = 120.0
"""The promise: state is right so long after any fault."""
CLEAN_S = 60.0
JUDGE_S = 600.0
"""The verdict reads every object in one transaction."""
SAMPLES = 12


@dataclass
class Outcome:
    """wrong: what should not be, by its kind. facts: what happened, for people."""

    wrong: dict[str, list[str]] = field(default_factory=dict)
    facts: dict[str, object] = field(default_factory=dict)

    @property
    def is_good(self) -> bool:
        """Whether all held."""
        return not any(self.wrong.values())

    def lines(self) -> list[str]:
        """For people."""
        told = [f"{name}: {value}" for name, value in self.facts.items()]
        for name, found in self.wrong.items():
            told.append(f"{name}: {len(found) or 'none'}")
            told += [f"    {line}" for line in found[:20]]
        return [*told, "VERDICT: good" if self.is_good else "VERDICT: NOT good"]


class Overdue(threading.Thread):
    """Looks, beside the service, whether a lease stays run out for longer than was promised."""

    def __init__(self, database: Database) -> None:
        super().__init__(daemon=True)
        self.found: list[str] = []
        self.stop = threading.Event()
        self._database = database

    def run(self) -> None:
        """Look every two seconds."""
        while not self.stop.wait(2.0):
            try:
                with self._database.read_scope() as session:
                    edge = now(session) - timedelta(seconds=STILL_S)
                    late = StageRow.lease_until < edge
                    query = select(StageRow.id).where(StageRow.state == "running", late)
                    self.found += [
                        f"{name} ran out and nobody saw" for name in session.scalars(query)
                    ]
            except SQLAlchemyError:
                continue  # PostgreSQL is having its own fault


def shake(
    folder: Path, seed: int, jobs: int, minutes: float, say: Callable[[str], None]
) -> Outcome:
    """Everything. folder: an empty one, for logs and disks. Raises StartFailed."""
    seconds = 60.0 * minutes
    schedule = make_schedule(seed, seconds)
    say(f"seed {seed}: {jobs} jobs, {len(schedule)} faults over {seconds:.0f} s; logs in {folder}")
    cluster = Cluster(folder)
    outcome = Outcome()
    begun = time.monotonic()
    try:
        cluster.start()
        say(f"everything runs after {time.monotonic() - begun:.0f} s")
        database = Database(cluster.database_url, JUDGE_S)
        store = _store(cluster)
        callers = Callers(
            [cluster.url(name) for name in APIS], cluster.api_key, folder / "captures"
        )
        overdue = Overdue(database)
        overdue.start()
        begun = time.monotonic()
        callers.start(make_plans(seed, jobs, SUBMIT_SHARE * seconds))
        faults = Faults(cluster, say)
        faults.carry_out(schedule)
        say(f"the last fault is healed after {time.monotonic() - begun:.0f} s")
        still = _wait_until_over(database, callers, say)
        callers.give_up.set()  # where it is good, nobody waits
        callers.close()
        callers.give_up.clear()
        overdue.stop.set()
        overdue.join()
        accepted = callers.said.accepted
        _wait_until_clean(database, cluster)
        outcome.wrong["answers and callers"] = [
            *callers.said.broken,
            *verdict.broken_answers(cluster.logs / f"{name}.log" for name in APIS),
        ]
        if len(accepted) != jobs:
            outcome.wrong["answers and callers"].append(f"{len(accepted)} of {jobs} jobs accepted")
        outcome.wrong["not over in time"] = still + overdue.found
        outcome.wrong["downloads"] = _download_some(callers, folder / "downloads", seed)
        outcome.wrong["files left behind"] = verdict.orphan_files(
            {cluster.home(party) for party in PARTIES}
        )
        outcome.facts |= _facts(database, callers, faults, time.monotonic() - begun)
        cluster.service.stop()
        sweep_orphans(database, store, older_than=timedelta(0))
        while drain_deletions(database, store):
            pass
        outcome.wrong |= verdict.of_records(database, store, accepted)
        outcome.wrong["uploads half done"] = _unfinished(store)
        database.dispose()
    finally:
        cluster.close()
    outcome.wrong["processes left behind"] = [
        line for place in cluster.places() for line in processes_mentioning(place)
    ]
    return outcome


def _store(cluster: Cluster) -> S3ObjectStore:
    settings = {
        name.removeprefix("NERFWORKS_").lower(): value
        for name, value in cluster.s3.environment().items()
    }
    store = open_object_store(StorageSettings(**settings))  # type: ignore[arg-type]
    assert isinstance(store, S3ObjectStore)
    return store


def _wait_until_over(database: Database, callers: Callers, say: Callable[[str], None]) -> list[str]:
    """Wait while something gets on: what does not for so long will not."""
    last, since, told = (-1, -1, -1), time.monotonic(), 0.0
    while True:
        with database.read_scope() as session:
            live = session.scalars(
                select(func.count()).select_from(Job).where(Job.state.not_in(JOB_TERMINAL))
            ).one()
            ended = session.scalars(
                select(func.count()).select_from(StageRun).where(StageRun.outcome.is_not(None))
            ).one()
            if not live and callers.are_done():
                return []
            names = session.scalars(select(Job.id).where(Job.state.not_in(JOB_TERMINAL))).all()
        moment = time.monotonic()
        if (now_at := (live, ended, len(callers.said.accepted))) != last:
            last, since = now_at, moment
        if moment - since > STILL_S:
            return [f"nothing happens to job {name}" for name in names] or ["callers wait"]
        if moment - told > 10.0:
            say(f"{live} jobs are not over yet, {len(callers.said.accepted)} were accepted")
            told = moment
        time.sleep(1.0)


def _wait_until_clean(database: Database, cluster: Cluster) -> None:
    """Give housekeeping its time; the verdict says what it did not do."""
    deadline = time.monotonic() + CLEAN_S
    homes = {cluster.home(party) for party in PARTIES}
    while time.monotonic() < deadline:
        with database.read_scope() as session:
            waiting = session.scalar(select(PendingDeletion.id).limit(1))
        if waiting is None and not verdict.orphan_files(homes):
            return
        time.sleep(1.0)


def _download_some(callers: Callers, folder: Path, seed: int) -> list[str]:
    """Download what some jobs offer, as a user would: the client checks every sha256."""
    good = [one for one in callers.said.accepted if one.wanted == "succeeded"]
    wrong = []
    for one in random.Random(seed).sample(good, min(SAMPLES, len(good))):
        try:
            paths = callers.call(lambda client: client.download(one.job_id, folder / one.job_id))  # noqa: B023
        except Exception as error:  # noqa: BLE001 whatever it is, a user gets no result
            wrong.append(f"job {one.job_id}: {error!r}")
            continue
        if "report.json" not in {path.name for path in paths}:
            wrong.append(f"job {one.job_id} offers no report")
    return wrong


def _unfinished(store: S3ObjectStore) -> list[str]:
    """Multipart uploads that nobody finished or dropped."""
    try:
        with_client = store._client.list_multipart_uploads(Bucket=store._bucket)
    except store._client.exceptions.NoSuchUpload:  # rclone's way to say that there is none
        return []
    return [f"{item['Key']} is half sent" for item in with_client.get("Uploads", [])]


def _facts(
    database: Database, callers: Callers, faults: Faults, seconds: float
) -> dict[str, object]:
    with database.read_scope() as session:
        states = select(Job.state, func.count()).group_by(Job.state)
        outcomes = select(StageRun.outcome, func.count()).group_by(StageRun.outcome)
        return {
            "faults": dict(sorted(faults.struck.items())),
            "jobs": {str(state): number for state, number in session.execute(states)},
            "claims by their end": {str(end): number for end, number in session.execute(outcomes)},
            "callers": f"{callers.said.unreached} times unreached, {callers.said.refused} refused",
            "seconds until all was over": round(seconds),
        }
