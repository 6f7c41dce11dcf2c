"""Exports: jobs that read another job's results.

Revision: 0004, after 0003, of 2026-11-22.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

INDEX = "ix_jobs_parent_id_created_at_id"
KEY = "fk_jobs_parent_id"


def upgrade() -> None:
    """Apply."""
    # In SQL, as SQLite takes it too: alembic would make the table anew there, which others name.
    column = f"parent_id VARCHAR(28) CONSTRAINT {KEY} REFERENCES jobs(id)"
    op.execute(sa.text(f"ALTER TABLE jobs ADD COLUMN {column}"))
    op.create_index(op.f(INDEX), "jobs", ["parent_id", "created_at", "id"], unique=False)


def downgrade() -> None:
    """Undo. Exports go: the earlier revision would take them for jobs."""
    jobs = sa.table("jobs", sa.column("id"), sa.column("parent_id"))
    is_export = jobs.c.parent_id.is_not(None)
    for name in ("stages", "stage_runs", "events", "log_lines"):
        theirs = sa.table(name, sa.column("job_id"))
        exports = sa.select(jobs.c.id).where(is_export)
        op.execute(sa.delete(theirs).where(theirs.c.job_id.in_(exports)))
    op.execute(sa.delete(jobs).where(is_export))
    op.drop_index(op.f(INDEX), "jobs")
    op.drop_column("jobs", "parent_id")
