"""`/v1/presets` and `/v1/options`: what can be asked for; and the page at `/`."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Union

from fastapi import APIRouter
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field, create_model

from api.deps import ServicesDep
from api.errors import responses
from api.jobs.service import default_preset
from pipelines.options import (
    STAGE_OPTIONS,
    method_names,
    resolve_options,
    train_options,
)
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES

router = APIRouter(prefix="/v1", tags=["catalogue"])
page_router = APIRouter(include_in_schema=False)

_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>nerfworks</title>
<style>body{font:16px/1.5 sans-serif;margin:3rem auto;max-width:40rem;padding:0 1rem}</style>
<h1>nerfworks</h1>
<p>Send a phone capture over HTTP; get back a mesh, a point cloud and a video.</p>
<ul>
<li><a href="/docs">Documentation</a>, <a href="/openapi.json">OpenAPI</a></li>
<li><a href="/livez">/livez</a>, <a href="/readyz">/readyz</a></li>
</ul>
<pre>curl -H "Authorization: Bearer KEY" -F file=@walk.mp4 URL/v1/captures
curl -H "Authorization: Bearer KEY" --json '{"capture_id": "..."}' URL/v1/jobs</pre>
</html>
"""


class PresetView(BaseModel):
    """A complete, named set of options."""

    name: str
    summary: str
    options: dict[str, Any] = Field(description="The options of every stage.")
    without: list[str] = Field(
        description="Stages that its jobs skip; a capture may have no use for others."
    )


class PresetList(BaseModel):
    """The presets, and which one a job gets that names none."""

    items: list[PresetView]
    default: str
    default_reason: str


@cache
def preset_views() -> tuple[PresetView, ...]:
    """All presets with their options resolved."""
    return tuple(
        PresetView(
            name=name,
            summary=preset.summary,
            options=resolve_options(name, {}),
            without=[stage for stage in STAGE_NAMES if stage in preset.without],
        )
        for name, preset in PRESETS.items()
    )


@cache
def options_schema() -> dict[str, Any]:
    """One JSON Schema of `options` in `POST /v1/jobs`: defaults, ranges and meanings."""
    fields: dict[str, Any] = {
        stage: (model, Field(default_factory=model, description=(model.__doc__ or "").strip()))
        for stage, model in STAGE_OPTIONS.items()
    }
    of_any_method: Any = Union[tuple(train_options(name) for name in method_names())]  # noqa: UP007
    fields["train"] = (
        Annotated[of_any_method, Field(discriminator="method")],
        Field(default_factory=STAGE_OPTIONS["train"], description=STAGE_OPTIONS["train"].__doc__),
    )
    whole = create_model("Options", __config__=ConfigDict(extra="forbid"), **fields)
    schema = whole.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    for stage in STAGE_OPTIONS:
        schema["properties"][stage]["default"] = STAGE_OPTIONS[stage]().model_dump(mode="json")
    return schema


@router.get("/presets", responses=responses())
def list_presets(services: ServicesDep) -> PresetList:
    """The presets with their complete options."""
    with services.database.read_scope() as session:
        name, reason = default_preset(session)
    return PresetList(items=list(preset_views()), default=name, default_reason=reason)


@router.get("/options", responses=responses())
def get_options_schema() -> dict[str, Any]:
    """JSON Schema of all options: defaults, units, ranges, meaning."""
    return options_schema()


@page_router.get("/", response_class=HTMLResponse)
def get_page() -> str:
    """Where to go from here."""
    return _PAGE
