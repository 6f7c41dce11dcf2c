"""One shape for every error, keys, health, and the catalogue."""

from __future__ import annotations

import errno
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from sqlalchemy.exc import OperationalError

from api.app import create_app
from api.codes import CODES
from api.errors import to_api_error
from api.problems import ApiError
from pipelines import errors as pipeline_errors
from pipelines.options import STAGE_OPTIONS, resolve_options
from pipelines.presets import PRESETS
from storage import errors as storage_errors
from storage.api_keys import create_api_key, revoke_api_key
from tests.services import RedisServer
from tests.unit.api.conftest import KEY, Service, problem, serving, settings_for

V1_CALLS = [
    ("POST", "/v1/captures"),
    ("GET", "/v1/captures"),
    ("GET", "/v1/captures/x"),
    ("DELETE", "/v1/captures/x"),
    ("POST", "/v1/captures/x/check"),
    ("POST", "/v1/jobs"),
    ("POST", "/v1/jobs:validate"),
    ("GET", "/v1/jobs"),
    ("GET", "/v1/jobs/x"),
    ("POST", "/v1/jobs/x/cancel"),
    ("POST", "/v1/jobs/x/retry"),
    ("POST", "/v1/jobs/x/exports"),
    ("GET", "/v1/jobs/x/exports"),
    ("GET", "/v1/exports/kinds"),
    ("GET", "/v1/jobs/x/events"),
    ("DELETE", "/v1/jobs/x"),
    ("GET", "/v1/jobs/x/artifacts"),
    ("GET", "/v1/jobs/x/artifacts/y"),
    ("GET", "/v1/jobs/x/logs"),
    ("GET", "/v1/presets"),
    ("GET", "/v1/options"),
    ("GET", "/v1/workers"),
]


def test_every_call_below_v1_wants_a_key(service: Service) -> None:
    for method, path in V1_CALLS:
        answer = service.anyone.request(method, path)
        problem(answer, 401, "unauthorized")
        assert answer.headers["www-authenticate"].startswith("Bearer")


@pytest.mark.parametrize(
    "header",
    ["Bearer wrong", "Bearer", f"Basic {KEY}", KEY, "Bearer " + "x" * 5000, f"bearer {KEY}x"],
)
def test_wrong_key_is_refused(service: Service, header: str) -> None:
    answer = service.anyone.get("/v1/jobs", headers={"Authorization": header})
    problem(answer, 401, "unauthorized")


def test_key_in_the_address_is_not_looked_at(service: Service) -> None:
    problem(service.anyone.get("/v1/jobs", params={"token": KEY}), 401, "unauthorized")


def test_revoked_key_is_refused(service: Service) -> None:
    with service.services.database.session_scope() as session:
        record, key = create_api_key(session, "a friend")
        key_id = record.id
    header = {"Authorization": f"Bearer {key}"}
    assert service.anyone.get("/v1/jobs", headers=header).status_code == 200
    with service.services.database.session_scope() as session:
        revoke_api_key(session, key_id)
    problem(service.anyone.get("/v1/jobs", headers=header), 401, "unauthorized")


def test_list_of_keyed_calls_is_complete(service: Service) -> None:
    paths = service.anyone.get("/openapi.json").json()["paths"]
    declared = {
        (method.upper(), path)
        for path, calls in paths.items()
        for method, call in calls.items()
        if call.get("security")
    }
    tested = {
        (
            method,
            path.replace("/captures/x", "/captures/{capture_id}")
            .replace("/jobs/x", "/jobs/{job_id}")
            .replace("/y", "/{name}"),
        )
        for method, path in V1_CALLS
    }
    assert declared == tested


def test_unknown_address_and_method(service: Service) -> None:
    problem(service.http.get("/v1/nothing"), 404, "not_found")
    problem(service.http.get("/favicon.ico"), 404, "not_found")
    answer = service.http.put("/v1/jobs", json={})
    problem(answer, 405, "method_not_allowed")
    assert answer.headers["allow"]


@pytest.mark.parametrize(
    ("content", "paths"),
    [(b"{not json", True), (b"", True), (b"[]", True), (b'"text"', True), (b"\xff\xfe", True)],
)
def test_body_that_is_no_job_is_refused(service: Service, content: bytes, paths: bool) -> None:
    answer = service.http.post(
        "/v1/jobs", content=content, headers={"Content-Type": "application/json"}
    )
    assert answer.status_code in (400, 422)
    found = problem(answer, answer.status_code, answer.json()["code"])
    assert found["code"] in ("request_invalid", "bad_request")


def test_large_body_of_a_small_call_is_refused(service: Service) -> None:
    answer = service.http.post("/v1/jobs", content=b'{"capture_id": "' + b"x" * (2 << 20) + b'"}')
    problem(answer, 413, "too_large")


def test_surprise_is_an_opaque_500(tmp_path: Path) -> None:
    async def surprise(settings: Any) -> httpx.Response:
        app: FastAPI = create_app(settings)

        @app.get("/surprise")
        def fail() -> None:
            raise RuntimeError(f"secret at {tmp_path}")

        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
            return await client.get("/surprise", headers={"X-Request-Id": "abc-123"})

    import asyncio

    answer = asyncio.run(surprise(settings_for(tmp_path)))
    problem(answer, 500, "internal_error")
    assert answer.headers["x-request-id"] == "abc-123"
    assert "secret" not in answer.text
    assert str(tmp_path) not in answer.text


@pytest.mark.parametrize(
    ("sent", "kept"), [("trace-1.a_b", True), ("bad id", False), ("x" * 65, False)]
)
def test_request_id_is_kept_where_it_is_well_formed(
    service: Service, sent: str, kept: bool
) -> None:
    answer = service.anyone.get("/livez", headers={"X-Request-Id": sent})
    assert (answer.headers["x-request-id"] == sent) is kept
    assert answer.headers["x-request-id"]


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (pipeline_errors.CaptureError("m", code="too_large"), 413, "too_large"),
        (pipeline_errors.CaptureError("m", code="archive_bomb"), 413, "archive_bomb"),
        (pipeline_errors.CaptureError("m", code="unknown_type"), 415, "unknown_type"),
        (pipeline_errors.CaptureError("m", code="empty_file"), 422, "empty_file"),
        (pipeline_errors.ResourceError("m", code="disk_full"), 507, "disk_full"),
        (pipeline_errors.PosesError("m"), 422, "poses_failed"),
        (storage_errors.NotFoundError("job", "1"), 404, "job_not_found"),
        (storage_errors.ConflictError("m"), 409, "conflict"),
        (storage_errors.InvalidCursorError("m"), 422, "cursor_invalid"),
        (storage_errors.InvalidUrlError("m"), 403, "url_invalid"),
        (storage_errors.ObjectMissingError("m"), 404, "object_not_found"),
        (storage_errors.ObjectStoreFullError("m"), 507, "disk_full"),
        (storage_errors.ObjectStoreError("m"), 503, "object_store_unavailable"),
        (OperationalError("select", {}, Exception("down")), 503, "database_unavailable"),
        (OSError(errno.ENOSPC, "full"), 507, "disk_full"),
        (OSError(errno.EIO, "broken"), 500, "internal_error"),
        (KeyError("x"), 500, "internal_error"),
    ],
)
def test_errors_of_other_rooms_have_their_status(error: Exception, status: int, code: str) -> None:
    found = to_api_error(error)
    assert (found.status, found.code) == (status, code)
    assert found.hint


def test_every_storage_error_is_mapped() -> None:
    inside = {  # never reach a client
        storage_errors.StorageError,
        storage_errors.LostLeaseError,
        storage_errors.BlobMissingError,
    }
    kinds = [
        kind
        for kind in vars(storage_errors).values()
        if isinstance(kind, type) and issubclass(kind, storage_errors.StorageError)
    ]
    for kind in kinds:
        error = kind("job", "1") if kind is storage_errors.NotFoundError else kind("m")
        assert (to_api_error(error).code == "internal_error") is (kind in inside), kind


def _kinds(kind: type[ApiError]) -> list[type[ApiError]]:
    return [kind, *(one for sub in kind.__subclasses__() for one in _kinds(sub))]


def test_api_errors_have_distinct_codes_and_hints() -> None:
    kinds = _kinds(ApiError)
    assert len({kind.code for kind in kinds}) == len(kinds)
    assert all(kind.hint for kind in kinds)


def test_liveness_needs_nothing_and_readiness_names_what_is_missing(service: Service) -> None:
    assert service.anyone.get("/livez").json() == {"status": "ok"}
    found = problem(service.anyone.get("/readyz"), 503, "not_ready")
    assert [error["path"] for error in found["errors"]] == ["broker"]


@pytest.mark.services
def test_ready_where_everything_answers(tmp_path: Path, redis_server: RedisServer) -> None:
    with serving(settings_for(tmp_path / "home", redis_url=redis_server.url)) as service:
        answer = service.anyone.get("/readyz")
        assert answer.status_code == 200, answer.text
        assert answer.json() == {
            "status": "ok",
            "checks": {"database": "ok", "broker": "ok", "object_store": "ok"},
        }
        redis_server.kill()
        problem(service.anyone.get("/readyz"), 503, "not_ready")


def test_presets_are_complete_and_options_are_described(service: Service) -> None:
    found = service.http.get("/v1/presets").json()
    assert {item["name"]: item["options"] for item in found["items"]} == {
        name: resolve_options(name, {}) for name in PRESETS
    }
    assert {item["name"]: set(item["without"]) for item in found["items"]} == {
        name: preset.without for name, preset in PRESETS.items()
    }
    schema = service.http.get("/v1/options").json()
    assert set(schema["properties"]) == set(STAGE_OPTIONS)
    assert schema["additionalProperties"] is False
    assert schema["properties"]["mesh"]["default"] == STAGE_OPTIONS["mesh"]().model_dump(
        mode="json"
    )
    frames = schema["$defs"]["FramesOptions"]["properties"]["num_frames"]
    assert frames["default"] == 300
    assert frames["minimum"] == 8
    assert frames["description"]


def test_every_reference_in_the_options_schema_leads_somewhere(service: Service) -> None:
    schema = service.http.get("/v1/options").json()

    def references(node: Any) -> list[str]:
        if isinstance(node, dict):
            own = [node["$ref"]] if "$ref" in node else []
            return own + [ref for value in node.values() for ref in references(value)]
        if isinstance(node, list):
            return [ref for value in node for ref in references(value)]
        return []

    found = references(schema)
    assert found
    assert {ref.removeprefix("#/$defs/") for ref in found} <= set(schema["$defs"])


def test_openapi_names_operations_and_the_shape_of_errors(service: Service) -> None:
    document = service.anyone.get("/openapi.json").json()
    ids = {call["operationId"] for calls in document["paths"].values() for call in calls.values()}
    assert ids == {
        *("create_capture", "list_captures", "get_capture", "delete_capture", "check_capture"),
        *("create_export", "list_exports", "list_export_kinds"),
        *(
            "create_job",
            "validate_job",
            "list_jobs",
            "get_job",
            "cancel_job",
            "delete_job",
            *("get_job_logs", "retry_job", "list_job_events"),
        ),
        *("list_artifacts", "download_artifact", "download_object"),
        *("list_presets", "get_options_schema", "get_liveness", "get_readiness", "list_workers"),
    }
    assert {"Problem", "FieldProblem"} <= set(document["components"]["schemas"])
    for path, calls in document["paths"].items():
        for call in calls.values():
            for status, answer in call["responses"].items():
                if int(status) >= 400:
                    assert list(answer["content"]) == ["application/problem+json"], path


def test_every_code_in_the_sources_is_listed_with_its_status() -> None:
    """Codes are written as `code="..."`; those of captures are raised by what the API imports."""
    root = Path(__file__).resolve().parents[3]
    sources = [
        *(path for path in (root / "api").rglob("*.py") if "client" not in path.parts),
        root / "pipelines/captures/sniff.py",
        root / "pipelines/captures/archive_rules.py",
        root / "pipelines/captures/parsing.py",
    ]
    found = {
        code
        for path in sources
        for code in re.findall(r'\bcode\s*=\s*"([a-z_]+)"', path.read_text("utf-8"))
    }
    assert len(found) > 25
    assert found <= set(CODES)
    assert {CODES[kind.code] == kind.status for kind in ApiError.__subclasses__()} == {True}


def test_links_lead_to_calls_that_there_are(service: Service) -> None:
    document = service.anyone.get("/openapi.json").json()
    calls = [call for calls in document["paths"].values() for call in calls.values()]
    names = {call["operationId"] for call in calls}
    links = [
        link["operationId"]
        for call in calls
        for answer in call["responses"].values()
        for link in answer.get("links", {}).values()
    ]
    assert {"get_job", "create_job", "list_artifacts"} <= set(links) <= names


def test_the_documentation_loads_nothing_from_elsewhere(service: Service) -> None:
    answer = service.anyone.get("/docs")
    assert answer.status_code == 200
    assert not re.search(r"<script|<link|https?://|@import|url\(", answer.text)
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    for text in ("POST /v1/jobs", "idempotency_key_reused", "Idempotency-Key", "curl"):
        assert text in answer.text
    assert "{&#x27;" not in answer.text, "a Python object was printed"


def test_front_page_links_the_documentation(service: Service) -> None:
    answer = service.anyone.get("/")
    assert answer.status_code == 200
    assert "/docs" in answer.text
    assert service.anyone.get("/docs").status_code == 200
