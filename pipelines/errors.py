"""The tree of errors that a stage may raise.

Every error says what failed, on what, and what to do. `code` is stable and machine readable; the
API shows `code`, `message` and `hint` unchanged, so neither may hold a path of this machine.
`retryable` is true where the same input may succeed on another try (a full disk, a lost worker).
"""

from __future__ import annotations

from typing import Any


class PipelineError(Exception):
    """A failure that a person can act on.

    code: stable identifier, snake_case.
    message: what failed and on what, one sentence.
    hint: what to do about it, one sentence.
    retryable: whether trying the same input again can help.
    details: small JSON-able facts (counts, limits, names).
    """

    code = "pipeline_error"
    hint = "See the job's logs for the step that failed."
    retryable = False

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        hint: str | None = None,
        retryable: bool | None = None,
        details: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code or type(self).code
        self.hint = hint or type(self).hint
        self.retryable = type(self).retryable if retryable is None else retryable
        self.details = details or {}

    def as_dict(self) -> dict[str, Any]:
        """The error as plain JSON: what crosses a process boundary and reaches the API."""
        return {
            "code": self.code,
            "message": self.message,
            "hint": self.hint,
            "retryable": self.retryable,
            "details": self.details,
        }


class CaptureError(PipelineError):
    """The input cannot be used as it is. The upload is refused, or the job fails, with its code.

    Codes in use: empty_file, unknown_type, too_large, archive_unsafe, archive_bomb,
    archive_damaged, archive_encrypted, no_images, video_truncated, video_undecodable,
    no_video_stream, video_too_long, projection_unsupported, image_undecodable, too_few_images,
    poses_missing, poses_malformed, capture_missing.
    """

    code = "capture_unusable"
    hint = "Send a video, a .zip of photos, or a .zip exported by a supported app."


class PosesError(PipelineError):
    """Structure from motion did not give a usable camera path.

    Codes in use: too_few_registered, no_parallax, no_features.
    """

    code = "poses_failed"
    hint = "Film slower, with more overlap, moving around the subject instead of turning in place."


class TrainingError(PipelineError):
    """Training cannot go on. Codes in use: non_finite_loss, too_few_images, out_of_memory,
    depth_maps_outdated, no_sensor_depth."""

    code = "training_failed"


class ExportError(PipelineError):
    """The trained model, or the depth maps, give no asset. Codes in use: empty_mesh,
    empty_pointcloud, export.empty (a crop that holds no surface), geometry_poor, no_focus."""

    code = "export_failed"


class ToolError(PipelineError):
    """A program or library that a stage calls failed; `details["log"]` holds its last lines.

    Codes in use: tool_failed, tool_missing, tool_timeout.
    """

    code = "tool_failed"


class ResourceError(PipelineError):
    """The machine ran out of something. Codes in use: disk_full, out_of_memory,
    and where a bound of the worker was reached file_too_large, too_many_files,
    too_many_processes."""

    code = "resources_exhausted"
    retryable = True


class Cancelled(PipelineError):
    """The job was cancelled; raised by `StageContext.check_cancelled`."""

    code = "cancelled"
    hint = "Submit the job again to run it."
