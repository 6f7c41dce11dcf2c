"""The object store that the settings name: a local folder, or a bucket of any S3."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlparse

from storage.objects import ObjectStore
from storage.objects_local import LocalObjectStore
from storage.settings import StorageSettings


def open_object_store(settings: StorageSettings) -> ObjectStore:
    """The store that the settings name. Raises ValueError for an unknown kind of URL."""
    url = urlparse(settings.resolved_objects_url)
    if url.scheme == "file":
        return LocalObjectStore(
            Path(unquote(url.path)),
            public_url=settings.public_url,
            signing_key=settings.signing_key(),
        )
    if url.scheme == "s3" and url.netloc:
        # Imported here: boto3 takes a while, and only S3 wants it.
        from storage.objects_s3 import S3ObjectStore

        return S3ObjectStore(settings, bucket=url.netloc, prefix=url.path.strip("/"))
    raise ValueError("NERFWORKS_OBJECTS_URL must be file:///folder or s3://bucket/prefix")
