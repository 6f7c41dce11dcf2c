"""Every `code` of an error, its status, and what of it any call may answer.

A test compares this list with the codes that the sources hold; endpoints name theirs through
`api.errors.responses`, so that OpenAPI has them as literals.
"""

from __future__ import annotations

BODY = ("bad_request", "request_timeout", "too_large")
"""Of a call with a JSON body."""
ONCE = ("idempotency_key_running", "idempotency_key_reused")
"""Of a call that takes an Idempotency-Key."""
COMMON = (
    *("unauthorized", "request_invalid", "internal_error", "database_unavailable", "disk_full"),
)
"""Of every call."""
UPLOAD = (
    *("file_missing", "file_repeated", "multipart_malformed", "unsupported_type", "too_large"),
    *("upload_stalled", "upload_truncated", "uploads_busy", "object_store_unavailable"),
)
"""Of an upload, as a transfer."""
CAPTURE = (
    *("capture_unusable", "empty_file", "unknown_type", "no_images", "archive_unsafe"),
    *("archive_bomb", "archive_encrypted", "archive_damaged", "poses_missing", "poses_malformed"),
)
"""Of an upload, as a capture."""
BYTES = ("object_not_found", "range_unsatisfiable", "object_store_unavailable")
"""Of a download."""

RETRY = (
    *("job_not_found", "capture_deleted", "conflict", "nothing_to_retry", "stage_skipped"),
    *("options_invalid", "not_trained"),
)
"""Of a call that runs a job again."""

CODES: dict[str, int] = {
    "bad_request": 400,
    "unauthorized": 401,
    "url_invalid": 403,
    "not_found": 404,
    "job_not_found": 404,
    "capture_deleted": 404,
    "capture_not_found": 404,
    "artifact_not_found": 404,
    "object_not_found": 404,
    "method_not_allowed": 405,
    "request_timeout": 408,
    "upload_stalled": 408,
    "conflict": 409,
    "job_finished": 409,
    "nothing_to_retry": 409,
    "not_trained": 409,
    "idempotency_key_running": 409,
    "archive_bomb": 413,
    "too_large": 413,
    "unknown_type": 415,
    "unsupported_type": 415,
    "range_unsatisfiable": 416,
    "archive_damaged": 422,
    "archive_encrypted": 422,
    "archive_unsafe": 422,
    "capture_unusable": 422,
    "cursor_invalid": 422,
    "empty_file": 422,
    "file_missing": 422,
    "file_repeated": 422,
    "idempotency_key_reused": 422,
    "multipart_malformed": 422,
    "no_images": 422,
    "options_invalid": 422,
    "poses_malformed": 422,
    "poses_missing": 422,
    "preset_unknown": 422,
    "request_invalid": 422,
    "stage_skipped": 422,
    "upload_truncated": 422,
    "internal_error": 500,
    "database_unavailable": 503,
    "not_ready": 503,
    "object_store_unavailable": 503,
    "unavailable": 503,
    "uploads_busy": 503,
    "disk_full": 507,
}
