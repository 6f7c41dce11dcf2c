"""The report of a failed stage gets a place of its own: the stage keeps its last success.

Revision: 0007, after 0006, of 2026-11-29.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
MOVE_REPORTS = {
    "postgresql": "UPDATE stages SET report_prefix = output_prefix, "
    "report_files = manifest -> 'files', output_prefix = NULL, manifest = NULL "
    "WHERE state = 'failed' AND output_prefix IS NOT NULL",
    "sqlite": "UPDATE stages SET report_prefix = output_prefix, "
    "report_files = json_extract(manifest, '$.files'), output_prefix = NULL, manifest = NULL "
    "WHERE state = 'failed' AND output_prefix IS NOT NULL",
}
FORGET = (
    "UPDATE stages SET output_prefix = NULL, manifest = NULL, fingerprint = NULL, summary = NULL "
    "WHERE state <> 'succeeded'"
)
MOVE_BACK = {
    "postgresql": "UPDATE stages SET output_prefix = report_prefix, "
    "manifest = jsonb_build_object('files', report_files) "
    "WHERE state = 'failed' AND report_prefix IS NOT NULL",
    "sqlite": "UPDATE stages SET output_prefix = report_prefix, "
    "manifest = json_object('files', json(report_files)) "
    "WHERE state = 'failed' AND report_prefix IS NOT NULL",
}


def upgrade() -> None:
    """Apply."""
    op.add_column("stages", sa.Column("report_prefix", sa.String(255), nullable=True))
    op.add_column("stages", sa.Column("report_files", JSON, nullable=True))
    op.execute(sa.text(MOVE_REPORTS[op.get_bind().dialect.name]))


def downgrade() -> None:
    """Undo. What a stage that is not `succeeded` had made before is given up, and swept."""
    op.execute(sa.text(FORGET))
    op.execute(sa.text(MOVE_BACK[op.get_bind().dialect.name]))
    op.drop_column("stages", "report_files")
    op.drop_column("stages", "report_prefix")
