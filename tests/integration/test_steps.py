"""`kill -9` of a worker at every named step of a job, and the answer of every COMMIT lost.

Real processes, on both databases. After each: another worker takes over, the job ends as it should,
nothing that was recorded is done again, what is published is whole and there once, and after the
sweep nothing else is left. Leases are the usual ones; the reaper is told that a minute has gone by.
The API's steps are in `test_steps_api.py`.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from deploy.embedded import free_port
from storage.claims import claim_stage
from storage.db import now
from storage.jobs import stage_id
from storage.keys import attempt_prefix, job_root
from storage.leases import reap_expired
from storage.models import Job, new_id
from storage.objects_local import LocalObjectStore
from storage.steps import names
from storage.tenants import DEFAULT_TENANT
from tests.faults import at_step, lose_answer
from tests.histories import check_history
from tests.integration.aftermath import check_only_what_is_named, check_published
from tests.integration.engine import Engine, is_running
from tests.integration.victims import QUICK, TOYS, wait_for_death, worker_that_dies
from worker.runtime import WorkerIdentity, WorkerRuntime

pytestmark = pytest.mark.services
SKIP = ("frames", "mesh", "video")
LEASE_OVER = timedelta(seconds=QUICK.lease_s + 1)


class Service:
    """One database for all cases, and a worker in this process that takes over when it is told."""

    def __init__(self, folder: Path, **environment: str) -> None:
        self.engine = Engine(folder, f"redis://127.0.0.1:{free_port()}/0", **environment)
        self.database = self.engine.database
        assert isinstance(self.engine.store, LocalObjectStore)
        self.store = self.engine.store
        self.log = folder / "victim.log"
        identity = WorkerIdentity("rescuer", 1, ("cpu", "light"), False)
        # It is never started: it does what it is told, and no more.
        self.rescuer = WorkerRuntime(identity, self.engine.settings, QUICK, registry=TOYS)

    def close(self) -> None:
        self.rescuer.close()
        self.engine.close()

    def reap(self) -> None:
        """A minute went by, and nobody beat."""
        with self.database.session_scope("reaper") as session:
            reap_expired(session, now(session) + LEASE_OVER)

    def finish(self, job: str, timeout_s: float = 200.0) -> Job:
        """Have the other worker do what there is to do until the job is over.

        The reaper comes by more than once, as it does in life: PostgreSQL may hold a dead worker's
        rows for a moment yet, and locked ones are left to the next time.
        """
        deadline = time.monotonic() + timeout_s
        while (found := self.engine.job(job)).finished_at is None:
            assert time.monotonic() < deadline, f"the job is {found.state}"
            self.reap()
            self.rescuer.serve()
            time.sleep(0.02)
        return found

    def check(self, job: str) -> None:
        """All is as if nothing had happened, but for the history."""
        with self.database.read_scope() as session:
            check_history(session, job)
        check_published(self.database, self.store, job)
        self.rescuer._housekeeping.clean()
        assert not list(self.engine.settings.work_dir.iterdir())
        check_only_what_is_named(self.database, self.store)
        pids = {int(line.split()[-1]) for line in self.engine.notes("") if " start " in line}
        mine = getattr(self.rescuer._runners[0]._process, "pid", None)
        self.engine.wait(lambda: not [pid for pid in pids - {mine} if is_running(pid)], 60)


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Service]:
    environment = {}
    if request.param == "postgresql":
        environment["NERFWORKS_DATABASE_URL"] = request.getfixturevalue("postgres_module_url")
    made = Service(tmp_path_factory.mktemp("steps"), **environment)
    yield made
    made.close()


@dataclass(frozen=True)
class Case:
    """A worker runs `ingest` and then `train`, and dies at a step of the latter.

    nth: which time that step is reached. plan: what `train` does. train: how its claims have ended
    when another worker has brought the job to its end. saved: whether a checkpoint is recorded when
    the first one dies. meanwhile: what people do once `train` runs.
    """

    step: str
    nth: int
    train: tuple[str, ...]
    plan: dict[str, Any] = field(default_factory=dict)
    ends: str = "succeeded"
    saved: bool = False
    meanwhile: str = ""

    def __str__(self) -> str:
        how = self.meanwhile or next(iter(self.plan), "")
        return f"{self.step} {how}".strip()


LOST = ("lost", "succeeded")
ONCE = ("succeeded",)
SAVES = {"save_every": 1}
FAILS = {"fail": True}
CRASHES = {"crash_times": 1}
KILLS = (
    Case("claim.commit", 1, ONCE),
    Case("claim.committed", 1, LOST),
    Case("run.fetched", 1, LOST),
    Case("run.begun", 1, LOST),
    Case("run.done", 1, LOST),
    Case("beat.commit", 1, LOST, {"holds": True}),
    Case("beat.committed", 1, LOST, {"holds": True}),
    Case("checkpoint.bytes", 1, LOST, SAVES),
    Case("checkpoint.put", 1, LOST, SAVES),
    Case("checkpoint.stored", 1, LOST, SAVES),
    Case("checkpoint.commit", 1, LOST, SAVES),
    Case("checkpoint.commit", 2, LOST, SAVES, saved=True),
    Case("checkpoint.committed", 1, LOST, SAVES, saved=True),
    Case("checkpoint.committed", 2, LOST, SAVES, saved=True),
    Case("checkpoint.replaced", 1, LOST, SAVES, saved=True),
    Case("publish.bytes", 1, LOST),
    Case("publish.put", 1, LOST),
    Case("publish.put", 2, LOST),
    Case("publish.stored", 1, LOST),
    Case("finish.commit", 1, LOST),
    Case("finish.committed", 1, ONCE),
    Case("finish.tidied", 1, ONCE),
    Case("report.bytes", 1, ("lost", "error"), FAILS, "failed"),
    Case("report.put", 1, ("lost", "error"), FAILS, "failed"),
    Case("report.stored", 1, ("lost", "error"), FAILS, "failed"),
    Case("finish.commit", 1, ("lost", "error"), FAILS, "failed"),
    Case("finish.committed", 1, ("error",), FAILS, "failed"),
    Case("finish.commit", 1, LOST, CRASHES),
    Case("finish.committed", 1, ("killed", "succeeded"), CRASHES),
    Case("finish.commit", 1, ("lost",), SAVES, "cancelled", meanwhile="cancel"),
    Case("finish.committed", 1, ("cancelled",), SAVES, "cancelled", meanwhile="cancel"),
    Case("finish.commit", 1, LOST, SAVES, meanwhile="shutdown"),
    Case("finish.committed", 1, ("released", "succeeded"), SAVES, meanwhile="shutdown"),
)


@pytest.mark.parametrize("case", KILLS, ids=str)
def test_a_worker_dies(service: Service, case: Case, tmp_path: Path) -> None:
    engine, gate = service.engine, tmp_path / "go on"
    holds = "holds" in case.plan or "save_every" in case.plan
    plan = {**case.plan, **({"until": str(gate)} if holds else {})}
    engine.witness.write_text("")
    victim = worker_that_dies(engine.settings, service.log, case.step, case.nth, claims=2)
    job = engine.submit({"train": plan}, skip=SKIP, ring=False)
    if case.meanwhile:
        engine.wait(lambda: engine.stage(job, "train").checkpoint_prefix, 120)
    if case.meanwhile == "cancel":
        engine.cancel(job)
    elif case.meanwhile == "shutdown":
        assert victim.pid is not None
        os.kill(victim.pid, signal.SIGTERM)
    wait_for_death(victim, service.log)
    left = engine.stage(job, "train")
    kept = left.checkpoint_prefix
    assert kept is not None or not case.saved
    if left.lease_until is not None:
        with service.database.read_scope() as session:
            assert left.lease_until - now(session) < LEASE_OVER, "others wait for longer than that"
    gate.touch()
    found = service.finish(job)
    assert found.state == case.ends, found.error
    assert engine.outcomes(job, "ingest") == ["succeeded"]
    assert tuple(engine.outcomes(job, "train")) == case.train
    assert len(engine.notes("ingest start")) == 1
    if case.ends == "succeeded" and case.train != ONCE:
        assert bool(engine.notes("train resume")) == (kept is not None)
    service.check(job)


@pytest.mark.parametrize("step", ["reap.commit", "reap.committed"])
def test_a_reaper_dies(service: Service, step: str) -> None:
    job = service.engine.submit({}, skip=SKIP, ring=False)
    with service.database.session_scope() as session:
        assert claim_stage(session, stage_id(job, "ingest"), "nobody", -1.0) is not None
    victim = worker_that_dies(service.engine.settings, service.log, step)
    wait_for_death(victim, service.log)
    assert service.engine.stage(job, "ingest").state == (
        "running" if step == "reap.commit" else "ready"
    )
    assert service.finish(job).state == "succeeded"
    assert service.engine.outcomes(job, "ingest") == ["lost", "succeeded"]
    service.check(job)


@pytest.mark.parametrize("step", ["sweep.commit", "sweep.committed"])
def test_a_sweep_dies(service: Service, step: str) -> None:
    nobody = attempt_prefix(job_root(DEFAULT_TENANT, new_id()), "train", 1, 1)
    service.store.put_file(f"{nobody}model.zip", service.engine.witness)
    old = time.time() - 2 * 86_400
    os.utime(service.store.path_of(f"{nobody}model.zip"), (old, old))
    wait_for_death(worker_that_dies(service.engine.settings, service.log, step), service.log)
    check_only_what_is_named(service.database, service.store)


LOSES = (
    Case("claim.commit", 1, ONCE),
    Case("claim.committed", 1, LOST),
    Case("beat.commit", 1, ONCE, {"holds": True}),
    Case("beat.committed", 1, ONCE, {"holds": True}),
    Case("checkpoint.commit", 1, ONCE, SAVES),
    Case("checkpoint.commit", 2, ONCE, SAVES),
    Case("checkpoint.committed", 1, ONCE, SAVES),
    Case("checkpoint.committed", 2, ONCE, SAVES),
    Case("finish.commit", 1, ONCE),
    Case("finish.committed", 1, ONCE),
    Case("finish.commit", 1, ("error",), FAILS, "failed"),
    Case("finish.committed", 1, ("error",), FAILS, "failed"),
    Case("finish.commit", 1, ("killed", "succeeded"), CRASHES),
    Case("finish.committed", 1, ("killed", "succeeded"), CRASHES),
    Case("finish.commit", 1, ("cancelled",), {"holds": True}, "cancelled", meanwhile="cancel"),
    Case("finish.committed", 1, ("cancelled",), {"holds": True}, "cancelled", meanwhile="cancel"),
)


@pytest.mark.parametrize("case", LOSES, ids=str)
def test_the_answer_to_a_commit_is_lost(
    service: Service, case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was applied, or it was not: the worker that lives on comes to the same end."""
    monkeypatch.setattr("worker.runner.RECORD_STEP_S", 0.01)
    engine, gate = service.engine, tmp_path / "go on"
    engine.witness.write_text("")
    holds = "holds" in case.plan or "save_every" in case.plan
    plan = {**case.plan, **({"until": str(gate)} if holds else {})}
    job = engine.submit({"train": plan}, skip=SKIP, ring=False)

    def lose() -> None:
        gate.touch()
        lose_answer()

    def cancel() -> None:
        engine.wait(lambda: engine.notes("train start"), 120)
        engine.cancel(job)

    with at_step(case.step, lose, case.nth, claims=2) as happened, ThreadPoolExecutor(1) as pool:
        people = pool.submit(cancel if case.meanwhile else lambda: None)
        with contextlib.suppress(OperationalError):  # of the claim: nobody knows that it is held
            service.rescuer.serve(stage_id(job, "ingest"))
        people.result(60)
    assert happened.is_set()
    assert service.finish(job).state == case.ends
    assert engine.outcomes(job, "ingest") == ["succeeded"]
    assert tuple(engine.outcomes(job, "train")) == case.train
    assert len(engine.notes("train start")) == len(case.train) - (case.step == "claim.committed")
    service.check(job)


@pytest.mark.parametrize("step", ["reap.commit", "reap.committed"])
def test_the_answer_to_a_reaper_is_lost(service: Service, step: str) -> None:
    job = service.engine.submit({}, skip=SKIP, ring=False)
    with service.database.session_scope() as session:
        assert claim_stage(session, stage_id(job, "ingest"), "nobody", -1.0) is not None
    with at_step(step), pytest.raises(OperationalError):
        service.rescuer._housekeeping.reap()
    service.rescuer._housekeeping.reap()
    assert service.finish(job).state == "succeeded"
    assert service.engine.outcomes(job, "ingest") == ["lost", "succeeded"]
    service.check(job)


@pytest.mark.parametrize(
    "step", ["sweep.commit", "sweep.committed", "erase.commit", "erase.committed"]
)
def test_the_answer_to_a_sweep_is_lost(service: Service, step: str) -> None:
    nobody = attempt_prefix(job_root(DEFAULT_TENANT, new_id()), "train", 1, 1)
    service.store.put_file(f"{nobody}model.zip", service.engine.witness)
    with at_step(step), pytest.raises(OperationalError):
        check_only_what_is_named(service.database, service.store)
    check_only_what_is_named(service.database, service.store)


def test_each_step_is_in_a_table() -> None:
    """And the cases themselves fail where a step is not reached."""
    from tests.integration.test_steps_api import KILLS as AT_THE_API
    from tests.integration.test_steps_api import LOSES as LOST_AT_THE_API

    housekeeping = {"reap.commit", "reap.committed", "sweep.commit", "sweep.committed"}
    killed = {case.step for case in KILLS} | {step for _, step in AT_THE_API} | housekeeping
    assert killed == set(names())
    lost = {case.step for case in LOSES} | {step for _, step in LOST_AT_THE_API} | housekeeping
    lost |= {"erase.commit", "erase.committed"}
    assert lost == {name for name in names() if name.endswith((".commit", ".committed"))}
