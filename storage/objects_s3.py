"""Objects in any S3 through boto3: multipart transfers, presigned downloads."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import boto3
from boto3.exceptions import Boto3Error
from boto3.s3.transfer import TransferConfig
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

from storage.download_names import content_disposition
from storage.errors import ObjectMissingError, ObjectStoreError, ObjectStoreFullError
from storage.keys import folder_of
from storage.objects import CHUNK_BYTES, ObjectEntry, ObjectStat, OnBytes, check_key, check_prefix
from storage.settings import StorageSettings

_TRANSFER = TransferConfig(
    multipart_threshold=16 << 20, multipart_chunksize=16 << 20, max_concurrency=4
)
CONNECT_S = 5.0
_MISSING = frozenset({"404", "NoSuchKey", "NotFound"})
_FULL = frozenset({"507", "InsufficientStorage", "QuotaExceeded", "XMinioStorageFull"})


@contextmanager
def _translated(key: str) -> Iterator[None]:
    try:
        yield
    except ClientError as error:
        code = error.response.get("Error", {}).get("Code", "")
        if code in _MISSING:
            raise ObjectMissingError(f"There is no object {key}.") from error
        if code in _FULL:
            raise ObjectStoreFullError(f"No room left for {key}.") from error
        raise ObjectStoreError(f"{key}: the object store refused ({code}).") from error
    except (BotoCoreError, Boto3Error) as error:
        raise ObjectStoreError(f"{key}: the object store did not answer.") from error


class S3ObjectStore:
    """Objects below a prefix of one bucket."""

    def __init__(self, settings: StorageSettings, *, bucket: str, prefix: str = "") -> None:
        self._bucket = bucket
        self._prefix = f"{prefix}/" if prefix else ""
        endpoint, silence_s = settings.s3_endpoint_url, settings.s3_timeout_s
        # urllib3 sends a body under the time for connecting: a store that pauses is no reason to
        # break a transfer off.
        self._client = _make_client(settings, endpoint, silence_s, 4, connect_s=silence_s)
        # Short calls, which people wait for: each answers or fails within seconds.
        self._quick = _make_client(settings, endpoint, silence_s / 4, 2)
        public = settings.s3_public_endpoint_url
        self._signer = _make_client(settings, public, silence_s, 1) if public else self._client

    def _full(self, key: str) -> str:
        return self._prefix + check_key(key)

    def put_file(
        self, key: str, path: Path, on_bytes: OnBytes | None = None, *, final: bool = False
    ) -> None:
        """Store a file's content under a key, replacing what was there."""
        del final
        with _translated(key):
            self._client.upload_file(
                str(path), self._bucket, self._full(key), Callback=on_bytes, Config=_TRANSFER
            )

    def copies_into(self, path: Path) -> None:
        """None: what is stored takes no room here."""
        del path

    def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
        """Write an object to a file, which appears whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{secrets.token_hex(6)}.tmp")
        try:
            with _translated(key):
                self._client.download_file(
                    self._bucket,
                    self._full(key),
                    str(temporary),
                    Callback=on_bytes,
                    Config=_TRANSFER,
                )
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def read(self, key: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """The object's bytes from `start`, at most `length`, in chunks."""
        if length == 0:
            return
        end = "" if length is None else str(start + length - 1)
        part = {} if start == 0 and length is None else {"Range": f"bytes={start}-{end}"}
        with _translated(key):
            answer = self._client.get_object(Bucket=self._bucket, Key=self._full(key), **part)
            with closing(answer["Body"]) as body:
                yield from body.iter_chunks(CHUNK_BYTES)

    def stat(self, key: str) -> ObjectStat:
        """Size and tag. Raises ObjectMissingError."""
        with _translated(key):
            answer = self._quick.head_object(Bucket=self._bucket, Key=self._full(key))
        return ObjectStat(answer["ContentLength"], answer["ETag"].strip('"'))

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""
        try:
            self.stat(key)
        except ObjectMissingError:
            return False
        return True

    def delete(self, key: str) -> None:
        """Remove an object; nothing happens where there is none."""
        with _translated(key):
            self._quick.delete_object(Bucket=self._bucket, Key=self._full(key))

    def delete_prefix(self, prefix: str) -> None:
        """Remove all objects whose keys start with `prefix`, which ends in "/"."""
        keys = [*self.list(prefix)]
        for first in range(0, len(keys), 500):
            batch = keys[first : first + 500]
            with _translated(prefix):
                answer = self._client.delete_objects(
                    Bucket=self._bucket,
                    Delete={"Objects": [{"Key": self._full(key)} for key in batch], "Quiet": True},
                )
            if answer.get("Errors"):
                raise ObjectStoreError(f"{prefix}: {len(answer['Errors'])} objects not deleted.")

    def list(self, prefix: str) -> Iterator[str]:
        """The keys that start with `prefix`, which ends in "/"."""
        return (entry.key for entry in self.list_entries(prefix))

    def list_entries(self, prefix: str) -> Iterator[ObjectEntry]:
        """The same with times; the objects of one folder come one after the other."""
        with _translated(prefix):
            pages = self._quick.get_paginator("list_objects_v2").paginate(
                Bucket=self._bucket, Prefix=self._prefix + check_prefix(prefix)
            )
            for page in pages:
                for item in page.get("Contents", []):
                    key = item["Key"].removeprefix(self._prefix)
                    yield ObjectEntry(key, item["LastModified"])

    def drop_unfinished(self, before: datetime) -> int:
        """Drop what transfers that were cut short before then left. Returns how many.

        Only where our own objects lie: the bucket may be shared, with an empty prefix, too.
        """
        dropped = 0
        with _translated("half-done uploads"):
            pages = self._quick.get_paginator("list_multipart_uploads").paginate(
                Bucket=self._bucket, Prefix=self._prefix
            )
            for page in pages:
                for item in page.get("Uploads", []):
                    is_ours = folder_of(item["Key"].removeprefix(self._prefix)) is not None
                    if is_ours and item["Initiated"] < before:
                        self._quick.abort_multipart_upload(
                            Bucket=self._bucket, Key=item["Key"], UploadId=item["UploadId"]
                        )
                        dropped += 1
        return dropped

    def signed_url(
        self, key: str, *, expires_s: int, filename: str, media_type: str, sha256: str = ""
    ) -> str:
        """A presigned GET of one object, whose ETag is the bucket's own."""
        del sha256
        with _translated(key):
            url: str = self._signer.generate_presigned_url(
                "get_object",
                Params={
                    "Bucket": self._bucket,
                    "Key": self._full(key),
                    "ResponseContentDisposition": content_disposition(filename),
                    "ResponseContentType": media_type,
                },
                ExpiresIn=expires_s,
            )
        return url

    def ping(self) -> None:
        """Raise ObjectStoreError where the bucket does not answer."""
        with _translated("the bucket"):
            try:
                self._quick.head_bucket(Bucket=self._bucket)
            except ClientError as error:
                raise ObjectStoreError(f"Bucket {self._bucket} cannot be used.") from error


def _region(settings: StorageSettings) -> str:
    """Where the bucket is: as said here; else, of Amazon's, as its own tools know it."""
    usual = None
    if not settings.s3_endpoint_url:
        usual = os.environ.get("AWS_REGION") or boto3.session.Session().region_name
    return settings.s3_region or usual or "us-east-1"


def _make_client(
    settings: StorageSettings,
    endpoint: str,
    silence_s: float,
    attempts: int,
    *,
    connect_s: float = CONNECT_S,
) -> Any:
    return boto3.client(
        "s3",
        endpoint_url=endpoint or None,
        region_name=_region(settings),
        aws_access_key_id=settings.s3_access_key_id.get_secret_value() or None,
        aws_secret_access_key=settings.s3_secret_access_key.get_secret_value() or None,
        config=Config(
            signature_version="s3v4",
            s3={"addressing_style": "path" if settings.s3_path_style else "auto"},
            connect_timeout=min(connect_s, silence_s),
            read_timeout=silence_s,
            tcp_keepalive=True,
            max_pool_connections=20,
            retries={"total_max_attempts": attempts, "mode": "standard"},
            request_checksum_calculation="when_required",
            response_checksum_validation="when_required",
        ),
    )
