"""The application: routers, what they share, and how errors look."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import Any

from fastapi import Depends, FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool

from api import catalogue, errors, health, workers
from api.artifacts import endpoints as artifacts
from api.captures import endpoints as captures
from api.captures.receiving import sweep
from api.cross_origin import CrossOrigin
from api.deps import MAX_CREATIONS, MAX_STORE_CALLS, Services, require_key
from api.documentation import page_of
from api.exports import endpoints as exports
from api.jobs import endpoints as jobs
from api.probes import Probe
from api.problems import Problem
from api.settings import ApiSettings
from storage.api_keys import take_bootstrap_key
from storage.bell import Bell
from storage.db import Database
from storage.deletions import Drainer
from storage.key_uses import KeyUses
from storage.open_objects import open_object_store
from storage.schema import upgrade

VERSION = "1"
DRAIN_S = 2.0
PREPARE_S = 0.5
"""After the start: the first answer comes first."""
PAGE_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
logger = logging.getLogger("nerfworks.api")


def open_services(settings: ApiSettings) -> Services:
    """Open the parts: bring the database up to date, take the key of the settings, tidy up."""
    upgrade(settings.resolved_database_url)
    database = Database(settings.resolved_database_url, settings.database_timeout_s)
    key = settings.bootstrap_key()
    if key:
        with database.session_scope() as session:
            is_refused = take_bootstrap_key(session, key).revoked_at is not None
        if is_refused:
            logger.error(
                "The API key of these settings was replaced or revoked before and stays invalid: "
                "set the one that is valid, or one that was never used."
            )
    settings.staging_dir.mkdir(parents=True, exist_ok=True)
    removed = sweep(settings.staging_dir)
    if removed:
        logger.info("removed %d uploads that were cut short", removed)
    store = open_object_store(settings)
    bell = Bell(settings.redis_url, database)
    return Services(
        settings,
        database,
        store,
        bell,
        Drainer(database, store),
        KeyUses(database),
        (
            Probe("database", database.ping),
            Probe("broker", bell.ping),
            Probe("object_store", store.ping),
        ),
        threading.BoundedSemaphore(MAX_STORE_CALLS),
        asyncio.Semaphore(MAX_CREATIONS),
        threading.BoundedSemaphore(settings.max_uploads),
    )


def close_services(services: Services) -> None:
    """Close what `open_services` opened."""
    services.bell.close()
    services.drainer.close(DRAIN_S)
    services.key_uses.close()
    services.database.dispose()


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    services = await run_in_threadpool(open_services, app.state.settings)
    # An upload writes in one thread at most: a disk or a store that hangs stops its own alone.
    threads = ThreadPoolExecutor(services.settings.max_uploads, thread_name_prefix="upload")
    asyncio.get_running_loop().set_default_executor(threads)
    app.state.services = services
    services.bell.prepare(PREPARE_S)
    try:
        yield
    finally:
        await run_in_threadpool(close_services, services)


def _operation_id(route: APIRoute) -> str:
    return route.name


def _document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document, with the error schema that all responses refer to."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        schema = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas = document["components"]["schemas"]
        schemas.update(schema.pop("$defs", {}))
        schemas["Problem"] = schema
        app.openapi_schema = document
    return app.openapi_schema


def create_app(settings: ApiSettings | None = None) -> FastAPI:
    """The ASGI application. Settings come from the environment where none are given."""
    settings = settings or ApiSettings()
    app = FastAPI(
        title="nerfworks",
        version=VERSION,
        description=(
            "Send a phone capture over HTTP; get back a mesh, a point cloud and a video. Errors "
            "are RFC 9457 problem documents with a stable `code` and a `hint`."
        ),
        lifespan=_lifespan,
        generate_unique_id_function=_operation_id,
        redirect_slashes=False,
        docs_url=None,  # those pages load scripts from elsewhere: ours is api.documentation
        redoc_url=None,
    )
    app.state.settings = settings

    @app.get("/docs", include_in_schema=False, response_class=HTMLResponse)
    def get_documentation() -> HTMLResponse:
        """The OpenAPI document as a page."""
        return HTMLResponse(
            page_of(app.openapi()), headers={"Content-Security-Policy": PAGE_POLICY}
        )

    keyed = (
        *(captures.router, jobs.router, exports.router, artifacts.router, catalogue.router),
        workers.router,
    )
    others = (artifacts.signed_router, health.router, catalogue.page_router)
    errors.install(
        app,
        max_body_bytes=settings.max_body_bytes,
        max_body_s=settings.small_body_s,
        upload_path=captures.PATH,
        routes=[*app.routes, *(route for one in (*keyed, *others) for route in one.routes)],
    )
    app.add_middleware(
        CrossOrigin, downloads=f"{artifacts.signed_router.prefix}/", origins=settings.cors_origins
    )
    for router in keyed:
        app.include_router(router, dependencies=[Depends(require_key)])
    for router in others:
        app.include_router(router)

    app.openapi = lambda: _document(app)  # type: ignore[method-assign]
    return app
