"""`/v1/workers`: who runs stages, and what holds those stages in."""

from __future__ import annotations

from datetime import datetime

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from api.deps import ServicesDep
from api.errors import responses
from storage import records

router = APIRouter(prefix="/v1", tags=["workers"])


class Contained(BaseModel):
    """What a stage may not do."""

    on: list[str] = Field(description="What holds: limits, Landlock, seccomp, and so on.")
    lacks: list[str] = Field(description="What that machine does not offer, and why.")


class WorkerView(BaseModel):
    """A worker that was seen within the last minute. It serves all tenants."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    queues: list[str]
    slots: int = Field(description="How many stages it runs at once.")
    has_gpu: bool
    started_at: datetime
    seen_at: datetime
    contained: Contained | None = Field(
        description="What holds its stages in; null until its first stage process has started."
    )


class WorkerList(BaseModel):
    """The workers that live."""

    items: list[WorkerView]


@router.get("/workers", responses=responses())
def list_workers(services: ServicesDep) -> WorkerList:
    """The workers that live, what they have, and how their stages are contained."""
    with services.database.read_scope() as session:
        found = records.live_workers(session)
    return WorkerList(items=[WorkerView.model_validate(row) for row in found])
