"""What the API says about captures."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, Field

from pipelines.captures.catalogue import KINDS
from storage.models import Capture


class CaptureView(BaseModel):
    """An uploaded capture."""

    id: str
    filename: str = Field(description="As the client called it, without folders.")
    kind: str = Field(description=f"What the bytes are: {', '.join(KINDS)}.")
    bytes: int
    sha256: str = Field(description="Of the bytes as they came, in hex.")
    details: dict[str, Any] = Field(description="Facts found while looking at the bytes.")
    created_at: datetime

    @classmethod
    def of(cls, capture: Capture) -> CaptureView:
        """The view of a record."""
        return cls.model_validate(capture, from_attributes=True)


class CapturePage(BaseModel):
    """A page of captures, newest first."""

    items: list[CaptureView]
    next_cursor: str | None = Field(description="Give it as `cursor` for the next page.")
