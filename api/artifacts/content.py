"""Bytes of the object store as an HTTP answer: whole, in part, or not at all."""

from __future__ import annotations

from fastapi import Request
from starlette.responses import Response, StreamingResponse

from api.artifacts.ranges import etag_of, parse_range, tag_listed
from api.deps import Services
from storage.download_names import content_disposition


def content_response(
    request: Request,
    services: Services,
    *,
    key: str,
    size: int,
    tag: str,
    filename: str,
    media_type: str,
) -> Response:
    """Answer a GET or HEAD of an object.

    size: bytes of the object. tag: changes with its content. Raises BadRangeError,
    ObjectMissingError.
    """
    etag = etag_of(tag)
    headers = {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "Content-Type": media_type,  # as it is: starlette would add a charset to text
        "Content-Disposition": content_disposition(filename),
        "Content-Security-Policy": "sandbox; default-src 'none'",
    }
    known = request.headers.get("if-none-match")
    if known is not None and tag_listed(known, etag):
        return Response(status_code=304, headers=headers)
    with services.asking_the_store():
        services.store.stat(key)  # bytes that are gone must be a 404, not an answer that breaks off
    part = parse_range(
        request.headers.get("range") if request.method == "GET" else None,
        size,
        request.headers.get("if-range"),
        etag,
    )
    status = 200
    if part is not None:
        status = 206
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    start, length = (0, size) if part is None else (part.start, len(part))
    headers["Content-Length"] = str(length)
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers)
    return StreamingResponse(
        services.store.read(key, start, length),
        status_code=status,
        headers=headers,
    )
