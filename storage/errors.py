"""What the storage room refuses or cannot do.

The API turns `NotFoundError` into 404, `ConflictError` into 409 and `InvalidCursorError` into 422;
the worker turns the object store's errors into retryable failures of a stage, or gives the stage
back where the store is away.
"""

from __future__ import annotations


class StorageError(Exception):
    """The root of this room's errors."""


class NotFoundError(StorageError):
    """There is no such record. `what`: "job", "capture", ...; `key`: the id that was asked for."""

    def __init__(self, what: str, key: str) -> None:
        super().__init__(f"There is no {what} {key}.")
        self.what = what
        self.key = key


class ConflictError(StorageError):
    """The record's state does not allow the operation."""


class IdempotencyRunningError(StorageError):
    """A call with the same key is at work."""


class IdempotencyReusedError(StorageError):
    """A key was used for another request before."""


class InvalidCursorError(StorageError):
    """A page cursor that this service did not hand out."""


class LostLeaseError(StorageError):
    """A write carried a fencing token that is no longer the stage's: throw the work away."""


class BlobMissingError(StorageError):
    """Uploaded bytes that were here were deleted meanwhile: put them once more."""


class ObjectMissingError(StorageError):
    """No object has this key."""


class ObjectStoreError(StorageError):
    """The object store did not answer, or refused. Trying again can help."""


class ObjectStoreFullError(ObjectStoreError):
    """The object store, or the disk under it, has no room left."""


class InvalidUrlError(StorageError):
    """A signed URL that is forged, or has expired."""
