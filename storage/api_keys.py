"""The API's keys, of which the database holds the SHA-256 alone."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from datetime import datetime, timedelta

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from storage.db import first_and_now, now
from storage.errors import NotFoundError
from storage.models import ApiKey
from storage.new_keys import new_api_key
from storage.tenants import DEFAULT_TENANT

USED_GRAIN = timedelta(minutes=1)  # last_used_at moves no oftener: a read should rarely write


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


def revoke_api_key(session: Session, key_id: str) -> None:
    """Make a key invalid. Raises NotFoundError."""
    record = session.get(ApiKey, key_id)
    if record is None:
        raise NotFoundError("API key", key_id)
    record.revoked_at = record.revoked_at or now(session)
