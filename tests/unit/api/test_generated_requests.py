"""Requests made from the OpenAPI document, right ones and wrong ones, at real jobs and at none.

Whatever comes is answered as documented, and never 5xx. NUL and lone surrogates are among the
values. The seed is fixed, so that a failure comes again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
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

from tests.unit.api.conftest import Service, finish_job, serving, settings_for

EXAMPLES = 9
JSON = {"Content-Type": "application/json"}
POSTGRESQL = pytest.param("postgresql", marks=pytest.mark.services)
ODD = st.sampled_from(["\0", "\ud800", "a\0b", "\udfff\ud800", "ä", "\U0001f419", "%00", "'", ""])


@pytest.fixture(scope="module", params=["sqlite", POSTGRESQL])
def running(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Service]:
    """A service on either database."""
    url = "" if request.param == "sqlite" else request.getfixturevalue("postgres_module_url")
    home = tmp_path_factory.mktemp("generated")
    with serving(settings_for(home, database_url=url, check_timeout_s=0.2)) as service:
        yield service


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


def test_generated_requests_are_answered_as_documented(running: Service) -> None:
    load_all_checks()
    document = running.anyone.get("/openapi.json").json()
    schema = schemathesis.openapi.from_dict(document)
    schema.config.generation.update(modes=[GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
    done = running.job(labels={"a": "b"})
    finish_job(running.services, done["id"], lambda _: b"content")
    statuses: set[int] = set()
    operations = [
        found.ok() for found in schema.get_all_operations() if isinstance(found, result.Ok)
    ]
    assert len(operations) > 15
    for operation in operations:

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
            if draw(st.booleans()):  # a job, a capture, an artifact that there is
                real = {"job_id": done["id"], "capture_id": done["capture_id"], "name": "mesh.glb"}
                case.path_parameters = {
                    name: real.get(name, value) for name, value in case.path_parameters.items()
                }
                if case.path == "/v1/jobs" and case.method == "POST":
                    case.body = {"capture_id": done["capture_id"], "labels": {"a": "b"}}
                if case.method == "DELETE":
                    case.path_parameters = {
                        name: running.job()["id"] if name == "job_id" else running.upload()["id"]
                        for name in case.path_parameters
                    }
            if case.media_type == "application/json" and draw(st.booleans()):
                # By hand: schemathesis itself cannot hold half of a surrogate pair.
                body = None if isinstance(case.body, NotSet) else with_odd_text(case.body, draw)
                content = json.dumps(body)
                path = case.formatted_path
                odd = running.http.request(case.method, path, content=content, headers=JSON)
                statuses.add(odd.status_code)
                assert odd.status_code < 500, odd.text
                listed = document["paths"][case.path][case.method.lower()]["responses"]
                assert str(odd.status_code) in listed, (odd.status_code, odd.text)
                return
            answer = case.call(
                base_url=str(running.http.base_url), headers=dict(running.http.headers), timeout=20
            )
            statuses.add(answer.status_code)
            assert answer.status_code < 500 or case.path == "/readyz", answer.text
            checks = [content_type_conformance, response_schema_conformance]
            if answer.status_code not in (404, 405):  # an address that is no longer this call's
                checks.append(status_code_conformance)
            case.validate_response(answer, checks=checks)

        run()
    assert {200, 202, 204, 404, 422} <= statuses, statuses
