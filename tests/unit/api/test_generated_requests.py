"""What schemathesis makes of our OpenAPI document: valid requests, broken ones, and odd text.

Every operation succeeds at least once, on objects that there are, at addresses that links of
earlier answers name; whatever else comes is answered as documented, and never 5xx. NUL and lone
surrogates are among the values of bodies, paths, queries and heads. The seed is fixed, so that a
failure comes again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote, urlencode

import httpx
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.checks import load_all_checks
from schemathesis.core import NotSet, result
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from tests.unit.api.conftest import (
    Service,
    finish_job,
    zip_of_pictures,
)

EXAMPLES = 9
JSON = {"Content-Type": "application/json"}
ODD = st.sampled_from(["\0", "\ud800", "a\0b", "\udfff\ud800", "ä", "\U0001f419", "%00", "'", ""])
ODD_HEADS = ("Idempotency-Key", "X-Request-Id", "Range", "If-None-Match", "Accept")
NEEDS_A_BROKER = {"get_readiness"}
"""Nothing listens at this service's broker: the answer is a documented 503."""


def with_odd_text(value: Any, draw: Any) -> Any:
    """The value with some of its text, keys too, replaced by text that hardly anything takes."""
    if isinstance(value, str):
        return draw(ODD) if draw(st.integers(0, 3)) == 0 else value
    if isinstance(value, dict):
        return {
            draw(ODD) if draw(st.integers(0, 9)) == 0 else key: with_odd_text(one, draw)
            for key, one in value.items()
        }
    if isinstance(value, list):
        return [with_odd_text(one, draw) for one in value]
    return value


@dataclass
class Target:
    """A service, its document, what there is in it, and which operations have succeeded."""

    service: Service
    document: dict[str, Any]
    done: dict[str, Any]
    token: str
    succeeded: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, service: Service) -> Target:
        """With a finished job."""
        job = service.job(labels={"a": "b"})
        finish_job(service.services, job["id"], lambda _: b"content")
        artifacts = service.http.get(f"/v1/jobs/{job['id']}/artifacts").json()["items"]
        (mesh,) = (one for one in artifacts if one["name"] == "mesh.glb")
        token = mesh["url"].rpartition("/")[2]
        return cls(service, service.anyone.get("/openapi.json").json(), job, token)

    def parameters(self, operation: str) -> dict[str, str]:
        """Those of an address at which this operation succeeds."""
        job, capture = self.done["id"], self.done["capture_id"]
        if operation in ("delete_job", "cancel_job", "retry_job"):
            job = self.service.job(capture)["id"]
        if operation == "retry_job":
            assert self.service.http.post(f"/v1/jobs/{job}/cancel").status_code == 202
        if operation == "delete_capture":
            capture = self.service.upload()["id"]
        return {"job_id": job, "capture_id": capture, "name": "mesh.glb", "token": self.token}

    def body(self, operation: str) -> Any:
        """One with which it does; None where it takes none."""
        return {
            "create_job": {"capture_id": self.done["capture_id"], "labels": {"a": "b"}},
            "create_export": {"kind": "mesh"},
            "retry_job": {},
            "validate_job": {},
            "check_capture": {},
        }.get(operation)

    def note(self, operation: str, answer: httpx.Response) -> None:
        """Which operations have done what they are for."""
        if answer.status_code < 400:
            self.succeeded.add(operation)


ELSEWHERE = {404: "not_found", 405: "method_not_allowed"}
"""Of an address that is no longer this call's, as text in its path may make it."""


def check(case: Any, answer: Any) -> None:
    """Assert that an answer is one that the document has for this operation."""
    assert answer.status_code < 500 or case.path == "/readyz", answer.text
    checks = [content_type_conformance]
    code = ELSEWHERE.get(answer.status_code)
    if code is None or not answer.content or answer.json()["code"] != code:
        checks += [response_schema_conformance, status_code_conformance]
    case.validate_response(answer, checks=checks)


def send_real(target: Target, case: Any, operation: str) -> httpx.Response:
    """A request as a good client sends it."""
    path = case.path.format(**case.path_parameters)
    sent: dict[str, Any] = {"json": target.body(operation)}
    if operation == "create_capture":
        sent = {"files": {"file": ("photos.zip", zip_of_pictures())}}
    http = target.service.http
    request = http.build_request(case.method, path, **sent)
    request.read()  # the checks want to see it
    return http.send(request)


def send_odd(target: Target, case: Any, operation: str, draw: Any) -> httpx.Response:
    """By hand: schemathesis itself cannot hold half of a surrogate pair."""

    def escaped(text: object) -> str:
        return quote(str(text), safe="", errors="surrogatepass")

    where = draw(st.sampled_from(["path", "query", "heads", "body"]))
    given = {**case.path_parameters}
    if where != "path" or draw(st.booleans()):
        real = target.parameters(operation)
        given = {name: real.get(name, value) for name, value in given.items()}
    if where == "path" and given:
        spoilt = draw(st.sampled_from(sorted(given)))
        whole = draw(ODD)
        given[spoilt] = whole if draw(st.booleans()) else f"{given[spoilt]}"[:-1] + whole
    path = case.path.format(**{name: escaped(value) for name, value in given.items()})
    query = {} if isinstance(case.query, NotSet) else dict(case.query)
    if where == "query":
        known = [
            one["name"]
            for one in target.document["paths"][case.path][case.method.lower()].get(
                "parameters", []
            )
            if one["in"] == "query"
        ]
        query |= {name: draw(ODD) for name in known if draw(st.booleans())}
        query |= {draw(ODD): draw(ODD)}
        if "label" in known:
            query["label"] = f"a={draw(ODD)}"
    pairs = urlencode(query, doseq=True, errors="surrogatepass", encoding="utf-8")
    heads: list[tuple[bytes, bytes]] = []
    if where == "heads":
        for name in ODD_HEADS:
            text = draw(ODD).replace("\0", "\t")  # what no server takes, no client can send
            heads.append((name.encode(), b"x" + text.encode("utf-8", "surrogatepass") + b"x"))
    content = None
    if case.media_type == "application/json":
        body = None if isinstance(case.body, NotSet) else case.body
        content = json.dumps(with_odd_text(body, draw) if where == "body" else body).encode()
        heads.append((b"Content-Type", b"application/json"))
    address = f"{path}?{pairs}" if pairs else path
    return target.service.http.request(case.method, address, content=content, headers=heads)


def send_generated(target: Target, operation: Any, name: str) -> set[int]:
    """What schemathesis makes for one operation; what was answered."""
    statuses: set[int] = set()

    @seed(20261122)
    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=[*HealthCheck],
    )
    @given(case=operation.as_strategy(), data=st.data())
    def run(case: Any, data: st.DataObject) -> None:
        draw = data.draw
        if draw(st.booleans()):
            answer: Any = send_odd(target, case, name, draw)
        else:
            if draw(st.booleans()):  # a job, a capture, an artifact that there is
                real = target.parameters(name)
                case.path_parameters = {
                    key: real.get(key, value) for key, value in case.path_parameters.items()
                }
            http = target.service.http
            answer = case.call(base_url=str(http.base_url), headers=dict(http.headers), timeout=20)
        statuses.add(answer.status_code)
        check(case, answer)

    run()
    return statuses


def test_generated_requests_are_answered_as_documented(served: Service) -> None:
    load_all_checks()
    target = Target.of(served)
    schema = schemathesis.openapi.from_dict(target.document)
    schema.config.generation.update(modes=[GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
    statuses: set[int] = set()
    operations = {
        found.ok().definition.raw["operationId"]: found.ok()
        for found in schema.get_all_operations()
        if isinstance(found, result.Ok)
    }
    assert len(operations) > 20
    for name, operation in operations.items():
        real = target.parameters(name)
        plain = operation.Case(
            path_parameters={key: real[key] for key in real if f"{{{key}}}" in operation.path}
        )
        answer = send_real(target, plain, name)
        target.note(name, answer)
        check(plain, answer)
        statuses |= send_generated(target, operation, name)
    assert {200, 202, 204, 404, 422} <= statuses, statuses
    assert target.succeeded == operations.keys() - NEEDS_A_BROKER


def follow(
    target: Target, operation: str, link: dict[str, Any], made: dict[str, Any]
) -> httpx.Response:
    """Call what a link names, with what it says comes from the answer."""

    def value(expression: str) -> str:
        found = made
        for part in expression.removeprefix("$response.body#/").split("/"):
            found = found[part]
        return str(found)

    (path, method, call) = next(
        (path, method, call)
        for path, calls in target.document["paths"].items()
        for method, call in calls.items()
        if call["operationId"] == link["operationId"]
    )
    given = {name: value(one) for name, one in link.get("parameters", {}).items()}
    assert {one["name"] for one in call.get("parameters", []) if one["in"] == "path"} == set(given)
    body = {name: value(one) for name, one in link.get("requestBody", {}).items()}
    answer = target.service.http.request(
        method, path.format(**given), json=body if "requestBody" in call else None
    )
    target.note(link["operationId"], answer)
    assert answer.status_code < 400, (operation, link, answer.text)
    return answer


ORDER = ("create_job", "check_capture", "get_", "list_", "cancel_job", "retry_job", "delete_")
"""Jobs are cancelled before they are retried, and what is deleted is deleted last."""


def rank(name: str) -> int:
    """The place of a link in that order."""
    return next(place for place, start in enumerate(ORDER) if name.startswith(start))


def links_of(target: Target, operation: str, status: int) -> list[dict[str, Any]]:
    """What the answer of an operation leads to."""
    for calls in target.document["paths"].values():
        for call in calls.values():
            if call["operationId"] == operation:
                found = call["responses"][str(status)].get("links", {})
                return sorted(found.values(), key=lambda link: rank(link["operationId"]))
    raise AssertionError(operation)


def test_every_link_leads_where_it_says(served: Service) -> None:
    """From an upload on, along all links of all answers that have any, and each of them works."""
    target = Target.of(served)
    walked: set[tuple[str, str]] = set()

    def walk(operation: str, answer: httpx.Response) -> None:
        made = answer.json()
        for link in links_of(target, operation, answer.status_code):
            named = link["operationId"]
            if (operation, named) in walked:
                continue
            if named == "delete_capture":  # what runs on it has to be over
                for job in served.http.get("/v1/jobs?limit=100").json()["items"]:
                    served.http.post(f"/v1/jobs/{job['id']}/cancel")
            walked.add((operation, named))
            following = follow(target, operation, link, made)
            if following.status_code in (201, 202) and named not in ("cancel_job", "retry_job"):
                walk(named, following)

    for operation in ("create_capture", "create_export"):
        if operation == "create_capture":
            files = {"file": ("photos.zip", zip_of_pictures())}
            answer = served.http.post("/v1/captures", files=files)
        else:
            address = f"/v1/jobs/{target.done['id']}/exports"
            answer = served.http.post(address, json={"kind": "mesh"})
        walk(operation, answer)
    stated = {
        (call["operationId"], link["operationId"])
        for calls in target.document["paths"].values()
        for call in calls.values()
        for one in call["responses"].values()
        for link in one.get("links", {}).values()
    }
    assert stated - walked == set()
