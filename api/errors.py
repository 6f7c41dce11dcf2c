"""Every failure as RFC 9457 `application/problem+json`: the only file that maps errors to HTTP.

Own errors of the other rooms, validation, framework errors (404, 405) and surprises all get the
same shape. Tracebacks go to the log with the request id, never into an answer.
"""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import re
import secrets
import time
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import DataError, DBAPIError, SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.codes import CODES, COMMON
from api.methods import HeadOfGet, allowed_methods
from api.problems import (
    ApiError,
    ConflictedError,
    FieldProblem,
    ForbiddenError,
    InvalidRequestError,
    MissingError,
    NoSpaceError,
    Problem,
    UnavailableError,
)
from pipelines.errors import CaptureError, PipelineError, ResourceError
from pipelines.options import OptionsError
from storage.db import is_away, is_full
from storage.errors import (
    ConflictError,
    IdempotencyReusedError,
    IdempotencyRunningError,
    InvalidCursorError,
    InvalidUrlError,
    NotFoundError,
    ObjectMissingError,
    ObjectStoreError,
    ObjectStoreFullError,
    StorageError,
)

logger = logging.getLogger("nerfworks.api")

access = logging.getLogger("nerfworks.access")

MAX_FIELD_PROBLEMS = 50
MAX_LISTED = 5
PROBLEM_TYPE = "application/problem+json"
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_QUIET_PATHS = frozenset({"/livez", "/readyz"})
_SECRET_PATH = re.compile(r"(/v1/objects/).*", re.DOTALL)
_CAPTURE_STATUS = {"too_large": 413, "archive_bomb": 413, "unknown_type": 415}
_FRAMEWORK_CODES = {
    408: "request_timeout",
    404: "not_found",
    405: "method_not_allowed",
    413: "too_large",
}
_FRAMEWORK_HINTS = {
    408: "Send the request again, faster.",
    404: "Check the address; /docs lists every call.",
    405: "Use one of the methods that the Allow header names.",
    413: "Send less: only an upload to /v1/captures may be large.",
}


def responses(*which: int | str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's `responses` for these errors, and for those that any call may give.

    which: codes (`api.codes`), or a status alone. `api.app` adds the schema `Problem` that they
    refer to.
    """
    codes = [code for code in (*COMMON, *which) if isinstance(code, str)]
    statuses = {one for one in which if isinstance(one, int)} | {CODES[code] for code in codes}
    return {status: _documented(status, codes) for status in sorted(statuses)}


def _documented(status: int, codes: list[str]) -> dict[str, Any]:
    schema: dict[str, Any] = {"$ref": "#/components/schemas/Problem"}
    mine = sorted({code for code in codes if CODES[code] == status})
    phrase = HTTPStatus(status).phrase
    if mine:
        schema = {"allOf": [schema, {"properties": {"code": {"enum": mine}}}]}
        phrase = f"{phrase}: {', '.join(mine)}"
    return {"content": {PROBLEM_TYPE: {"schema": schema}}, "description": phrase}


class _ProblemResponse(JSONResponse):
    """JSON of what a caller may have sent, so of text that is no Unicode, too."""

    def render(self, content: Any) -> bytes:
        """The bytes."""
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
        return text.encode("utf-8", "replace")


def problem_response(request_path: str, error: ApiError) -> JSONResponse:
    """The answer for an error."""
    problem = Problem(
        type=f"urn:nerfworks:problem:{error.code}",
        title=HTTPStatus(error.status).phrase,
        status=error.status,
        detail=error.detail,
        instance=request_path,
        code=error.code,
        hint=error.hint,
        errors=error.errors[:MAX_FIELD_PROBLEMS],
    )
    return _ProblemResponse(
        problem.model_dump(),
        status_code=error.status,
        headers={**error.headers, "Cache-Control": "no-store"},
        media_type=PROBLEM_TYPE,
    )


def _of_pipeline(error: PipelineError) -> ApiError:
    status = 422
    if isinstance(error, CaptureError):
        status = _CAPTURE_STATUS.get(error.code, 422)
    elif isinstance(error, ResourceError):
        status = 507 if error.code == "disk_full" else 503
    return ApiError(error.message, code=error.code, hint=error.hint, status=status)


def _listed(problems: list[FieldProblem]) -> str:
    """The first few in one sentence; `errors` of the answer has more."""
    shown = "; ".join(f"{problem.path}: {problem.detail}" for problem in problems[:MAX_LISTED])
    more = len(problems) - MAX_LISTED
    return f"{shown}; and {more} more" if more > 0 else shown


def _of_options(error: OptionsError) -> ApiError:
    problems = [FieldProblem(path=path, detail=detail) for path, detail in error.errors]
    return InvalidRequestError(
        f"The options are not valid: {_listed(problems)}.",
        code="options_invalid",
        hint="GET /v1/options lists every option with its range and meaning.",
        errors=problems,
    )


def _of_validation(error: RequestValidationError) -> ApiError:
    problems = [
        FieldProblem(path=".".join(str(part) for part in item["loc"]), detail=str(item["msg"]))
        for item in error.errors()
    ]
    return InvalidRequestError(f"The request is not valid: {_listed(problems)}.", errors=problems)


def _of_framework(error: HTTPException) -> ApiError:
    hint = _FRAMEWORK_HINTS.get(error.status_code, "Check the request; /docs describes the calls.")
    code = _FRAMEWORK_CODES.get(error.status_code)
    return ApiError(
        f"{error.detail}." if code is None else HTTPStatus(error.status_code).description + ".",
        code=code or HTTPStatus(error.status_code).name.lower(),
        hint=hint,
        status=error.status_code,
        headers={name: text for name, text in (error.headers or {}).items() if name != "Allow"},
    )


def _of_storage(error: StorageError) -> ApiError:
    if isinstance(error, NotFoundError):
        return MissingError(
            str(error), code=f"{error.what}_not_found", hint="Check the id; it may be deleted."
        )
    if isinstance(error, ConflictError):
        return ConflictedError(str(error))
    if isinstance(error, IdempotencyRunningError):
        return ConflictedError(
            "A request with this Idempotency-Key is at work.",
            code="idempotency_key_running",
            hint="Send it again in a second: it is answered once.",
            headers={"Retry-After": "1"},
        )
    if isinstance(error, IdempotencyReusedError):
        return InvalidRequestError(
            "This Idempotency-Key was used for another request.",
            code="idempotency_key_reused",
            hint="Take a new key for each thing that you want made.",
        )
    if isinstance(error, InvalidCursorError):
        return InvalidRequestError(
            "The cursor is not one of this service.",
            code="cursor_invalid",
            hint="Use next_cursor of the page before, or leave the cursor out.",
        )
    if isinstance(error, InvalidUrlError):
        return ForbiddenError("The signed URL is not valid or has expired.")
    if isinstance(error, ObjectMissingError):
        return MissingError("These bytes are no longer there.", code="object_not_found")
    if isinstance(error, ObjectStoreFullError):
        return NoSpaceError("The object store has no room left.")
    if isinstance(error, ObjectStoreError):
        return UnavailableError(
            "The object store does not answer.", code="object_store_unavailable"
        )
    return ApiError("The service failed on this request.")


def to_api_error(error: Exception) -> ApiError:
    """What an exception means to a client. Whatever is unknown is an `internal_error`."""
    if isinstance(error, ApiError):
        return error
    if isinstance(error, PipelineError):
        return _of_pipeline(error)
    if isinstance(error, OptionsError):
        return _of_options(error)
    if isinstance(error, RequestValidationError):
        return _of_validation(error)
    if isinstance(error, HTTPException):
        return _of_framework(error)
    if isinstance(error, StorageError):
        return _of_storage(error)
    if isinstance(error, DBAPIError) and is_full(error):
        return NoSpaceError("The database has no room left.")
    if isinstance(error, SQLAlchemyError) and is_away(error):
        return UnavailableError("The database does not answer.", code="database_unavailable")
    if isinstance(error, DataError | UnicodeEncodeError):
        return InvalidRequestError("The request holds text or a number that cannot be stored.")
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return NoSpaceError("The service's disk is full.")
    return ApiError("The service failed on this request.")


async def _handle(request: Request, error: Exception) -> Response:
    answer = to_api_error(error)
    if answer.status == 405:
        answer.headers["Allow"] = ", ".join(
            allowed_methods(request.app.state.known_routes, request.scope)
        )
    if answer.status >= 500:
        logger.error("%s %r: %s", request.method, request.url.path, answer.code, exc_info=error)
    return problem_response(request.url.path, answer)


class RequestGuard:
    """Outermost layer: gives each request an id, and turns a surprise into a problem document.

    A well-formed X-Request-Id of the client is kept, so that logs on both sides meet.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI entry."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = dict(scope["headers"]).get(b"x-request-id", b"").decode("latin-1")
        request_id = given if _REQUEST_ID.fullmatch(given) else secrets.token_hex(8)
        started = False
        status = 0
        began = time.monotonic()

        async def send_with_id(message: Message) -> None:
            nonlocal started, status
            if message["type"] == "http.response.start":
                started = True
                status = message["status"]
                message["headers"] = [
                    *message.get("headers", []),
                    (b"x-request-id", request_id.encode()),
                    (b"x-content-type-options", b"nosniff"),
                ]
            await send(message)

        try:
            await self.app(scope, receive, send_with_id)
        except Exception as error:
            if started:
                raise
            logger.exception("request %s: %s %r", request_id, scope["method"], scope["path"])
            answer = problem_response(scope["path"], to_api_error(error))
            await answer(scope, receive, send_with_id)
        finally:
            if scope["path"] not in _QUIET_PATHS:
                seconds = time.monotonic() - began
                path = _SECRET_PATH.sub(r"\1...", scope["path"])
                access.info("%s %s %r %d %.3f", request_id, scope["method"], path, status, seconds)


class BodyLimit:
    """Refuses bodies that are too large, or too slow, for what is no upload."""

    def __init__(self, app: ASGIApp, max_bytes: int, max_s: float, upload_path: str) -> None:
        self.app = app
        self.max_s = max_s
        self.max_bytes = max_bytes
        self.upload_path = upload_path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI entry."""
        if scope["type"] != "http" or scope["path"] == self.upload_path:
            await self.app(scope, receive, send)
            return
        taken, is_whole = 0, False
        give_up_at: float | None = None

        async def receive_bounded() -> Message:
            nonlocal taken, is_whole, give_up_at
            if give_up_at is None:
                give_up_at = asyncio.get_running_loop().time() + self.max_s
            try:  # what comes after the body is the end of the connection, which may be far off
                async with asyncio.timeout_at(None if is_whole else give_up_at):
                    message = await receive()
            except TimeoutError as error:
                raise HTTPException(408) from error
            is_whole = not message.get("more_body", False)
            taken += len(message.get("body", b""))
            if taken > self.max_bytes:
                raise HTTPException(413)
            return message

        await self.app(scope, receive_bounded, send)


def install(
    app: FastAPI,
    *,
    max_body_bytes: int,
    max_body_s: float,
    upload_path: str,
    routes: list[BaseRoute],
) -> None:
    """Register the handlers and the guards. routes: all that the application answers."""
    handler: Callable[[Request, Any], Awaitable[Response]] = _handle
    for kind in (
        ApiError,
        PipelineError,
        OptionsError,
        RequestValidationError,
        HTTPException,
        StorageError,
        SQLAlchemyError,
        UnicodeEncodeError,
        OSError,
    ):
        app.add_exception_handler(kind, handler)
    app.state.known_routes = routes
    app.add_middleware(HeadOfGet, routes=routes)
    app.add_middleware(
        BodyLimit, max_bytes=max_body_bytes, max_s=max_body_s, upload_path=upload_path
    )
    app.add_middleware(RequestGuard)
