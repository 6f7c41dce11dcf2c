"""Where records, messages and bytes live: typed settings from the environment, prefix NERFWORKS_.

Without any setting everything is embedded below `home`. The S3 keys come from NERFWORKS_S3_* or,
where these are not set, from the usual AWS environment, files and instance roles through boto3.
"""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict

from storage.db import STATEMENT_S

KEY_FILE = "signing.key"


class StorageSettings(BaseSettings):
    """Settings of the records, the broker and the object store.

    Properties without "_url" in the environment resolve to the embedded defaults.
    """

    model_config = SettingsConfigDict(env_prefix="NERFWORKS_", extra="ignore", frozen=True)

    home: Path = Field(Path(".nerfworks"), description="Folder of all embedded state.")
    database_url: str = Field("", description="SQLAlchemy URL; empty for SQLite below home.")
    database_timeout_s: float = Field(
        STATEMENT_S, gt=0, description="Longest that PostgreSQL may take over one statement."
    )
    redis_url: str = Field("redis://127.0.0.1:6379/0", description="Broker of the bell.")
    objects_url: str = Field("", description="file:///folder or s3://bucket/prefix.")
    s3_endpoint_url: str = Field("", description="S3 endpoint; empty for AWS.")
    s3_public_endpoint_url: str = Field(
        "", description="S3 endpoint as clients reach it, for presigned URLs; empty for the same."
    )
    s3_region: str = Field(
        "", description="S3 region; empty for AWS's own settings, us-east-1 without or elsewhere."
    )
    s3_access_key_id: SecretStr = Field(SecretStr(""), description="Empty for the AWS defaults.")
    s3_secret_access_key: SecretStr = Field(SecretStr(""), description="Goes with the key id.")
    s3_timeout_s: float = Field(
        30.0, gt=0, description="Longest that S3 may be silent in a transfer; short calls get 1/4."
    )
    s3_path_style: bool = Field(True, description="Path-style S3 addresses (most own servers).")
    secret_key: SecretStr = Field(
        SecretStr(""), description="Signs local URLs; empty for a key kept below home."
    )
    public_url: str = Field(
        "http://127.0.0.1:8000", description="The API's address as clients reach it."
    )

    @property
    def resolved_database_url(self) -> str:
        """`database_url`, or SQLite below `home`."""
        if self.database_url:
            return self.database_url
        return f"sqlite:///{self.home.resolve() / 'nerfworks.db'}"

    @property
    def resolved_objects_url(self) -> str:
        """`objects_url`, or a folder below `home`."""
        return self.objects_url or (self.home.resolve() / "objects").as_uri()

    @property
    def work_dir(self) -> Path:
        """The folder of the workers' job folders."""
        return self.home.resolve() / "work"

    def signing_key(self) -> bytes:
        """The key of local signed URLs; made once below `home`, readable by its owner alone."""
        given = self.secret_key.get_secret_value()
        if given:
            return given.encode()
        path = self.home / KEY_FILE
        self.home.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
        try:
            if not path.exists():
                descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                with os.fdopen(descriptor, "w") as file:
                    file.write(secrets.token_urlsafe(32))
                os.link(temporary, path)  # fails where another process was first
        except FileExistsError:
            pass
        finally:
            temporary.unlink(missing_ok=True)
        return path.read_bytes().strip()
