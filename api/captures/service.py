"""Captures: from a received file to a record, and away again."""

from __future__ import annotations

from api.captures.receiving import Received
from api.deps import DELETE_WAIT_S, Services
from pipelines.captures.sniff import sniff
from storage import records
from storage.keys import capture_content, capture_prefix
from storage.models import Capture, new_id


def keep(services: Services, received: Received) -> Capture:
    """Look at a received file, store its bytes, then record it.

    The record comes last, so that there is never one without bytes; bytes whose record could not
    be written are taken away again. Raises CaptureError for a file that is of no use.
    """
    sniffed = sniff(received.path, received.filename)
    capture_id = new_id()
    key = capture_content(capture_id)
    try:
        services.store.put_file(key, received.path)
        with services.database.session_scope() as session:
            return records.create_capture(
                session,
                capture_id=capture_id,
                filename=received.filename,
                kind=sniffed.kind,
                num_bytes=received.bytes,
                sha256=received.sha256,
                object_key=key,
                details=sniffed.details,
            )
    except BaseException:
        services.store.delete_prefix(capture_prefix(capture_id))
        raise


def delete(services: Services, capture_id: str) -> None:
    """Delete a capture, its bytes too. Raises ConflictError while a job runs on it."""
    with services.database.session_scope() as session:
        records.delete_capture(session, capture_id)
    services.drainer.drain(DELETE_WAIT_S)
