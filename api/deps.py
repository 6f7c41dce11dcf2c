"""What endpoints are given: the service's parts, and a caller whose key is good."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from api.problems import UnauthorizedError
from api.settings import ApiSettings
from storage.api_keys import find_api_key, is_use_due, touch_api_key
from storage.db import Database, now
from storage.objects import ObjectStore
from storage.queue import Bell

MAX_KEY_CHARS = 256


@dataclass(frozen=True)
class Services:
    """The parts that all requests share; made once in the application's lifespan."""

    settings: ApiSettings
    database: Database
    store: ObjectStore
    bell: Bell


def get_services(request: Request) -> Services:
    """The parts of the running application."""
    services: Services = request.app.state.services
    return services


ServicesDep = Annotated[Services, Depends(get_services)]

_bearer = HTTPBearer(auto_error=False, description="An API key of this service.")


def require_key(
    services: ServicesDep,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> str:
    """The id of the caller's key. Raises UnauthorizedError.

    Keys hold 256 random bits and are looked up by their SHA-256, so that the comparison gives
    nothing away about them.
    """
    if credentials is None or not credentials.credentials:
        raise UnauthorizedError("This call needs an API key.")
    key = credentials.credentials
    if len(key) > MAX_KEY_CHARS:
        raise UnauthorizedError("The API key is not valid.")
    with services.database.read_scope() as session:
        record = find_api_key(session, key)
        if record is None:
            raise UnauthorizedError("The API key is not valid.")
        key_id, due = record.id, is_use_due(record, now(session))
    if due:
        with services.database.session_scope() as session:
            touch_api_key(session, key_id)
    return key_id
