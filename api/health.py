"""`/livez` and `/readyz`: whether the process runs, and whether what it needs answers."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Response
from pydantic import BaseModel

from api.deps import SharedServicesDep
from api.errors import responses
from api.problems import UnavailableError

router = APIRouter(tags=["health"])


class Liveness(BaseModel):
    """The process answers."""

    status: str = "ok"


class Readiness(BaseModel):
    """Everything that the API needs answers."""

    status: str = "ok"
    checks: dict[str, str]


@router.get("/livez")
async def get_liveness(response: Response) -> Liveness:
    """Whether the process answers; asks nothing of others, and waits for no thread."""
    response.headers["Cache-Control"] = "no-store"
    return Liveness()


@router.get("/readyz", responses=responses("not_ready"))
async def get_readiness(services: SharedServicesDep, response: Response) -> Readiness:
    """Whether database, broker and object store answer, each within its time."""
    response.headers["Cache-Control"] = "no-store"
    timeout_s = services.settings.check_timeout_s
    found = await asyncio.gather(*(probe.ask(timeout_s) for probe in services.probes))
    wrong = [problem for problem in found if problem is not None]
    if wrong:
        names = ", ".join(problem.path for problem in wrong)
        error = UnavailableError(f"Not ready: {names}.", code="not_ready")
        error.errors = wrong
        raise error
    return Readiness(checks=dict.fromkeys((probe.name for probe in services.probes), "ok"))
