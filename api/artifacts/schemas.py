"""What the API says about artifacts."""

from __future__ import annotations

from pydantic import BaseModel, Field


class ArtifactView(BaseModel):
    """A file that a job offers for download."""

    name: str
    media_type: str
    bytes: int
    sha256: str
    url: str = Field(description="Signed, needs no key, good for a short while.")
    opens_with: str = Field(description="Programs that open it.")


class ArtifactList(BaseModel):
    """The artifacts of a job."""

    items: list[ArtifactView]
