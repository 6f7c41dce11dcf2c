"""Uploaded bytes, kept once however often a tenant sends them.

A blob counts the captures that are made of it, in the transactions that make and delete them: bytes
go when the last of their captures has gone, and never before. `captures.blob_id` is a foreign key,
so that the database itself keeps a row that a capture still needs.

    find_blob -> a hint: these bytes are here, nothing needs to be put
    take_blob   one capture more; made where there is none, of bytes that lie in the store already
    drop_blob   one less; with the last one the bytes are put up for deletion (`storage.deletions`)

A key is never used a second time (`storage.keys`): the deletion of bytes that went meets no others
that came since. Of two that bring the same bytes at once one finds the other's blob, and deletes
what it brought itself. Callers commit.
"""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import delete, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from storage.db import now
from storage.errors import BlobMissingError
from storage.keys import folder_of
from storage.models import Blob, PendingDeletion, new_id


def find_blob(session: Session, tenant_id: str, sha256: str) -> Blob | None:
    """The blob of these bytes. It may be gone when the caller comes to take it."""
    return session.scalar(select(Blob).where(Blob.tenant_id == tenant_id, Blob.sha256 == sha256))


def take_blob(
    session: Session,
    tenant_id: str,
    sha256: str,
    brought: str | None,
    when: datetime | None = None,
) -> tuple[str, str]:
    """One reference more to these bytes: the blob's id, and the key under which they lie.

    brought: the key under which the caller has put them; None where it relies on a blob that it
    found, and then raises BlobMissingError where that has gone. Other takers of the same bytes wait
    until this transaction ends.
    """
    if brought is None:
        mine = (Blob.tenant_id == tenant_id, Blob.sha256 == sha256)
        statement = update(Blob).where(*mine).values(refs=Blob.refs + 1)
        taken = session.execute(
            statement.returning(Blob.id, Blob.object_key),
            execution_options={"synchronize_session": False},
        ).one_or_none()
        if taken is None:
            raise BlobMissingError("The bytes were deleted meanwhile; they are needed again.")
        return taken[0], taken[1]
    is_postgresql = session.get_bind().dialect.name == "postgresql"
    insert = (postgresql if is_postgresql else sqlite).insert(Blob)
    found = session.execute(
        insert.values(
            id=new_id(),
            tenant_id=tenant_id,
            sha256=sha256,
            object_key=brought,
            refs=1,
            created_at=when or now(session),
        )
        .on_conflict_do_update(
            index_elements=[Blob.tenant_id, Blob.sha256], set_={"refs": Blob.refs + 1}
        )
        .returning(Blob.id, Blob.object_key)
    ).one()
    return found[0], found[1]


def drop_blob(session: Session, blob_id: str, when: datetime) -> None:
    """One reference less; the caller's record names the blob no more, and that is flushed."""
    left, key = session.execute(
        update(Blob)
        .where(Blob.id == blob_id)
        .values(refs=Blob.refs - 1)
        .returning(Blob.refs, Blob.object_key),
        execution_options={"synchronize_session": False},
    ).one()
    if left == 0:
        session.execute(delete(Blob).where(Blob.id == blob_id))
        session.add(PendingDeletion(prefix=folder_of(key), created_at=when))
