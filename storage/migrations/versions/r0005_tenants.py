"""Tenants, uploaded bytes that are counted, fingerprints, what each generation was asked for.

All that there is belongs to the one tenant that there was. Bytes stay where they lie, and records
go on naming them: each capture's get a row of `blobs`, which later uploads of the same share; where
the same bytes lie twice already, the second stay their own capture's alone.

There is no way back: older code can neither delete nor sweep what lies under the new keys.

Revision: 0005, after 0004, of 2026-11-22.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
TIME = sa.DateTime(timezone=True)
TENANT = "default"
OWNED = ("captures", "jobs", "stages", "stage_runs", "events", "log_lines", "api_keys")


def _tell_whose() -> None:
    """The default fills what is there; new rows always say it themselves."""
    for table in OWNED:
        column = sa.Column("tenant_id", sa.String(28), nullable=False, server_default=TENANT)
        op.add_column(table, column)
        if op.get_bind().dialect.name == "postgresql":  # SQLite would have to copy the table
            op.alter_column(table, "tenant_id", server_default=None)


def _count_bytes() -> None:
    op.create_table(
        "blobs",
        sa.Column("id", sa.String(length=28), nullable=False),
        sa.Column("tenant_id", sa.String(length=28), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("object_key", sa.String(length=255), nullable=False),
        sa.Column("refs", sa.Integer(), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_blobs")),
    )
    op.create_index(
        op.f("ix_blobs_tenant_id_sha256"), "blobs", ["tenant_id", "sha256"], unique=True
    )
    op.create_index(op.f("ix_blobs_object_key"), "blobs", ["object_key"], unique=True)
    # Spelt out: SQLite takes a foreign key with its column only, and alembic makes two steps of it.
    op.execute(
        sa.text(
            "ALTER TABLE captures ADD COLUMN blob_id VARCHAR(28) "
            "CONSTRAINT fk_captures_blob_id REFERENCES blobs (id)"
        )
    )
    op.create_index(op.f("ix_captures_blob_id"), "captures", ["blob_id"], unique=False)
    # A blob bears the id of the capture that brought it.
    op.execute(
        sa.text(
            "INSERT INTO blobs (id, tenant_id, sha256, object_key, refs, created_at) "
            "SELECT id, tenant_id, CASE WHEN EXISTS (SELECT 1 FROM captures AS earlier "
            "WHERE earlier.sha256 = captures.sha256 AND earlier.deleted_at IS NULL "
            "AND earlier.id < captures.id) THEN NULL ELSE sha256 END, object_key, 1, created_at "
            "FROM captures WHERE deleted_at IS NULL"
        )
    )
    op.execute(sa.text("UPDATE captures SET blob_id = id WHERE deleted_at IS NULL"))


FINGERPRINT = {
    "postgresql": "UPDATE stages SET fingerprint = SUBSTR(manifest ->> 'fingerprint', 1, 64) "
    "WHERE state = 'succeeded'",
    "sqlite": "UPDATE stages SET fingerprint = SUBSTR(json_extract(manifest, '$.fingerprint'), "
    "1, 64) WHERE state = 'succeeded'",
}
RESULTS = (  # of the claims whose results the stages hold
    "UPDATE stage_runs SET (fingerprint, output_prefix) = (SELECT stages.fingerprint, "
    "stages.output_prefix FROM stages WHERE stages.job_id = stage_runs.job_id "
    "AND stages.name = stage_runs.stage AND stages.lease_token = stage_runs.token) "
    "WHERE outcome = 'succeeded'"
)


def _note_fingerprints() -> None:
    for table in ("stages", "stage_runs"):
        op.add_column(table, sa.Column("fingerprint", sa.String(64), nullable=True))
    op.add_column("stage_runs", sa.Column("output_prefix", sa.String(255), nullable=True))
    op.execute(sa.text(FINGERPRINT[op.get_bind().dialect.name]))
    op.execute(sa.text(RESULTS))


def _keep_generations() -> None:
    """Of a job that was retried only the present one: what earlier ones were asked is not known."""
    op.create_table(
        "job_generations",
        sa.Column("job_id", sa.String(length=28), nullable=False),
        sa.Column("generation", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("tenant_id", sa.String(length=28), nullable=False),
        sa.Column("options", JSON, nullable=False),
        sa.Column("from_stage", sa.String(length=32), nullable=True),
        sa.Column("created_at", TIME, nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_job_generations_job_id")),
        sa.PrimaryKeyConstraint("job_id", "generation", name=op.f("pk_job_generations")),
    )
    op.execute(
        sa.text(
            "INSERT INTO job_generations (job_id, generation, tenant_id, options, created_at) "
            "SELECT id, generation, tenant_id, options, COALESCE((SELECT MAX(events.created_at) "
            "FROM events WHERE events.job_id = jobs.id AND events.kind = 'job.queued'), "
            "created_at) FROM jobs"
        )
    )


def upgrade() -> None:
    """Apply."""
    _tell_whose()
    _count_bytes()
    op.add_column(
        "jobs", sa.Column("object_root", sa.String(255), nullable=False, server_default="")
    )
    op.execute(sa.text("UPDATE jobs SET object_root = 'jobs/' || id || '/'"))
    _note_fingerprints()
    _keep_generations()


def downgrade() -> None:
    """Refuse."""
    raise NotImplementedError("older code cannot read the new keys: restore the backup instead")
