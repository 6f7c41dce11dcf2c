"""What holds a worker's stages in; lists of captures and jobs are looked up by their tenant.

Revision: 0006, after 0005, of 2026-11-22.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
LISTED = ("captures", "jobs")


def upgrade() -> None:
    """Apply."""
    op.add_column("workers", sa.Column("contained", JSON, nullable=True))
    for table in LISTED:
        op.drop_index(op.f(f"ix_{table}_created_at_id"), table)
        op.create_index(
            op.f(f"ix_{table}_tenant_id_created_at_id"), table, ["tenant_id", "created_at", "id"]
        )


def downgrade() -> None:
    """Undo."""
    for table in LISTED:
        op.drop_index(op.f(f"ix_{table}_tenant_id_created_at_id"), table)
        op.create_index(op.f(f"ix_{table}_created_at_id"), table, ["created_at", "id"])
    op.drop_column("workers", "contained")
