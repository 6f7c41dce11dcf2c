"""Whose rows a session sees: all, or those of one tenant.

Workers and housekeeping serve all tenants. A session of `Database.of_tenant` serves one: its tenant
is added to every statement, to reads, changes and deletions alike, in joins, subqueries and what
relationships load, so that no query can forget it. What it adds to the database must be its own.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import String, event
from sqlalchemy.orm import (
    Mapped,
    ORMExecuteState,
    Session,
    mapped_column,
    sessionmaker,
    with_loader_criteria,
)

TENANT_LENGTH = 28
DEFAULT_TENANT = "default"
"""Whose everything is, for now: rows and object keys say it, so that there can be more than one."""
OF_ALL: dict[str, Any] = {"of_all_tenants": True}
"""Execution options of a statement that counts what is not this tenant's, too."""
_TENANT = "tenant"


class Tenanted:
    """Rows that belong to somebody."""

    tenant_id: Mapped[str] = mapped_column(String(TENANT_LENGTH))


def keep_to(session: Session, tenant_id: str) -> None:
    """From now on this session is that tenant's; nothing was loaded in it before."""
    session.info[_TENANT] = tenant_id


def watch(sessions: sessionmaker[Session]) -> None:
    """Have the sessions that this makes keep to their tenants."""
    event.listen(sessions, "do_orm_execute", _narrow)
    event.listen(sessions, "before_flush", _check_new)


def _narrow(state: ORMExecuteState) -> None:
    tenant_id = state.session.info.get(_TENANT)
    if tenant_id is None or state.execution_options.get(*OF_ALL):
        return
    if state.is_select or state.is_update or state.is_delete:
        mine = with_loader_criteria(
            Tenanted, lambda model: model.tenant_id == tenant_id, include_aliases=True
        )
        state.statement = state.statement.options(mine)


def _check_new(session: Session, *_: Any) -> None:
    tenant_id = session.info.get(_TENANT)
    if tenant_id is None:
        return
    for row in session.new:
        if isinstance(row, Tenanted) and row.tenant_id != tenant_id:
            raise ValueError(f"a session of tenant {tenant_id} adds a row of {row.tenant_id}")
