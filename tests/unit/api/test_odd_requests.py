"""Requests that no person sends: none of them is the service's fault, on either database."""

from __future__ import annotations

import base64
import json
from typing import Any
from urllib.parse import quote

import httpx
import pytest

from storage.models import new_id
from tests.unit.api.conftest import Service, problem, zip_of_pictures


def cursor(*values: Any) -> str:
    """A page cursor as the service makes it, of anything."""
    return base64.urlsafe_b64encode(json.dumps(values).encode()).decode().rstrip("=")


NUL, HALF = "%00", "%ED%A0%80"
NOBODY = new_id()
IDS = (
    *("x", "x" * 28, "x" * 5000, NOBODY.upper(), NOBODY + "0", NOBODY[:-1], NOBODY + "%0A"),
    *(NOBODY[:-1] + NUL, NOBODY[:-1] + HALF, NUL, HALF, "%FF%FE", "..", "%2E%2E", "'--", "%C3%A4"),
    *("٣" * 28, "0" * 27 + "%EF%BC%91"),
)


@pytest.mark.parametrize(
    "path",
    [
        "/v1/jobs/{}",
        "/v1/captures/{}",
        "/v1/jobs/{}/logs",
        "/v1/jobs/{}/artifacts",
        "/v1/jobs/{}/artifacts/mesh.glb",
    ],
)
def test_what_is_no_id_is_not_found(served: Service, path: str) -> None:
    for text in (*IDS, NOBODY):
        answer = served.http.get(path.format(text))
        assert answer.status_code == 404, (text, answer.text)
        assert answer.json()["code"].endswith("not_found")


@pytest.mark.parametrize("method", ["DELETE", "POST"])
def test_changing_what_is_no_id_is_not_found(served: Service, method: str) -> None:
    for text in IDS:
        path = f"/v1/jobs/{text}" + ("/cancel" if method == "POST" else "")
        assert served.http.request(method, path).status_code == 404, text


WHEN = "2026-01-01T00:00:00+00:00"
CURSORS = (
    *("x", "%00", "\N{SNOWMAN}", "=", "A" * 499, cursor(), cursor(1, 2), cursor(WHEN, None)),
    *(
        cursor(WHEN, "\ud800"),
        cursor(WHEN, NOBODY[:-1] + "\0"),
        cursor(WHEN, NOBODY[:-1] + "\ud800"),
    ),
    *(cursor("0001-01-01T00:00:00+23:59", NOBODY), cursor("9999-12-31T23:59:59-23:59", NOBODY)),
    *(cursor("2026-01-01", NOBODY), cursor(WHEN, [NOBODY]), cursor({"a": 1}, NOBODY)),
    base64.urlsafe_b64encode(b"[" * 370).decode(),
)


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/captures"])
def test_what_is_no_cursor_is_refused(served: Service, path: str) -> None:
    for text in CURSORS:
        answer = served.http.get(path, params={"cursor": text})
        assert problem(answer, 422, answer.json()["code"])["code"] in (
            "cursor_invalid",
            "request_invalid",
        ), text
    real = cursor("9999-12-31T00:00:00+00:00", NOBODY)
    assert served.http.get(path, params={"cursor": real}).status_code == 200


LABELS = (
    "%00",
    f"a={NUL}",
    f"a{NUL}=b",
    "",
    "=",
    "=b",
    "'",
    '"',
    'a"b',
    "a[0]=1",
    "$",
    "a" * 64,
    f"{HALF}",
    "ä=1",
)


def test_labels_that_are_none_are_refused_and_odd_ones_find_nothing(served: Service) -> None:
    for text in LABELS:
        answer = served.http.get(f"/v1/jobs?label={text if '%' in text else quote(text)}")
        assert answer.status_code == 422, (text, answer.text)
    for text in ("a=", "a=%27", "a.b/c-d_e=1", "a==", f"a={HALF}", "a=%F0%9F%90%99", "a=%25"):
        answer = served.http.get(f"/v1/jobs?label={text}")
        assert (answer.status_code, answer.json()["items"]) == (200, []), text


BODIES: tuple[Any, ...] = (
    {"capture_id": "\0"},
    {"capture_id": "\ud800" * 28},
    {"capture_id": NOBODY[:-1] + "\ud800"},
    {"capture_id": NOBODY, "labels": {"a": "\0"}},
    {"capture_id": NOBODY, "labels": {"a": "\ud800"}},
    {"capture_id": NOBODY, "labels": {"\ud800": "a"}},
    {"capture_id": NOBODY, "labels": {f"k{n}": "" for n in range(51)}},
    {"capture_id": NOBODY, "labels": {f"\0{n}": "" for n in range(40)}},
    {"capture_id": NOBODY, "preset": "\ud800"},
    {"capture_id": NOBODY, "preset": "\0"},
    {"capture_id": NOBODY, "options": {"\ud800": {}}},
    {"capture_id": NOBODY, "options": {"train": {"\ud800": 1}}},
    {"capture_id": NOBODY, "options": {"train": {"method": "\ud800"}}},
    {"capture_id": NOBODY, "options": {"train": {"method": "\0"}}},
    {"capture_id": NOBODY, "options": {"train": {"max_steps": float("nan")}}},
    {"capture_id": NOBODY, "options": {"train": {"max_steps": 1e999}}},
    {"capture_id": NOBODY, "options": {"train": {"max_steps": 10**400}}},
    {"capture_id": NOBODY, "options": {f"s{n}": {} for n in range(3000)}},
    {"capture_id": NOBODY, "\ud800": 1},
)


def test_bodies_that_no_job_can_be_made_of_are_refused(served: Service) -> None:
    capture = served.upload()["id"]
    for body in BODIES:
        for capture_id in {body["capture_id"], capture if body["capture_id"] == NOBODY else ""} - {
            ""
        }:
            answer = served.http.post(
                "/v1/jobs",
                content=json.dumps({**body, "capture_id": capture_id}),
                headers={"Content-Type": "application/json"},
            )
            assert answer.status_code in (404, 422), (str(body)[:99], answer.text)
            found = problem(answer, answer.status_code, answer.json()["code"])
            assert len(answer.content) < 20_000, "an error answer grows with what was sent"
            assert len(found["errors"]) <= 50
    for content in (b"[" * 100_000, b"1" * 5000, b'{"capture_id": ' + b"1" * 5000, b"\xff", b"NaN"):
        answer = served.http.post(
            "/v1/jobs", content=content, headers={"Content-Type": "application/json"}
        )
        assert answer.status_code in (400, 422), content[:20]


def test_bodies_that_no_retry_can_be_made_of_are_refused(served: Service) -> None:
    job = served.job(preset="preview")["id"]
    served.http.post(f"/v1/jobs/{job}/cancel")
    wishes = [{"options": body["options"]} for body in BODIES if "options" in body]
    for body in (*wishes, {"from_stage": "\ud800"}, {"from_stage": "\0"}, {"\ud800": 1}):
        answer = served.http.post(
            f"/v1/jobs/{job}/retry",
            content=json.dumps(body),
            headers={"Content-Type": "application/json"},
        )
        problem(answer, 422, answer.json()["code"])
    assert served.http.get(f"/v1/jobs/{job}").json()["state"] == "cancelled"


def test_odd_forms_are_refused(served: Service) -> None:
    for kind in (
        *(
            "multipart/form-data",
            "multipart/form-data; boundary=",
            "multipart/form-data; boundary=\xff",
        ),
        *("multipart/form-data; boundary*=x''y", "\xb2", 'multipart/form-data; boundary="a\\', ";"),
        "multipart/form-data; boundary=" + "x" * 300,
    ):
        answer = served.http.post(
            "/v1/captures",
            content=b"--a\r\n\r\n",
            headers=[(b"content-type", kind.encode("latin-1"))],
        )
        assert answer.status_code in (415, 422), (kind, answer.text)
    for name in ("\ud800", "\0", "a\0.zip", "\N{RIGHT-TO-LEFT OVERRIDE}", "x" * 3000, "../../etc"):
        content = name.encode("utf-8", "surrogatepass")
        body = b'--b\r\nContent-Disposition: form-data; name="file"; filename="' + content
        body += b'"\r\n\r\n' + zip_of_pictures(1) + b"\r\n--b--\r\n"
        answer = served.http.post(
            "/v1/captures",
            content=body,
            headers={"Content-Type": "multipart/form-data; boundary=b"},
        )
        assert answer.status_code in (201, 422), (name, answer.text)


def test_every_address_names_all_its_methods_and_answers_head(served: Service) -> None:
    job = served.job()["id"]
    for path, allowed in (
        ("/v1/jobs", "GET, HEAD, POST"),
        (f"/v1/jobs/{job}", "DELETE, GET, HEAD"),
        (f"/v1/jobs/{job}/artifacts/mesh.glb", "GET, HEAD"),
        (f"/v1/jobs/{job}/cancel", "POST"),
        ("/v1/captures", "GET, HEAD, POST"),
        ("/v1/presets", "GET, HEAD"),
        ("/livez", "GET, HEAD"),
        ("/", "GET, HEAD"),
        ("/docs", "GET, HEAD"),
        ("/openapi.json", "GET, HEAD"),
    ):
        for method in ("PATCH", "TRACE", "OPTIONS", "BREW"):
            answer = served.http.request(method, path)
            problem(answer, 405, "method_not_allowed")
            assert answer.headers["allow"] == allowed, path
    for path in (
        "/v1/jobs",
        f"/v1/jobs/{job}",
        "/v1/options",
        "/livez",
        "/",
        "/docs",
        "/openapi.json",
    ):
        head, whole = served.http.head(path), served.http.get(path)
        assert (head.status_code, head.content) == (200, b""), path
        assert head.headers["content-length"] == str(len(whole.content)), path
    refused = served.http.head(f"/v1/jobs/{NOBODY}")
    assert (refused.status_code, refused.content) == (404, b"")


def test_odd_heads_are_no_fault_of_the_service(served: Service) -> None:
    for name, text in (
        ("authorization", b"Bearer \xff\xfe"),
        ("X-Request-Id", b"\xff"),
        ("Range", b"bytes=9999999999999999999999-"),
        ("If-None-Match", b"\xff"),
        ("Accept", b"\xff"),
        ("Cookie", b"\xff"),
    ):
        answer = httpx.get(
            str(served.http.base_url.join("/v1/jobs")),
            headers=[
                *((key, value) for key, value in served.http.headers.raw if key != name.encode()),
                (name.encode(), text),
            ],
        )
        assert answer.status_code in (200, 401), name
