"""What the API takes and says about exports."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from api.ids import JsonObject, Labels
from pipelines.exports.catalogue import KINDS

ExportKind = StrEnum("ExportKind", {kind: kind for kind in KINDS})  # type: ignore[misc]


class ExportRequest(BaseModel):
    """What to make of a job's results."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"kind": "mesh", "options": {"formats": ["glb", "usdz"], "triangles": 50_000}},
                {"kind": "video", "options": {"path": "orbit", "seconds": 8}},
            ]
        },
    )

    kind: ExportKind
    options: JsonObject = Field(
        default_factory=dict,
        description="{option: value}, laid over those that the job itself has for this kind.",
    )
    labels: Labels = Field(default_factory=dict, description="Free text to find the export by.")


class ArtifactKind(BaseModel):
    """A file that an export may write."""

    name: str
    media_type: str
    opens_with: str
    on_request: bool = Field(description="Whether it is there only where options ask for it.")


class ExportKindView(BaseModel):
    """A kind of export."""

    kind: str
    summary: str
    version: int = Field(description="Rises when the same options give another result.")
    on_request: bool = Field(
        description="Whether jobs make it only where they have options for it."
    )
    artifacts: list[ArtifactKind]
    options: dict[str, Any] = Field(description="JSON Schema: defaults, units, ranges, meaning.")


class ExportKindList(BaseModel):
    """All kinds of export."""

    items: list[ExportKindView]
