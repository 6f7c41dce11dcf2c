"""What web pages of other origins may read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from api.settings import ApiSettings
from tests.unit.api.conftest import Service, finish_job, serving, settings_for

CONTENT = bytes(range(256)) * 4
OURS, OTHERS = "https://app.example.org", "https://evil.example"


def _served(home: Path, **changes: Any) -> Iterator[tuple[Service, str, str]]:
    with serving(settings_for(home, **changes)) as service:
        job = service.job()
        finish_job(service.services, job["id"], lambda name: CONTENT)
        items = service.http.get(f"/v1/jobs/{job['id']}/artifacts").json()["items"]
        url = next(item["url"] for item in items if item["name"] == "mesh.glb")
        yield service, url, f"/v1/jobs/{job['id']}"


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, str, str]]:
    """A service, the signed URL of a mesh, and the address of its job."""
    yield from _served(tmp_path_factory.mktemp("home"))


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, str, str]]:
    """The same, which pages of OURS may call."""
    yield from _served(tmp_path_factory.mktemp("home"), cors_origins=(OURS,))


def preflight(service: Service, url: str, origin: str, method: str = "GET") -> Any:
    asked = {"Origin": origin, "Access-Control-Request-Method": method}
    asked["Access-Control-Request-Headers"] = "range" if method == "GET" else "authorization"
    return service.anyone.request("OPTIONS", url, headers=asked)


@pytest.mark.parametrize("which", ["closed", "opened"])
def test_any_page_may_load_files_at_signed_urls(which: str, request: pytest.FixtureRequest) -> None:
    service, url, _ = request.getfixturevalue(which)
    asked = preflight(service, url, OTHERS)
    assert asked.status_code == 204
    assert asked.headers["access-control-allow-origin"] == "*"
    assert "GET" in asked.headers["access-control-allow-methods"]
    assert "Range" in asked.headers["access-control-allow-headers"]
    assert "Authorization" not in asked.headers["access-control-allow-headers"]
    for method, headers, status in (
        ("GET", {}, 200),
        ("HEAD", {}, 200),
        ("GET", {"Range": "bytes=5-9"}, 206),
        ("GET", {"Range": "bytes=9999-"}, 416),
    ):
        answer = service.anyone.request(method, url, headers={"Origin": OTHERS, **headers})
        assert answer.status_code == status
        assert answer.headers["access-control-allow-origin"] == "*"
        for name in ("ETag", "Content-Range", "Content-Length", "Accept-Ranges"):
            assert name in answer.headers["access-control-expose-headers"]
        assert "access-control-allow-credentials" not in answer.headers
    stale = service.anyone.get("/v1/objects/garbage", headers={"Origin": OTHERS})
    assert (stale.status_code, stale.headers["access-control-allow-origin"]) == (403, "*")


@pytest.mark.parametrize("origin", [OTHERS, OURS, "null", "*"])
def test_no_page_may_read_what_needs_a_key(closed: tuple[Service, str, str], origin: str) -> None:
    service, _, job = closed
    for path in (job, f"{job}/artifacts/mesh.glb", "/v1/jobs", "/v1/objects", "/livez", "/docs"):
        for answer in (
            service.http.get(path, headers={"Origin": origin}),
            service.anyone.get(path, headers={"Origin": origin}),
            preflight(service, path, origin),
        ):
            assert not [name for name in answer.headers if name.startswith("access-control")], path
    assert preflight(service, job, origin).status_code == 405


def test_a_page_whose_origin_the_settings_name_may_call_with_a_key(
    opened: tuple[Service, str, str],
) -> None:
    service, _, job = opened
    asked = preflight(service, "/v1/jobs", OURS, "POST")
    assert asked.status_code == 204
    assert asked.headers["access-control-allow-origin"] == OURS
    assert {"Authorization", "Content-Type", "Idempotency-Key"} <= {
        *asked.headers["access-control-allow-headers"].split(", ")
    }
    answer = service.http.get(job, headers={"Origin": OURS})
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (200, OURS)
    assert "Origin" in answer.headers["vary"]
    refused = service.anyone.get(job, headers={"Origin": OURS})
    assert (refused.status_code, refused.headers["access-control-allow-origin"]) == (401, OURS)
    assert "access-control-allow-credentials" not in answer.headers


@pytest.mark.parametrize(
    "origin", [OTHERS, "null", f"{OURS}:444", f"{OURS}.evil.example", "http://app.example.org"]
)
def test_a_page_of_any_other_origin_may_not(opened: tuple[Service, str, str], origin: str) -> None:
    service, _, job = opened
    answer = service.http.get(job, headers={"Origin": origin})
    assert "access-control-allow-origin" not in answer.headers
    assert "Origin" in answer.headers["vary"], "a cache must not hand it to a page that may"
    assert preflight(service, job, origin).status_code == 405


def test_origins_are_named_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFWORKS_CORS_ORIGINS", f"{OURS}, http://localhost:5173,http://[::1]:80")
    assert ApiSettings().cors_origins == (OURS, "http://localhost:5173", "http://[::1]:80")
    monkeypatch.setenv("NERFWORKS_CORS_ORIGINS", "")
    assert ApiSettings().cors_origins == ()
    for wrong in ("*", "null", f"{OURS}/", "app.example.org", "https://*.example.org", "HTTPS://A"):
        monkeypatch.setenv("NERFWORKS_CORS_ORIGINS", wrong)
        with pytest.raises(ValidationError, match="is no origin"):
            ApiSettings()
