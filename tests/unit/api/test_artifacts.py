"""Downloads: ranges, conditions, signed URLs, and headers that cannot be fooled."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from api.artifacts.ranges import parse_range, tag_listed
from api.problems import BadRangeError
from pipelines.options import ON_REQUEST
from pipelines.registry import STAGES
from storage.claims import claim_stage
from storage.jobs import stage_id
from storage.keys import attempt_prefix
from storage.leases import FailureReport, fail_stage
from storage.signed_urls import SignedObject, make_object_token
from tests.factories import root_of
from tests.unit.api.conftest import Service, finish_job, problem, serving, settings_for

CONTENT = bytes(range(256)) * 40
DIGEST = hashlib.sha256(CONTENT).hexdigest()
TAG = f'"{DIGEST}"'


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, str]]:
    """A service with a finished job: (service, path of its artifacts)."""
    with serving(settings_for(tmp_path_factory.mktemp("home"))) as service:
        job = service.job()
        finish_job(service.services, job["id"], lambda name: CONTENT)
        yield service, f"/v1/jobs/{job['id']}/artifacts"


def get(
    done: tuple[Service, str], name: str = "mesh.glb", method: str = "GET", **headers: str
) -> httpx.Response:
    service, path = done
    sent = {key.replace("_", "-"): value for key, value in headers.items()}
    return service.http.request(method, f"{path}/{name}", headers=sent)


def test_list_names_every_artifact_of_the_registry(done: tuple[Service, str]) -> None:
    service, path = done
    items = service.http.get(path).json()["items"]
    made = [stage for stage in STAGES if stage.name not in ON_REQUEST]
    declared = [artifact for stage in made for artifact in stage.artifacts]
    assert [item["name"] for item in items] == [artifact.name for artifact in declared]
    for item, artifact in zip(items, declared, strict=True):
        assert set(item) == {"name", "media_type", "bytes", "sha256", "url", "opens_with"}
        assert item["media_type"] == artifact.media_type
        assert (item["bytes"], item["sha256"]) == (len(CONTENT), DIGEST)


def test_the_report_of_a_job_that_failed_can_be_downloaded(tmp_path: Path) -> None:
    with serving(settings_for(tmp_path)) as service:
        job_id = service.job()["id"]
        prefix = attempt_prefix(root_of(job_id), "ingest", 1, 1)
        source = tmp_path / "report"
        source.write_bytes(CONTENT)
        service.services.store.put_file(f"{prefix}report.json", source)
        with service.services.database.session_scope() as session:
            claim = claim_stage(session, stage_id(job_id, "ingest"), "test", 60.0)
            assert claim is not None
            error = {"code": "no_images", "message": "None.", "hint": "Send some."}
            entry = {"path": "report.json", "bytes": len(CONTENT), "sha256": DIGEST}
            said = FailureReport(prefix, [entry])
            assert fail_stage(session, claim, error, retryable=False, report=said) == "failed"
        answer = service.http.get(f"/v1/jobs/{job_id}/artifacts/report.json")
        assert (answer.status_code, answer.content) == (200, CONTENT)
        assert answer.headers["content-type"] == "application/json"
        (listed,) = service.http.get(f"/v1/jobs/{job_id}").json()["artifacts"]
        assert (listed["name"], listed["sha256"]) == ("report.json", DIGEST)


def test_whole_content_with_its_headers(done: tuple[Service, str]) -> None:
    answer = get(done)
    assert (answer.status_code, answer.content) == (200, CONTENT)
    assert answer.headers["content-type"] == "model/gltf-binary"
    assert answer.headers["content-length"] == str(len(CONTENT))
    assert answer.headers["accept-ranges"] == "bytes"
    assert answer.headers["etag"] == TAG
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["content-disposition"].startswith('attachment; filename="mesh.glb"')


def test_head_gives_the_headers_alone(done: tuple[Service, str]) -> None:
    answer = get(done, method="HEAD", Range="bytes=0-1")
    assert (answer.status_code, answer.content) == (200, b"")
    assert answer.headers["content-length"] == str(len(CONTENT))
    assert answer.headers["etag"] == TAG


@pytest.mark.parametrize(
    ("header", "first", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=100-199", 100, 200),
        ("bytes=10000-", 10000, len(CONTENT)),
        ("bytes=-5", len(CONTENT) - 5, len(CONTENT)),
        ("bytes=0-999999", 0, len(CONTENT)),
        ("bytes=-999999", 0, len(CONTENT)),
    ],
)
def test_range_is_answered_in_part(
    done: tuple[Service, str], header: str, first: int, stop: int
) -> None:
    answer = get(done, Range=header)
    assert (answer.status_code, answer.content) == (206, CONTENT[first:stop])
    assert answer.headers["content-range"] == f"bytes {first}-{stop - 1}/{len(CONTENT)}"
    assert answer.headers["content-length"] == str(stop - first)


@pytest.mark.parametrize("header", ["bytes=0-1,5-6", "lines=0-1", "bytes=abc", "bytes=5-2", "x"])
def test_range_that_is_not_understood_is_answered_whole(
    done: tuple[Service, str], header: str
) -> None:
    answer = get(done, Range=header)
    assert (answer.status_code, answer.content) == (200, CONTENT)


@pytest.mark.parametrize("header", [f"bytes={len(CONTENT)}-", "bytes=-0", "bytes=99999999-"])
def test_range_outside_is_refused_with_the_size(done: tuple[Service, str], header: str) -> None:
    answer = get(done, Range=header)
    problem(answer, 416, "range_unsatisfiable")
    assert answer.headers["content-range"] == f"bytes */{len(CONTENT)}"


def test_if_range_decides_whether_the_range_counts(done: tuple[Service, str]) -> None:
    assert get(done, Range="bytes=0-1", If_Range=TAG).status_code == 206
    assert get(done, Range="bytes=0-1", If_Range='"other"').content == CONTENT
    assert get(done, Range="bytes=0-1", If_Range=f"W/{TAG}").content == CONTENT


@pytest.mark.parametrize("header", [TAG, f"W/{TAG}", f'"other", {TAG}', "*"])
def test_known_content_is_not_sent_again(done: tuple[Service, str], header: str) -> None:
    answer = get(done, If_None_Match=header)
    assert (answer.status_code, answer.content) == (304, b"")
    assert answer.headers["etag"] == TAG


def test_other_content_is_sent_though_a_tag_is_given(done: tuple[Service, str]) -> None:
    assert get(done, If_None_Match='"other"').content == CONTENT


def test_signed_url_needs_no_key_and_takes_ranges(done: tuple[Service, str]) -> None:
    service, path = done
    for item in service.http.get(path).json()["items"]:
        answer = service.anyone.get(item["url"])
        assert (answer.status_code, answer.content) == (200, CONTENT)
        assert answer.headers["content-type"] == item["media_type"]
        assert item["name"] in answer.headers["content-disposition"]
        part = service.anyone.get(item["url"], headers={"Range": "bytes=5-9"})
        assert (part.status_code, part.content) == (206, CONTENT[5:10])
        same = service.anyone.get(item["url"], headers={"If-None-Match": answer.headers["etag"]})
        assert same.status_code == 304


def test_a_download_goes_on_at_the_other_address(done: tuple[Service, str]) -> None:
    """Its tag is the same at both."""
    service, path = done
    item = next(each for each in service.http.get(path).json()["items"] if each["bytes"] > 9)
    for url in (f"{path}/{item['name']}", item["url"]):
        answer = service.http.get(url, headers={"Range": "bytes=5-9", "If-Range": TAG})
        assert (answer.status_code, answer.headers["etag"]) == (206, TAG)
    signed = SignedObject("captures/x", "x", "text/plain", 2**40)
    assert signed.sha256 == "", "as of URLs that versions before signed"


def test_signed_url_goes_to_the_address_that_the_client_came_by(
    done: tuple[Service, str],
) -> None:
    service, path = done
    answer = service.http.get(path, headers={"Host": "phone.example:9000"})
    assert urlsplit(answer.json()["items"][0]["url"]).netloc == "phone.example:9000"


def test_signed_url_that_is_forged_or_stale_is_refused(done: tuple[Service, str]) -> None:
    service, path = done
    url = service.http.get(path).json()["items"][0]["url"]
    problem(service.anyone.get(url + "x"), 403, "url_invalid")
    problem(service.anyone.get("/v1/objects/garbage"), 403, "url_invalid")
    key = service.services.settings.signing_key()
    stale = SignedObject("captures/x/content", "x", "text/plain", int(time.time()) - 5)
    problem(service.anyone.get(f"/v1/objects/{make_object_token(key, stale)}"), 403, "url_invalid")
    gone = SignedObject("captures/x/content", "x", "text/plain", int(time.time()) + 60)
    answer = service.anyone.get(f"/v1/objects/{make_object_token(key, gone)}")
    problem(answer, 404, "object_not_found")


@pytest.mark.parametrize("name", ["other.txt", "..%2f..%2fsecrets.json", "mesh.glb%00"])
def test_unknown_artifact_is_not_found(done: tuple[Service, str], name: str) -> None:
    answer = get(done, name)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_artifact_before_its_stage_is_not_found_with_a_hint(service: Service) -> None:
    job = service.job()
    answer = service.http.get(f"/v1/jobs/{job['id']}/artifacts/mesh.glb")
    assert "queued" in problem(answer, 404, "artifact_not_found")["hint"]
    assert service.http.get(f"/v1/jobs/{job['id']}/artifacts").json() == {"items": []}


def test_bytes_that_are_gone_are_a_problem_not_a_broken_answer(service: Service) -> None:
    job = service.job()
    finish_job(service.services, job["id"], lambda name: CONTENT)
    for path in service.objects():
        path.unlink()
    answer = service.http.get(f"/v1/jobs/{job['id']}/artifacts/mesh.glb")
    problem(answer, 404, "object_not_found")


@given(
    header=st.from_regex(r"bytes=\d{0,25}-\d{0,25}", fullmatch=True) | st.text(max_size=20),
    size=st.integers(0, 10**6),
)
def test_range_lies_inside_whatever_is_asked(header: str, size: int) -> None:
    try:
        part = parse_range(header, size, None, TAG)
    except BadRangeError:
        return
    assert part is None or (0 <= part.start < part.stop <= size)


def test_tags_are_compared_as_a_list() -> None:
    assert tag_listed(' "a" , W/"b"', '"b"')
    assert not tag_listed('"a"', '"b"')
