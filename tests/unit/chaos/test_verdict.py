"""The verdict on a good world is good, and it notices each thing that can be wrong."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from api.jobs.service import stage_seeds
from pipelines.workspace import MANIFEST
from storage.claims import claim_stage
from storage.db import Database, now
from storage.jobs import create_job, stage_id
from storage.keys import attempt_prefix, blob_content, checkpoint_prefix
from storage.leases import succeed_stage
from storage.models import (
    Blob,
    Capture,
    Event,
    Job,
    JobGeneration,
    PendingDeletion,
    StageRow,
    StageRun,
    new_id,
)
from storage.objects_local import LocalObjectStore
from storage.records import create_capture
from storage.schema import upgrade
from storage.tenants import DEFAULT_TENANT
from tests.chaos import verdict
from tests.chaos.load import Accepted
from tests.chaos.plans import KIND, Plan, chains, make_plans
from tests.chaos.stages import CHAIN


@dataclass
class World:
    """Two jobs that went through, as records and objects hold them."""

    database: Database
    store: LocalObjectStore
    accepted: list[Accepted]

    def found(self) -> dict[str, list[str]]:
        """What the verdict finds wrong, by its kind."""
        told = verdict.of_records(self.database, self.store, self.accepted)
        return {kind: lines for kind, lines in told.items() if lines}

    def path(self, job: int, stage: str, name: str) -> Path:
        """Where a file of a stage lies."""
        with self.database.read_scope() as session:
            row = session.get_one(StageRow, stage_id(self.accepted[job].job_id, stage))
        return self.store.path_of(f"{row.output_prefix}{name}")

    def capture_path(self) -> Path:
        """Where the bytes of the first job's capture lie."""
        with self.database.read_scope() as session:
            found = session.get_one(Capture, self.accepted[0].capture_id)
        return self.store.path_of(found.object_key)


def opened(folder: Path, accepted: list[Accepted]) -> World:
    """The world that lies in a folder."""
    store = LocalObjectStore(folder / "objects", public_url="http://localhost", signing_key=b"k")
    return World(Database(f"sqlite:///{folder / 'records.db'}"), store, accepted)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Accepted]]:
    """A good world, made once."""
    folder = tmp_path_factory.mktemp("template")
    upgrade(f"sqlite:///{folder / 'records.db'}")
    made = opened(folder, [])
    plans = [plan for plan in make_plans(1, 60, 1.0) if plan.fate == "finish" and not plan.big]
    for plan in [plan for plan in plans if plan.preset == "draft"][:2]:
        add_job(made, plan, folder)
    made.database.dispose()
    return folder, made.accepted


@pytest.fixture
def world(template: tuple[Path, list[Accepted]], tmp_path: Path) -> World:
    """A copy of it, to do harm to."""
    folder, accepted = template
    shutil.copytree(folder, tmp_path / "world")
    return opened(tmp_path / "world", [*accepted])


def put(world: World, key: str, content: bytes, folder: Path) -> dict[str, Any]:
    """Store an object; its entry of a manifest."""
    source = folder / "source"
    source.write_bytes(content)
    world.store.put_file(key, source)
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def add_job(world: World, plan: Plan, folder: Path) -> None:
    """A job of this plan, run to its end by hand."""
    capture_id = new_id()
    content = plan.capture()
    key = blob_content(DEFAULT_TENANT, hashlib.sha256(content).hexdigest(), capture_id)
    entry = put(world, key, content, folder)
    with world.database.session_scope() as session:
        create_capture(
            session,
            capture_id=capture_id,
            filename="plan.zip",
            kind=KIND,
            num_bytes=entry["bytes"],
            sha256=entry["sha256"],
            brought=key,
            details={},
        )
        job = create_job(
            session,
            capture_id=capture_id,
            preset=plan.preset,
            preset_reason="",
            options={},
            stages=stage_seeds(plan.preset, KIND, ()),
            labels={"plan": plan.name},
        )
        job_id = job.id
    for name, made in chains(plan.stages(), entry["sha256"]).items():
        with world.database.session_scope() as session:
            claim = claim_stage(session, stage_id(job_id, name), "w", 60.0)
            assert claim is not None
            prefix = attempt_prefix(claim.root, name, claim.attempt, claim.token)
            files = [{"path": CHAIN, **put(world, prefix + CHAIN, made.encode(), folder)}]
            put(world, prefix + MANIFEST, b"{}", folder)
            succeed_stage(session, claim, manifest={"files": files}, output_prefix=prefix)
    world.accepted.append(Accepted(plan, job_id, capture_id, "succeeded"))


def test_a_good_world_is_found_good(world: World) -> None:
    assert world.found() == {}


def name_checkpoint(world: World) -> Path:
    """As of a stage that was cancelled once it had saved its state. Where its file would lie."""
    job_id = world.accepted[0].job_id
    with world.database.session_scope() as session:
        root = session.get_one(Job, job_id).object_root
        row = session.get_one(StageRow, stage_id(job_id, "depth"))
        row.checkpoint_prefix = checkpoint_prefix(root, "depth", 1, 2)
        return world.store.path_of(f"{row.checkpoint_prefix}step.json")


def test_a_checkpoint_that_a_retry_would_go_on_from_belongs_there(world: World) -> None:
    path = name_checkpoint(world)
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    assert world.found() == {}
    path.parent.with_name("1-1").mkdir()
    (path.parent.with_name("1-1") / "step.json").write_text("{}")
    assert list(world.found()) == [OBJECTS]


STATES, HISTORIES = "jobs in a wrong state", "histories that do not hold"
REPEATED, ROWS = "finished work repeated", "rows left behind"
OBJECTS = "objects wrong or left behind"


def in_records(change: Callable[[Session, str], object]) -> Callable[[World], None]:
    def plant(world: World) -> None:
        with world.database.session_scope() as session:
            change(session, world.accepted[0].job_id)

    return plant


def lose(session: Session, job_id: str) -> None:
    for model in (StageRow, StageRun, Event, JobGeneration):
        session.execute(delete(model).where(model.job_id == job_id))
    session.execute(delete(Job).where(Job.id == job_id))


def run_again(session: Session, job_id: str) -> None:
    session.add(
        StageRun(
            job_id=job_id,
            tenant_id=DEFAULT_TENANT,
            stage="depth",
            token=2,
            generation=1,
            attempt=2,
            owner="late",
            started_at=now(session),
            outcome="released",
        )
    )


def succeed_twice(session: Session, job_id: str) -> None:
    kind = (Event.job_id == job_id) & (Event.kind == "stage.succeeded") & (Event.stage == "depth")
    event = session.scalars(select(Event).where(kind)).one()
    fields: dict[str, Any] = {
        "tenant_id": event.tenant_id,
        "actor": "w",
        "data": event.data,
        "created_at": event.created_at,
    }
    session.add(Event(job_id=job_id, stage="depth", kind=event.kind, **fields))


def swap_contents(world: World) -> None:
    """The right bytes for a manifest of the wrong job: only their making tells."""
    first, second = (one.job_id for one in world.accepted)
    with world.database.session_scope() as session:
        rows = [session.get_one(StageRow, stage_id(one, "depth")) for one in (first, second)]
        rows[0].manifest, rows[1].manifest = rows[1].manifest, rows[0].manifest
    paths = [world.path(index, "depth", CHAIN) for index in range(2)]
    texts = [path.read_bytes() for path in paths]
    paths[0].write_bytes(texts[1])
    paths[1].write_bytes(texts[0])


def forget_job(world: World) -> None:
    """As a database without foreign keys would have it."""
    with sqlite3.connect(str(world.database.engine.url.database)) as connection:
        connection.execute("DELETE FROM jobs WHERE id = ?", (world.accepted[0].job_id,))


PLANTED: dict[str, tuple[Callable[[World], object], str]] = {
    "a job lost": (in_records(lose), STATES),
    "a job that failed": (
        in_records(lambda s, job: s.execute(update(Job).values(state="failed"))),
        STATES,
    ),
    "a job of nobody": (lambda world: world.accepted.pop(), STATES),
    "a stage that still runs": (
        in_records(lambda s, job: s.execute(update(StageRow).values(state="running"))),
        STATES,
    ),
    "a change without its event": (
        in_records(
            lambda s, job: s.execute(
                delete(Event).where(Event.stage == "depth", Event.kind == "stage.running")
            )
        ),
        HISTORIES,
    ),
    "a success told twice": (in_records(succeed_twice), REPEATED),
    "a stage begun again": (in_records(run_again), REPEATED),
    "a claim without an end": (
        in_records(lambda s, job: s.execute(update(StageRun).values(outcome=None))),
        REPEATED,
    ),
    "a deletion not done": (
        in_records(lambda s, job: s.add(PendingDeletion(prefix=f"jobs/{job}/", created_at=now(s)))),
        ROWS,
    ),
    "rows of a job that is gone": (forget_job, ROWS),
    "a blob that counts wrong": (
        in_records(lambda s, job: s.execute(update(Blob).values(refs=2))),
        ROWS,
    ),
    "a file lost": (lambda world: world.path(0, "depth", CHAIN).unlink(), OBJECTS),
    "a file damaged": (lambda world: world.path(0, "depth", CHAIN).write_text("x"), OBJECTS),
    "files of another job": (swap_contents, OBJECTS),
    "a checkpoint lost": (name_checkpoint, OBJECTS),
    "a file of nobody": (lambda world: world.path(0, "depth", "other").write_text("x"), OBJECTS),
    "a capture damaged": (lambda world: world.capture_path().write_text("x"), OBJECTS),
    "a capture's record lost": (
        in_records(lambda s, job: s.execute(update(Capture).values(deleted_at=now(s)))),
        OBJECTS,
    ),
}


@pytest.mark.parametrize("planted", PLANTED)
def test_each_thing_that_can_be_wrong_is_noticed(world: World, planted: str) -> None:
    plant, kind = PLANTED[planted]
    plant(world)
    assert world.found().get(kind), f"the verdict did not notice {planted}"


def test_what_processes_leave_on_disks_and_in_logs_is_noticed(tmp_path: Path) -> None:
    assert verdict.orphan_files([tmp_path]) == []
    (tmp_path / "work" / "0123").mkdir(parents=True)
    assert len(verdict.orphan_files([tmp_path])) == 1
    log = tmp_path / "api.log"
    log.write_text("2026 INFO nerfworks.access abc GET '/v1/jobs/500' 200 0.012\n")
    assert verdict.broken_answers([log]) == []
    log.write_text("2026 INFO nerfworks.access abc GET '/v1/jobs' 500 0.012\n")
    assert len(verdict.broken_answers([log])) == 1
