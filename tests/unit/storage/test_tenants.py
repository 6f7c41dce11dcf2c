"""A session of one tenant sees, changes and deletes nothing of another's, whatever it is asked."""

from __future__ import annotations

import pytest
from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import joinedload, selectinload

from storage.db import Database
from storage.errors import ConflictError, NotFoundError
from storage.exports import create_export, open_for_export
from storage.jobs import create_job, delete_job, open_for_retry, request_cancel
from storage.models import Base, Capture, Event, Job, StageRow
from storage.queries import get_job, list_captures, list_events, list_jobs, queue_position
from storage.records import delete_capture, get_capture, read_logs
from storage.tenants import Tenanted
from tests.factories import LINE, make_capture, make_job

OURS, THEIRS = "ours", "theirs"


@pytest.fixture
def made(either_database: Database) -> tuple[Database, dict[str, str], dict[str, str]]:
    """A database, and for each of two tenants the ids of its capture and its job on it."""
    ids = []
    for tenant in (THEIRS, OURS):
        with either_database.session_scope() as session:
            capture = make_capture(session, tenant_id=tenant, sha256="5" * 64)
            ids.append({"capture": capture.id, "job": make_job(session, capture=capture).id})
    return either_database, ids[1], ids[0]


def test_all_that_says_whose_it_is_is_kept_apart() -> None:
    """A table with a tenant that does not derive from `Tenanted` would be shown to everybody."""
    for mapper in Base.registry.mappers:
        assert ("tenant_id" in mapper.columns) == issubclass(mapper.class_, Tenanted), mapper


def test_lists_and_looks_show_ones_own_alone(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    database, ours, theirs = made
    with database.of_tenant(OURS).read_scope() as session:
        assert [job.id for job in list_jobs(session)[0]] == [ours["job"]]
        assert [one.id for one in list_captures(session)[0]] == [ours["capture"]]
        assert get_job(session, ours["job"]).stages
        assert list_events(session, ours["job"])
        assert list_events(session, theirs["job"]) == []
        assert read_logs(session, theirs["job"]).total == 0
        for look in (
            lambda: get_job(session, theirs["job"]),
            lambda: get_capture(session, theirs["capture"]),
        ):
            with pytest.raises(NotFoundError):
                look()


def test_joins_counts_and_relationships_show_ones_own_alone(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    database, ours, theirs = made
    with database.of_tenant(OURS).read_scope() as session:
        both = (ours["job"], theirs["job"])
        stages = select(func.count()).select_from(StageRow).where(StageRow.job_id.in_(both))
        assert session.scalar(stages) == len(LINE)
        inner = select(Job.id).where(Job.id.in_(both)).subquery()
        assert session.scalar(select(func.count()).select_from(inner)) == 1
        joined = select(StageRow.job_id).join(Job, Job.id == StageRow.job_id).distinct()
        assert session.scalars(joined).all() == [ours["job"]]
        for loaded in (selectinload(Job.stages), joinedload(Job.capture)):
            found = session.scalars(select(Job).options(loaded)).unique().all()
            assert [job.id for job in found] == [ours["job"]]
        assert session.get(Job, theirs["job"]) is None
        assert session.get(StageRow, f"{theirs['job']}-first", with_for_update=True) is None


def test_no_operation_reaches_anothers(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    database, _, theirs = made
    mine = database.of_tenant(OURS)
    for operation in (
        lambda session: request_cancel(session, theirs["job"]),
        lambda session: delete_job(session, theirs["job"]),
        lambda session: open_for_retry(session, theirs["job"]),
        lambda session: open_for_export(session, theirs["job"]),
        lambda session: delete_capture(session, theirs["capture"]),
        lambda session: create_job(
            session,
            capture_id=theirs["capture"],
            preset="preview",
            preset_reason="",
            options={},
            stages=LINE,
        ),
    ):
        with pytest.raises(NotFoundError), mine.session_scope() as session:
            operation(session)
    with database.read_scope() as session:
        assert get_job(session, theirs["job"]).state == "queued"
        assert get_capture(session, theirs["capture"]).deleted_at is None


def test_changes_and_deletions_in_bulk_leave_anothers_alone(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    database, ours, theirs = made
    with database.of_tenant(OURS).session_scope() as session:
        session.execute(update(StageRow).values(message="touched"))
        session.execute(delete(Event))
        session.execute(
            update(Capture).values(filename="touched").returning(Capture.id),
            execution_options={"synchronize_session": False},
        )
    with database.read_scope() as session:
        said = select(StageRow.job_id, StageRow.message).distinct()
        assert dict(session.execute(said).all()) == {ours["job"]: "touched", theirs["job"]: ""}
        assert list_events(session, ours["job"]) == []
        assert list_events(session, theirs["job"])
        assert get_capture(session, theirs["capture"]).filename == "walk.mp4"


def test_one_tenant_after_the_other_on_one_connection(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    """What is added is not kept with a statement that both ask."""
    database, ours, theirs = made
    for _ in range(3):
        for tenant, job in ((OURS, ours["job"]), (THEIRS, theirs["job"])):
            with database.of_tenant(tenant).read_scope() as session:
                assert [one.id for one in list_jobs(session)[0]] == [job]
        with database.read_scope() as session:
            assert len(list_jobs(session)[0]) == 2


def test_what_a_tenant_adds_must_be_its_own(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    database, ours, _ = made
    with database.of_tenant(OURS).session_scope() as session:
        parent = open_for_export(session, ours["job"])
        assert create_export(session, parent, "mesh", {}).tenant_id == OURS
    with (
        pytest.raises(ValueError, match="adds a row of theirs"),
        database.of_tenant(OURS).session_scope() as session,
    ):
        make_capture(session, tenant_id=THEIRS)


def test_the_same_bytes_of_two_tenants_lie_apart(
    made: tuple[Database, dict[str, str], dict[str, str]],
) -> None:
    database, ours, theirs = made
    with database.read_scope() as session:
        keys = {
            get_capture(session, one["capture"]).object_key.split("/")[1] for one in (ours, theirs)
        }
    assert keys == {OURS, THEIRS}
    with pytest.raises(ConflictError), database.of_tenant(OURS).session_scope() as session:
        delete_capture(session, ours["capture"])  # its own job waits; the other's plays no part


def test_all_wait_in_one_queue(made: tuple[Database, dict[str, str], dict[str, str]]) -> None:
    database, ours, _ = made
    with database.of_tenant(OURS).read_scope() as session:
        assert queue_position(session, get_job(session, ours["job"])) == 2
