"""What endpoints are given: the service's parts, and a caller whose key is good."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from api.probes import Probe
from api.problems import UnauthorizedError, UnavailableError
from api.settings import ApiSettings
from storage.api_keys import find_api_key, is_use_due
from storage.bell import Bell
from storage.db import Database
from storage.deletions import Drainer
from storage.key_uses import KeyUses
from storage.objects import ObjectStore

MAX_KEY_CHARS = 256
MAX_STORE_CALLS = 8
STORE_TURN_S = 1.0
MAX_CREATIONS = 2
CREATE_TURN_S = 60.0
DELETE_WAIT_S = 2.0


@dataclass(frozen=True)
class Services:
    """The parts that all requests share; made once in the application's lifespan."""

    settings: ApiSettings
    database: Database
    store: ObjectStore
    bell: Bell
    drainer: Drainer
    key_uses: KeyUses
    probes: tuple[Probe, ...]
    store_calls: threading.BoundedSemaphore
    """Held by a request that waits for the object store: a store that hangs stops only so many."""
    creations: asyncio.Semaphore
    """Held while a job is recorded (`creating`)."""
    uploads: threading.BoundedSemaphore
    """Held by an upload from its first byte to its answer."""

    @contextmanager
    def taking_an_upload(self) -> Iterator[None]:
        """Around an upload. Raises UnavailableError where as many as may be are coming in."""
        if not self.uploads.acquire(blocking=False):
            raise UnavailableError(
                f"{self.settings.max_uploads} uploads are coming in already.", code="uploads_busy"
            )
        try:
            yield
        finally:
            self.uploads.release()

    async def creating(self, create: Callable[[], Response]) -> Response:
        """Run what records a job in a thread, MAX_CREATIONS at a time, in the order of arrival.

        It is Python's work for the most part, which one thread does at a time: more at once would
        be no faster, and keep those waiting who only read. Who waits here holds no thread. Raises
        UnavailableError where those before take too long, as they do where the database hangs.
        """
        try:
            async with asyncio.timeout(CREATE_TURN_S):
                await self.creations.acquire()
        except TimeoutError as error:
            raise UnavailableError(
                "The database does not answer.", code="database_unavailable"
            ) from error
        try:
            return await run_in_threadpool(create)
        finally:
            self.creations.release()

    @contextmanager
    def asking_the_store(self) -> Iterator[None]:
        """Around a short call of the object store. Raises UnavailableError where many wait."""
        if not self.store_calls.acquire(timeout=STORE_TURN_S):
            raise UnavailableError(
                "The object store does not answer.", code="object_store_unavailable"
            )
        try:
            yield
        finally:
            self.store_calls.release()


async def get_services(request: Request) -> Services:
    """The parts of the running application."""
    services: Services = request.app.state.services
    return services


SharedServicesDep = Annotated[Services, Depends(get_services)]
"""For what no caller asks: keys, health, signed addresses. Its database is that of all tenants."""


@dataclass(frozen=True)
class Caller:
    """Whose call it is. id: of the API key."""

    id: str
    tenant_id: str


_bearer = HTTPBearer(auto_error=False, description="An API key of this service.")


def require_key(
    services: SharedServicesDep,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Caller:
    """Whose key it is. Raises UnauthorizedError.

    Keys hold 256 random bits and are looked up by their SHA-256, so that the comparison gives
    nothing away about them.
    """
    if credentials is None or not credentials.credentials:
        raise UnauthorizedError("This call needs an API key.")
    key = credentials.credentials
    if len(key) > MAX_KEY_CHARS:
        raise UnauthorizedError("The API key is not valid.")
    with services.database.read_scope() as session:
        found = find_api_key(session, key)
    if found is None:
        raise UnauthorizedError("The API key is not valid.")
    record, moment = found
    if is_use_due(record, moment):
        services.key_uses.note(record.id)
    return Caller(record.id, record.tenant_id)


CallerDep = Annotated[Caller, Depends(require_key)]


async def get_own_services(services: SharedServicesDep, caller: CallerDep) -> Services:
    """The parts for one caller: the database shows, and lets go of, nothing but its tenant's."""
    return replace(services, database=services.database.of_tenant(caller.tenant_id))


ServicesDep = Annotated[Services, Depends(get_own_services)]


def actor_of(caller: Caller) -> str:
    """A caller as events name it."""
    return f"api-key:{caller.id}"
