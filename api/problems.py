"""The errors that the API answers with, as plain exceptions: no framework, no handlers.

Each becomes one RFC 9457 problem document in `api.errors`. `code` is stable, `detail` says what
failed and on what, `hint` what to do. None of them may hold a path of this machine.

    ApiError
      UnauthorizedError 401      ForbiddenError 403        MissingError 404
      ConflictedError 409        TooLargeError 413         UnsupportedTypeError 415
      BadRangeError 416          InvalidRequestError 422   UnavailableError 503
      NoSpaceError 507
"""

from __future__ import annotations

from pydantic import BaseModel, Field


class FieldProblem(BaseModel):
    """One wrong value. `path` is dotted: `train.max_steps`, `body.capture_id`."""

    path: str
    detail: str


class Problem(BaseModel):
    """RFC 9457 problem document; the media type is application/problem+json."""

    type: str = Field(description="Stable URI of the kind of problem.")
    title: str = Field(description="The status in words.")
    status: int
    detail: str = Field(description="What failed, and on what.")
    instance: str = Field(description="The path that was asked for.")
    code: str = Field(description="Stable, machine-readable.")
    hint: str = Field(description="What to do about it.")
    errors: list[FieldProblem] = Field(default_factory=list, description="Each wrong value.")


class ApiError(Exception):
    """An answer with a 4xx or 5xx status.

    code: stable identifier. hint: what to do. errors: each wrong value, where there are several.
    headers: added to the answer.
    """

    status = 500
    code = "internal_error"
    hint = "Try again; if it goes on, tell whoever runs the service the X-Request-Id."

    def __init__(
        self,
        detail: str,
        *,
        code: str | None = None,
        hint: str | None = None,
        status: int | None = None,
        errors: list[FieldProblem] | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.code = code or type(self).code
        self.hint = hint or type(self).hint
        self.status = status or type(self).status
        self.errors = errors or []
        self.headers = headers or {}


class UnauthorizedError(ApiError):
    """No key, or one that is unknown or revoked."""

    status = 401
    code = "unauthorized"
    hint = "Send the header 'Authorization: Bearer KEY' with a key of this service."

    def __init__(self, detail: str) -> None:
        super().__init__(detail, headers={"WWW-Authenticate": 'Bearer realm="nerfworks"'})


class ForbiddenError(ApiError):
    """A signed URL that is forged or has expired."""

    status = 403
    code = "url_invalid"
    hint = "Ask for the artifact again: it comes with a fresh URL."


class MissingError(ApiError):
    """There is no such thing."""

    status = 404
    code = "not_found"
    hint = "Check the address; /docs lists every call."


class ConflictedError(ApiError):
    """The state of the thing does not allow it."""

    status = 409
    code = "conflict"
    hint = "Look at its state first."


class TooLargeError(ApiError):
    """More bytes than the service takes."""

    status = 413
    code = "too_large"
    hint = "Send a shorter video or fewer photos, or have the limit raised."


class UnsupportedTypeError(ApiError):
    """A body of a type that this call does not take."""

    status = 415
    code = "unsupported_type"
    hint = "Send multipart/form-data with one part named 'file'."


class BadRangeError(ApiError):
    """A Range that lies outside the content."""

    status = 416
    code = "range_unsatisfiable"
    hint = "Ask for bytes within the size that Content-Range states."


class InvalidRequestError(ApiError):
    """A request that is understood and wrong."""

    status = 422
    code = "request_invalid"
    hint = "Mend what 'errors' names; /docs describes the call."


class UnavailableError(ApiError):
    """Something that the API needs does not answer."""

    status = 503
    code = "unavailable"
    hint = "Try again in a few seconds."

    def __init__(self, detail: str, *, code: str | None = None) -> None:
        super().__init__(detail, code=code, headers={"Retry-After": "2"})


class NoSpaceError(ApiError):
    """The service has no room for the bytes."""

    status = 507
    code = "disk_full"
    hint = "Delete old jobs and captures, or have the disk enlarged; then send it again."
