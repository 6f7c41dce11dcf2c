"""The API's settings, from the environment with the prefix NERFWORKS_."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, SecretStr, field_validator
from pydantic_settings import NoDecode, SettingsConfigDict

from storage.settings import StorageSettings

_ORIGIN = re.compile(r"https?://([a-z0-9.-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?")


class ApiSettings(StorageSettings):
    """What the API needs besides the settings of the records, the broker and the objects."""

    model_config = SettingsConfigDict(env_prefix="NERFWORKS_", extra="ignore", frozen=True)

    host: str = Field("127.0.0.1", description="Address to listen on.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 for a free one.")
    max_upload_bytes: int = Field(
        20 * 2**30, ge=1, description="Largest capture that is taken, in bytes."
    )
    max_uploads: int = Field(
        64, ge=1, le=1000, description="Uploads that are taken in side by side; more are a 503."
    )
    min_upload_bytes_per_s: int = Field(
        8192, ge=0, description="An upload that is slower for a minute is given up; 0 for no limit."
    )
    small_body_s: float = Field(
        30.0, gt=0, description="Longest that the body of any other call may take, in seconds."
    )
    min_free_bytes: int = Field(
        2**30, ge=0, description="Bytes that an upload must leave free on disk."
    )
    max_body_bytes: int = Field(
        2**20, ge=2**10, description="Largest body of any other call, in bytes."
    )
    url_expires_s: int = Field(
        900, ge=60, le=604_800, description="How long a signed download URL is good, in seconds."
    )
    cors_origins: Annotated[tuple[str, ...], NoDecode] = Field(
        (),
        description="Origins, separated by commas, whose web pages may call the API with a key, as "
        "https://app.example.org; none for only downloads at signed URLs, which all pages may.",
    )
    check_timeout_s: float = Field(
        3.0, gt=0, le=60, description="How long /readyz waits for each part, in seconds."
    )
    bootstrap_api_key: SecretStr = Field(
        SecretStr(""),
        description="A key that is made valid at the start, in place of the last; empty for none.",
    )
    bootstrap_api_key_file: Path | None = Field(
        None, description="A file that holds such a key (a mounted secret)."
    )

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _split(cls, origins: Any) -> Any:
        if isinstance(origins, str):
            return tuple(part.strip() for part in origins.split(",") if part.strip())
        return origins

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            if not _ORIGIN.fullmatch(origin):
                raise ValueError(
                    f"{origin!r} is no origin: write each as browsers send it, such as "
                    "https://app.example.org or http://localhost:5173, without a path; * and null "
                    "are everybody, who must not call the API"
                )
        return origins

    @property
    def staging_dir(self) -> Path:
        """Where uploads are written while they come in."""
        return self.home.resolve() / "staging"

    def bootstrap_key(self) -> str:
        """The key to make valid at the start, or "". Raises OSError for a file that is missing."""
        if self.bootstrap_api_key_file is not None:
            return self.bootstrap_api_key_file.read_text("utf-8").strip()
        return self.bootstrap_api_key.get_secret_value()
