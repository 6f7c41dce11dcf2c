"""The one error of this package. It imports nothing, so that every file here may raise it."""

from __future__ import annotations


class NerfError(Exception):
    """A failure that a person can act on.

    code: stable identifier, snake_case. Codes in use: bad_config, bad_cameras, bad_image,
        bad_rays, bad_plugin, too_few_images, too_much_memory, non_finite_loss, bad_checkpoint,
        bad_model_file, lpips_weights, gpu_failed, gpu_lost.
    message: what failed and on what, one sentence without paths of this machine.
    hint: what to do about it, one sentence.
    retryable: whether the same input may succeed in a new process.
    """

    def __init__(self, code: str, message: str, hint: str = "", *, retryable: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.hint = hint
        self.retryable = retryable

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".strip()
