"""A whole job on what a cluster uses: PostgreSQL, an S3 server and Redis, presigned downloads."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from api.client.client import Client
from deploy.embedded import Embedded, free_port
from pipelines.option_models import merge
from tests.capture_writers import write_polycam
from tests.e2e.waiting import succeeded
from tests.samples import PLAIN, SMALL
from tests.services import RedisServer, S3Endpoint

pytestmark = [pytest.mark.services, pytest.mark.slow, pytest.mark.timeout(700)]


def test_polycam_export_goes_through_on_postgresql_s3_and_redis(
    postgres_url: str,
    s3_endpoint: S3Endpoint,
    redis_server: RedisServer,
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in {
        "NERFWORKS_DATABASE_URL": postgres_url,
        "NERFWORKS_REDIS_URL": redis_server.url,
        **s3_endpoint.environment(),
    }.items():
        monkeypatch.setenv(name, value)
    archive = tmp_path / "polycam.zip"
    write_polycam(archive, num=24, width=480)
    options = merge(merge(SMALL, PLAIN), {"train": {"max_steps": 250}})

    embedded = Embedded.at(tmp_path / "home", "127.0.0.1", free_port(), cache)
    supervisor = embedded.supervisor(print)
    assert [program.name for program in supervisor.programs] == ["api", "worker"]
    supervisor.start()
    try:
        with Client(embedded.url, embedded.secrets.api_key) as client:
            capture = client.upload(archive)
            assert capture.kind == "polycam"
            job = client.create_job(capture.id, preset="preview", options=options)
            job = succeeded(client, embedded, job.id, 540)
            states = {stage.name: stage.state for stage in job.stages}
            assert (states["frames"], states["poses"]) == ("skipped", "succeeded")
            for artifact in client.artifacts(job.id):
                assert "X-Amz-Signature" in artifact.url
            client.download(job.id, tmp_path / "out")
            client.delete_job(job.id)
            client.delete_capture(capture.id)
    finally:
        supervisor.stop()
    report = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))
    assert report["capture"]["kind"] == "polycam"
    assert report["metrics"]["psnr"] >= 17.0
    left = [path for path in s3_endpoint.folder.rglob("*") if path.is_file()]
    assert not left, f"bytes are left after the deletes: {left}"
