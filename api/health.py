"""`/livez` and `/readyz`: whether the process runs, and whether what it needs answers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from fastapi import APIRouter, Response
from kombu.exceptions import KombuError
from pydantic import BaseModel
from redis.exceptions import RedisError
from sqlalchemy.exc import SQLAlchemyError

from api.deps import ServicesDep
from api.errors import responses
from api.problems import FieldProblem, UnavailableError
from storage.errors import StorageError

logger = logging.getLogger("nerfworks.api")
router = APIRouter(tags=["health"])


class Liveness(BaseModel):
    """The process answers."""

    status: str = "ok"


class Readiness(BaseModel):
    """Everything that the API needs answers."""

    status: str = "ok"
    checks: dict[str, str]


@router.get("/livez")
def get_liveness(response: Response) -> Liveness:
    """Whether the process answers; asks nothing of others."""
    response.headers["Cache-Control"] = "no-store"
    return Liveness()


async def _check(name: str, ping: Callable[[], None], timeout_s: float) -> FieldProblem | None:
    """What is wrong with one part, or None."""
    try:
        await asyncio.wait_for(asyncio.to_thread(ping), timeout_s)
    except TimeoutError:
        return FieldProblem(path=name, detail=f"no answer within {timeout_s:g} s")
    except (SQLAlchemyError, StorageError, KombuError, RedisError, OSError) as error:
        logger.warning("not ready: %s: %s", name, error)
        return FieldProblem(path=name, detail="does not answer")
    return None


@router.get("/readyz", responses=responses(503))
async def get_readiness(services: ServicesDep, response: Response) -> Readiness:
    """Whether database, broker and object store answer, each within its time."""
    response.headers["Cache-Control"] = "no-store"
    pings = {
        "database": services.database.ping,
        "broker": services.bell.ping,
        "object_store": services.store.ping,
    }
    timeout_s = services.settings.check_timeout_s
    found = await asyncio.gather(*(_check(name, ping, timeout_s) for name, ping in pings.items()))
    wrong = [problem for problem in found if problem is not None]
    if wrong:
        names = ", ".join(problem.path for problem in wrong)
        error = UnavailableError(f"Not ready: {names}.", code="not_ready")
        error.errors = wrong
        raise error
    return Readiness(checks=dict.fromkeys(pings, "ok"))
