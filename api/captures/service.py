"""Captures: from a received file to a record, and away again."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session
from starlette.responses import Response

from api.captures.receiving import Limits, Received
from api.captures.schemas import CaptureView
from api.deps import DELETE_WAIT_S, Services
from api.idempotency import Done, Once, do_once
from pipelines.captures.sniff import Sniffed, sniff
from storage import records
from storage.blobs import find_blob
from storage.damage import is_found_damaged
from storage.errors import BlobMissingError, ObjectMissingError, ObjectStoreError, StorageError
from storage.keys import blob_content
from storage.models import new_id
from storage.steps import reached


def limits(services: Services, staging: Path) -> Limits:
    """What an upload to this staging file may take."""
    copied_into = None
    with contextlib.suppress(StorageError):  # it will be told when the upload is stored
        copied_into = services.store.copies_into(staging)
    settings = services.settings
    return Limits(settings.max_upload_bytes, settings.min_free_bytes, copied_into)


def keep(services: Services, received: Received, once: Once) -> Response:
    """Look at a received file, store its bytes, then record it, once. Returns the answer.

    Bytes that are here already are not stored again (`storage.blobs`), unless the store has lost
    or damaged them. Raises CaptureError for a file that is of no use.
    """
    sniffed = sniff(received.path, received.filename)
    tenant_id = once.caller.tenant_id
    with services.database.read_scope() as session:
        found = find_blob(session, tenant_id, received.sha256)
        is_damaged = found is not None and is_found_damaged(session, found.id)
    upload = _Upload(services, received, sniffed, tenant_id, once)
    if found is not None:
        with contextlib.suppress(BlobMissingError):  # it went since: these are needed after all
            if is_damaged or not _lies_there(services, found.object_key, received.bytes):
                services.store.put_file(found.object_key, received.path, final=True)
            return upload.record(brought=None)[0].response
    return _store_and_record(upload)


def _lies_there(services: Services, key: str, num_bytes: int) -> bool:
    """Whether the object is there, as long as it must be."""
    try:
        return services.store.stat(key).bytes == num_bytes
    except ObjectMissingError:
        return False


@dataclass(frozen=True)
class _Upload:
    """What is to be recorded, and by whom."""

    services: Services
    received: Received
    sniffed: Sniffed
    tenant_id: str
    once: Once

    def record(self, brought: str | None) -> tuple[Done, str | None]:
        """Make the record. The answer, and the key that it names; None where it was made before."""
        key: str | None = None

        def make(session: Session) -> tuple[CaptureView, str]:
            nonlocal key
            capture = records.create_capture(
                session,
                capture_id=new_id(),
                filename=self.received.filename,
                kind=self.sniffed.kind,
                num_bytes=self.received.bytes,
                sha256=self.received.sha256,
                brought=brought,
                details=self.sniffed.details,
                tenant_id=self.tenant_id,
            )
            key = capture.object_key
            return CaptureView.of(capture), f"/v1/captures/{capture.id}"

        return do_once(self.services, self.once, 201, make), key


def _store_and_record(upload: _Upload) -> Response:
    """The record comes last, so that there is never one without bytes.

    Bytes that no record speaks of are taken away again; where it is not known whether there is one,
    because the database did not say, they stay for the sweep (`storage.reconciling`).
    """
    store = upload.services.store
    key = blob_content(upload.tenant_id, upload.received.sha256, new_id())
    folder = key.removesuffix("content")
    try:
        path = upload.received.path
        store.put_file(key, path, lambda count: reached("capture.bytes"), final=True)
        reached("capture.put")
        done, named = upload.record(brought=key)
    except DBAPIError:
        raise
    except BaseException:
        store.delete_prefix(folder)
        raise
    if named != key:  # made before, or others brought the same meanwhile
        with contextlib.suppress(ObjectStoreError):  # the sweep will find it
            store.delete_prefix(folder)
    return done.response


def delete(services: Services, capture_id: str) -> None:
    """Delete a capture, its bytes too. Raises ConflictError while a job runs on it."""
    with services.database.session_scope(step="delete") as session:
        records.delete_capture(session, capture_id)
    services.drainer.drain(DELETE_WAIT_S)
