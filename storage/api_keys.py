"""The API's keys, of which the database holds the SHA-256 alone."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Collection
from datetime import datetime, timedelta

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from storage.db import first_and_now, now
from storage.errors import NotFoundError
from storage.models import ApiKey
from storage.new_keys import new_api_key
from storage.tenants import DEFAULT_TENANT

BOOTSTRAP = "bootstrap"
"""Name of the keys that came from the service's settings, of which one is valid."""
_LOCK = 0x6E65726B  # any number of our own: one start at a time on PostgreSQL
USED_GRAIN = timedelta(minutes=1)  # last_used_at moves no oftener: a read should rarely write

_log = logging.getLogger("nerfworks.storage")


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode("utf-8", "replace")).hexdigest()


def create_api_key(
    session: Session, name: str, tenant_id: str = DEFAULT_TENANT
) -> tuple[ApiKey, str]:
    """Make a key. The second value is the key itself, which cannot be shown again."""
    key = new_api_key()
    return ensure_api_key(session, key, name, tenant_id), key


def ensure_api_key(
    session: Session, key: str, name: str, tenant_id: str = DEFAULT_TENANT
) -> ApiKey:
    """The record of a key that was made elsewhere, made where there is none."""
    found = session.scalar(select(ApiKey).where(ApiKey.sha256 == _digest(key)))
    if found is None:
        found = ApiKey(tenant_id=tenant_id, sha256=_digest(key), name=name, created_at=now(session))
        session.add(found)
        session.flush()
    return found


def take_bootstrap_key(session: Session, key: str) -> ApiKey:
    """Make the key of the settings valid in place of those that were so before.

    A key that was replaced, or revoked, never becomes valid again: processes that still have it in
    their settings change nothing, in whatever order they start. The record says whether it was
    (`revoked_at`). Of several that are valid, as earlier versions left them, that of the settings
    holds. What was made with the others is their tenant's, and so the new one's.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(select(func.pg_advisory_xact_lock(_LOCK)))
    order = (ApiKey.created_at, ApiKey.id)
    earlier = session.scalars(select(ApiKey).where(ApiKey.name == BOOTSTRAP).order_by(*order)).all()
    valid = [record for record in earlier if record.revoked_at is None]
    tenant_id = earlier[-1].tenant_id if earlier else DEFAULT_TENANT
    found = ensure_api_key(session, key, BOOTSTRAP, tenant_id)
    if found.revoked_at is not None:
        return found
    found.name = BOOTSTRAP
    for record in valid:
        if record is not found:
            record.revoked_at = now(session)
            _log.warning("the API key %s of earlier settings is revoked", record.id)
    return found


def list_api_keys(session: Session) -> list[ApiKey]:
    """All keys, the oldest first, with those that were revoked."""
    return [*session.scalars(select(ApiKey).order_by(ApiKey.created_at, ApiKey.id))]


def find_api_key(session: Session, key: str) -> tuple[ApiKey, datetime] | None:
    """The record of a key that is valid, and the time; None for one that is unknown or revoked."""
    query = select(ApiKey).where(ApiKey.sha256 == _digest(key), ApiKey.revoked_at.is_(None))
    return first_and_now(session, query)


def is_use_due(record: ApiKey, when: datetime) -> bool:
    """Whether `touch_api_keys` is worth a write."""
    return record.last_used_at is None or when - record.last_used_at > USED_GRAIN


def touch_api_keys(session: Session, key_ids: Collection[str]) -> None:
    """Note that keys were used. One that another transaction changes is passed over."""
    free = (
        select(ApiKey.id)
        .where(ApiKey.id.in_(key_ids))
        .with_for_update(skip_locked=True, key_share=True)
    )
    used = update(ApiKey).where(ApiKey.id.in_(free))
    session.execute(used.values(last_used_at=now(session)))


def revoke_api_key(session: Session, key_id: str) -> ApiKey:
    """Make a key invalid, for good. Raises NotFoundError."""
    record = session.get(ApiKey, key_id)
    if record is None:
        raise NotFoundError("API key", key_id)
    record.revoked_at = record.revoked_at or now(session)
    return record
