"""Queue keys and resource classes, the history of claims, who did what and why.

A claim that was running is entered into `stage_runs`, so that its worker can still end it. How
often stages crashed before is not kept: their counts start anew.

Revision: 0002, after 0001, of 2026-11-22.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

JSON = sa.JSON(none_as_null=True).with_variant(postgresql.JSONB(none_as_null=True), "postgresql")
TIME = sa.DateTime(timezone=True)
COUNTER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
ROWS_AT_ONCE = 1000


def _fill_queue_keys() -> None:
    """As `storage.jobs.queue_key` makes them: time of the job in ms, its id, the stage's place."""
    connection = op.get_bind()
    found = connection.execute(
        sa.text(
            "SELECT stages.id, stages.job_id, stages.seq, jobs.created_at "
            "FROM stages JOIN jobs ON jobs.id = stages.job_id"
        ).columns(
            sa.column("id", sa.String),
            sa.column("job_id", sa.String),
            sa.column("seq", sa.Integer),
            sa.column("created_at", TIME),
        )
    ).all()

    def key(row: Any) -> str:
        moment: datetime = row.created_at
        aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        return f"{int(aware.timestamp() * 1000):012x}{row.job_id}{row.seq:04d}"

    values = [{"key": key(row), "id": row.id} for row in found]
    statement = sa.text("UPDATE stages SET queue_key = :key WHERE id = :id")
    for first in range(0, len(values), ROWS_AT_ONCE):
        connection.execute(statement, values[first : first + ROWS_AT_ONCE])


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "stage_runs",
        sa.Column("id", COUNTER, autoincrement=True, nullable=False),
        sa.Column("job_id", sa.String(length=28), nullable=False),
        sa.Column("stage", sa.String(length=32), nullable=False),
        sa.Column("token", sa.Integer(), nullable=False),
        sa.Column("generation", sa.Integer(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("owner", sa.String(length=128), nullable=False),
        sa.Column("started_at", TIME, nullable=False),
        sa.Column("finished_at", TIME, nullable=True),
        sa.Column("outcome", sa.String(length=16), nullable=True),
        sa.Column("led_to", sa.String(length=16), nullable=True),
        sa.Column("checkpoints", sa.Integer(), nullable=False),
        sa.Column("error", JSON, nullable=True),
        sa.Column("exit_code", sa.Integer(), nullable=True),
        sa.Column("peak_bytes", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_stage_runs_job_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_stage_runs")),
    )
    op.create_index(
        op.f("ix_stage_runs_job_id_stage_token"),
        "stage_runs",
        ["job_id", "stage", "token"],
        unique=True,
    )

    op.add_column("jobs", sa.Column("generation", sa.Integer(), nullable=False, server_default="1"))
    op.drop_index(op.f("ix_jobs_state_created_at"), "jobs")
    op.create_index(
        op.f("ix_jobs_state_created_at_id"), "jobs", ["state", "created_at", "id"], unique=False
    )
    op.add_column("events", sa.Column("actor", sa.String(160), nullable=False, server_default=""))
    op.add_column("events", sa.Column("reason", sa.String(100), nullable=False, server_default=""))
    op.add_column("workers", sa.Column("boot", sa.String(16), nullable=False, server_default=""))

    op.add_column(
        "stages", sa.Column("queue_key", sa.String(48), nullable=False, server_default="")
    )
    op.add_column(
        "stages", sa.Column("resource", sa.String(8), nullable=False, server_default="cpu")
    )
    op.add_column("stages", sa.Column("progress_at", TIME, nullable=True))
    op.execute(sa.text("UPDATE stages SET resource = 'gpu' WHERE needs_gpu"))
    op.execute(sa.text("UPDATE stages SET progress_at = heartbeat_at"))
    _fill_queue_keys()
    op.execute(
        sa.text(
            "INSERT INTO stage_runs (job_id, stage, token, generation, attempt, owner, started_at, "
            "checkpoints) SELECT job_id, name, lease_token, 1, attempt, "
            "COALESCE(lease_owner, ''), COALESCE(started_at, heartbeat_at, ready_at), 0 "
            "FROM stages WHERE state = 'running'"
        )
    )
    op.drop_column("stages", "needs_gpu")
    op.drop_column("stages", "crashes")
    op.create_index(
        op.f("ix_stages_state_resource_queue_key"),
        "stages",
        ["state", "resource", "queue_key"],
        unique=False,
    )


def downgrade() -> None:
    """Undo."""
    op.drop_index(op.f("ix_stages_state_resource_queue_key"), "stages")
    op.add_column(
        "stages", sa.Column("needs_gpu", sa.Boolean(), nullable=False, server_default=sa.false())
    )
    op.add_column("stages", sa.Column("crashes", sa.Integer(), nullable=False, server_default="0"))
    op.execute(sa.text("UPDATE stages SET needs_gpu = (resource = 'gpu')"))
    for column in ("progress_at", "resource", "queue_key"):
        op.drop_column("stages", column)
    op.drop_column("workers", "boot")
    op.drop_column("events", "reason")
    op.drop_column("events", "actor")
    op.drop_index(op.f("ix_jobs_state_created_at_id"), "jobs")
    op.create_index(op.f("ix_jobs_state_created_at"), "jobs", ["state", "created_at"], unique=False)
    op.drop_column("jobs", "generation")
    op.drop_table("stage_runs")
