"""Captures: from a received file to a record, and away again."""

from __future__ import annotations

from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session
from starlette.responses import Response

from api.captures.receiving import Received
from api.captures.schemas import CaptureView
from api.deps import DELETE_WAIT_S, Services
from api.idempotency import Once, do_once
from pipelines.captures.sniff import sniff
from storage import records
from storage.keys import capture_content, capture_prefix
from storage.models import new_id
from storage.steps import reached


def keep(services: Services, received: Received, once: Once) -> Response:
    """Look at a received file, store its bytes, then record it, once. Returns the answer.

    The record comes last, so that there is never one without bytes. Bytes that no record speaks of
    are taken away again; where it is not known whether there is one, because the database did not
    say, they stay for the sweep (`storage.reconciling`). Raises CaptureError for a file that is of
    no use.
    """
    sniffed = sniff(received.path, received.filename)
    capture_id = new_id()
    key = capture_content(capture_id)

    def make(session: Session) -> tuple[CaptureView, str]:
        capture = records.create_capture(
            session,
            capture_id=capture_id,
            filename=received.filename,
            kind=sniffed.kind,
            num_bytes=received.bytes,
            sha256=received.sha256,
            object_key=key,
            details=sniffed.details,
        )
        return CaptureView.of(capture), f"/v1/captures/{capture_id}"

    try:
        services.store.put_file(key, received.path)
        reached("capture.put")
        done = do_once(services, once, 201, make)
    except DBAPIError:
        raise
    except BaseException:
        services.store.delete_prefix(capture_prefix(capture_id))
        raise
    if done.is_replayed:
        services.store.delete_prefix(capture_prefix(capture_id))
    return done.response


def delete(services: Services, capture_id: str) -> None:
    """Delete a capture, its bytes too. Raises ConflictError while a job runs on it."""
    with services.database.session_scope(step="delete") as session:
        records.delete_capture(session, capture_id)
    services.drainer.drain(DELETE_WAIT_S)
