"""The records. State columns change only through `storage.transitions`.

A stage row carries its lease: `lease_token` rises by one with every claim and is the fencing token
that every later write of that claim must show.
"""

from __future__ import annotations

import re
import secrets
import time
from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship

from storage.db import CleanJson, CleanText, UtcDateTime
from storage.tenants import Tenanted

_BIG = BigInteger().with_variant(Integer(), "sqlite")  # only INTEGER counts up by itself there
ID_LENGTH = 28
_ID = re.compile(rf"[0-9a-f]{{{ID_LENGTH}}}", re.ASCII)


def new_id() -> str:
    """A random id that sorts by time: 12 hex digits of milliseconds, 16 of chance."""
    return f"{int(time.time() * 1000):012x}{secrets.token_hex(8)}"


def is_id(text: str) -> bool:
    """Whether a text has the form of such an id; every other one names nothing."""
    return _ID.fullmatch(text) is not None


class Base(DeclarativeBase):
    """Common ground: named constraints, so that migrations can speak of them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class Blob(Tenanted, Base):
    """Bytes in the object store, and how many captures are made of them (`storage.blobs`).

    sha256: of the bytes; a tenant's second upload of the same is one reference more. None where
    they lie twice, from the time before blobs: those of the second are not shared.
    """

    __tablename__ = "blobs"

    id: Mapped[str] = mapped_column(String(ID_LENGTH), primary_key=True, default=new_id)
    sha256: Mapped[str | None] = mapped_column(String(64))
    object_key: Mapped[str] = mapped_column(String(255))
    refs: Mapped[int] = mapped_column(Integer)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)

    __table_args__ = (
        Index(None, "tenant_id", "sha256", unique=True),
        Index(None, "object_key", unique=True),
    )


class Capture(Tenanted, Base):
    """An upload. A deleted one stays as a tombstone for the jobs that speak of it.

    blob_id: its bytes; None once it is deleted. object_key: where they lie, or lay.
    """

    __tablename__ = "captures"

    id: Mapped[str] = mapped_column(String(ID_LENGTH), primary_key=True, default=new_id)
    blob_id: Mapped[str | None] = mapped_column(ForeignKey("blobs.id"), index=True)
    filename: Mapped[str] = mapped_column(CleanText(255))
    kind: Mapped[str] = mapped_column(String(32))
    bytes: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))
    object_key: Mapped[str] = mapped_column(String(255))
    details: Mapped[dict[str, Any]] = mapped_column(CleanJson, default=dict)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    __table_args__ = (Index(None, "tenant_id", "created_at", "id"),)


class Job(Tenanted, Base):
    """The stages on one capture, or an export of another job's results (`storage.exports`).

    parent_id: the job that an export is of. generation: 1, and one more with every retry. options:
    of the present generation. object_root: the prefix of all its bytes.
    """

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(String(ID_LENGTH), primary_key=True, default=new_id)
    object_root: Mapped[str] = mapped_column(String(255))
    capture_id: Mapped[str] = mapped_column(ForeignKey("captures.id"), index=True)
    parent_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"))
    state: Mapped[str] = mapped_column(String(16))
    preset: Mapped[str] = mapped_column(String(32))
    preset_reason: Mapped[str] = mapped_column(CleanText(300), default="")
    options: Mapped[dict[str, Any]] = mapped_column(CleanJson)
    labels: Mapped[dict[str, str]] = mapped_column(CleanJson, default=dict)
    seed: Mapped[int] = mapped_column(BigInteger, default=0)
    generation: Mapped[int] = mapped_column(Integer, default=1)
    error: Mapped[dict[str, Any] | None] = mapped_column(CleanJson(none_as_null=True))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    started_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    finished_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    cancel_requested_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    capture: Mapped[Capture] = relationship(lazy="raise")
    parent: Mapped[Job | None] = relationship(remote_side=id, lazy="raise")
    stages: Mapped[list[StageRow]] = relationship(order_by="StageRow.seq", lazy="select")

    __table_args__ = (
        Index(None, "tenant_id", "created_at", "id"),
        Index(None, "state", "created_at", "id"),
        Index(None, "parent_id", "created_at", "id"),
    )


class JobGeneration(Tenanted, Base):
    """What a job was asked for, the first time and with every retry: what a retry overwrites.

    options: of all stages, as this generation ran them. from_stage: the one that its retry named.
    """

    __tablename__ = "job_generations"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    generation: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    options: Mapped[dict[str, Any]] = mapped_column(CleanJson)
    from_stage: Mapped[str | None] = mapped_column(String(32))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)


class StageRow(Tenanted, Base):
    """One stage of one job, and its lease.

    queue_key: sorts the stages that wait in the order of service. resource: what it runs on, "cpu"
    or "gpu". attempt: claims in this generation of the job, without those that were released.
    not_before: when a retry may start. ready_at: since when it could run. rung_at: when the bell
    last rang for it. progress_at: when it last got on. manifest: what `manifest.json` holds.
    fingerprint: all that its result depends on, as one number; a retry asks whether it is the same.
    These, output_prefix and summary are those of its last success, also while it is done again
    (`storage.results`). report_prefix, report_files: what it published of its failure.
    """

    __tablename__ = "stages"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    name: Mapped[str] = mapped_column(String(32))
    seq: Mapped[int] = mapped_column(Integer)
    after: Mapped[list[str]] = mapped_column(CleanJson)
    state: Mapped[str] = mapped_column(String(16))
    queue_key: Mapped[str] = mapped_column(String(48))
    resource: Mapped[str] = mapped_column(String(8))
    attempt: Mapped[int] = mapped_column(Integer, default=0)
    max_attempts: Mapped[int] = mapped_column(Integer, default=3)
    not_before: Mapped[datetime | None] = mapped_column(UtcDateTime)
    ready_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    rung_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    lease_owner: Mapped[str | None] = mapped_column(String(128))
    lease_token: Mapped[int] = mapped_column(Integer, default=0)
    lease_until: Mapped[datetime | None] = mapped_column(UtcDateTime)
    heartbeat_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    progress_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(CleanText(300), default="")
    eta_s: Mapped[float | None] = mapped_column()
    started_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    finished_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    error: Mapped[dict[str, Any] | None] = mapped_column(CleanJson(none_as_null=True))
    output_prefix: Mapped[str | None] = mapped_column(String(255))
    summary: Mapped[dict[str, Any] | None] = mapped_column(CleanJson(none_as_null=True))
    manifest: Mapped[dict[str, Any] | None] = mapped_column(
        CleanJson(none_as_null=True), deferred=True
    )
    fingerprint: Mapped[str | None] = mapped_column(CleanText(64))
    checkpoint_prefix: Mapped[str | None] = mapped_column(String(255))
    report_prefix: Mapped[str | None] = mapped_column(String(255))
    report_files: Mapped[list[dict[str, Any]] | None] = mapped_column(CleanJson(none_as_null=True))

    __table_args__ = (
        Index(None, "state", "lease_until"),
        Index(None, "state", "resource", "queue_key"),
        Index(None, "job_id", "name", unique=True),
    )


class StageRun(Tenanted, Base):
    """One claim of a stage, from its start to its end: what a later claim does not overwrite.

    owner: the worker's id and its boot nonce. outcome: how it ended (`storage.runs.OUTCOMES`), None
    while it runs. led_to: the state that its end put the stage into. checkpoints: how many it
    saved. exit_code: of the stage's process, negative for a signal. peak_bytes: the most memory
    that process held. output_prefix, fingerprint: of what it published, where it succeeded.
    """

    __tablename__ = "stage_runs"

    id: Mapped[int] = mapped_column(_BIG, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    stage: Mapped[str] = mapped_column(String(32))
    token: Mapped[int] = mapped_column(Integer)
    generation: Mapped[int] = mapped_column(Integer)
    attempt: Mapped[int] = mapped_column(Integer)
    owner: Mapped[str] = mapped_column(String(128))
    started_at: Mapped[datetime] = mapped_column(UtcDateTime)
    finished_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    outcome: Mapped[str | None] = mapped_column(String(16))
    led_to: Mapped[str | None] = mapped_column(String(16))
    checkpoints: Mapped[int] = mapped_column(Integer, default=0)
    error: Mapped[dict[str, Any] | None] = mapped_column(CleanJson(none_as_null=True))
    exit_code: Mapped[int | None] = mapped_column(Integer)
    peak_bytes: Mapped[int | None] = mapped_column(BigInteger)
    output_prefix: Mapped[str | None] = mapped_column(String(255))
    fingerprint: Mapped[str | None] = mapped_column(CleanText(64))

    __table_args__ = (Index(None, "job_id", "stage", "token", unique=True),)


class Event(Tenanted, Base):
    """What happened, in order: the feed of state changes, written in their transactions.

    actor: who changed it ("worker:ID", "api-key:ID", "service"). reason: why, in a word or an
    error's code; empty where the kind says it all.
    """

    __tablename__ = "events"

    seq: Mapped[int] = mapped_column(_BIG, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    stage: Mapped[str | None] = mapped_column(String(32))
    kind: Mapped[str] = mapped_column(String(48))
    actor: Mapped[str] = mapped_column(CleanText(160))
    reason: Mapped[str] = mapped_column(CleanText(100), default="")
    data: Mapped[dict[str, Any]] = mapped_column(CleanJson, default=dict)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)

    __table_args__ = (Index(None, "job_id", "seq"),)


class LogLine(Tenanted, Base):
    """One line that a stage wrote."""

    __tablename__ = "log_lines"

    id: Mapped[int] = mapped_column(_BIG, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    stage: Mapped[str] = mapped_column(String(32))
    attempt: Mapped[int] = mapped_column(Integer)
    text: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)

    __table_args__ = (Index(None, "job_id", "id"), Index(None, "job_id", "stage", "id"))


class Worker(Base):
    """A worker process and what it has. It is live while `seen_at` is fresh. It serves all tenants.

    boot: chance, made when the process starts; tells two that were given one id apart. contained:
    what holds its stages in, {"on": [...], "lacks": [...]}; None before its first stage process.
    """

    __tablename__ = "workers"

    id: Mapped[str] = mapped_column(String(128), primary_key=True)
    hostname: Mapped[str] = mapped_column(CleanText(255))
    pid: Mapped[int] = mapped_column(Integer)
    boot: Mapped[str] = mapped_column(String(16))
    queues: Mapped[list[str]] = mapped_column(CleanJson)
    slots: Mapped[int] = mapped_column(Integer, default=1)
    has_gpu: Mapped[bool] = mapped_column(Boolean, default=False)
    contained: Mapped[dict[str, list[str]] | None] = mapped_column(CleanJson(none_as_null=True))
    started_at: Mapped[datetime] = mapped_column(UtcDateTime)
    seen_at: Mapped[datetime] = mapped_column(UtcDateTime)


class ApiKey(Tenanted, Base):
    """A key of the API: only its SHA-256 is kept. What is made with it is its tenant's."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(ID_LENGTH), primary_key=True, default=new_id)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    name: Mapped[str] = mapped_column(CleanText(100))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)
    last_used_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    revoked_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


class PendingDeletion(Base):
    """Bytes whose record is gone: kept until the object store has dropped them too.

    Whose they were, the prefix says.
    """

    __tablename__ = "pending_deletions"

    id: Mapped[int] = mapped_column(_BIG, primary_key=True, autoincrement=True)
    prefix: Mapped[str] = mapped_column(String(255))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime)


class IdempotentCall(Base):
    """A call that creates something, under its caller's key (`storage.idempotency`).

    id: hash of caller (a key of the API, and so a tenant), call and key. fingerprint: of what was
    asked. token, held_until: who works on it, and until when. status, body, location: the answer,
    once there is one.
    """

    __tablename__ = "idempotent_calls"

    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    token: Mapped[str] = mapped_column(String(16))
    held_until: Mapped[datetime] = mapped_column(UtcDateTime)
    status: Mapped[int | None] = mapped_column(Integer)
    body: Mapped[str] = mapped_column(Text, default="")
    location: Mapped[str] = mapped_column(String(255), default="")
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, index=True)
