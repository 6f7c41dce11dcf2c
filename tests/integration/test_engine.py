"""Jobs through real workers, a real Redis and real stage processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.keys import stage_prefix
from storage.leases import BACKOFF_FIRST_S
from tests.factories import root_of
from tests.integration.engine import Engine, is_running
from tests.integration.toy_stages import STAGES
from tests.services import RedisServer, running_redis

pytestmark = pytest.mark.services


def slow(engine: Engine, **more: Any) -> dict[str, Any]:
    """A plan of which training takes some seconds, unless somebody is in a hurry."""
    until = {"hurry": str(engine.folder / "hurry")}
    return {"train": {"steps": 60, "step_s": 0.1, "save_every": 5, **until, **more}}


def hurry(engine: Engine) -> None:
    """What is left of it takes no time: all that was to be seen of it has been."""
    (engine.folder / "hurry").touch()


@pytest.fixture
def engine(tmp_path: Path, redis_server: RedisServer) -> Iterator[Engine]:
    made = Engine(tmp_path, redis_server.url)
    yield made
    made.close()


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    folder = tmp_path_factory.mktemp("lasting")
    with running_redis(folder) as redis:
        made = Engine(folder, redis.url)
        made.start_worker()
        yield made
        made.close()


@pytest.fixture
def served(lasting: Engine) -> Iterator[Engine]:
    """A worker that outlives what one test after the other asks of it."""
    lasting.witness.write_text("")
    (lasting.folder / "hurry").unlink(missing_ok=True)
    yield lasting
    (worker,) = lasting.workers
    assert worker.poll() is None


def test_a_job_goes_through_all_stages_once(served: Engine) -> None:
    job_id = served.submit({"mesh": {"spy": True}}, skip=())
    job = served.wait_for(job_id, "succeeded", "failed")
    assert job.state == "succeeded", job.error
    assert [row.attempt for row in job.stages] == [1] * len(STAGES)
    assert len(served.notes("")) == 2 * len(STAGES)
    report = served.stage(job_id, "report")
    assert report.summary == {"steps": 2, "first": 0, "read": ["ingest", "train", "mesh", "video"]}
    assert report.output_prefix is not None
    assert f"{report.output_prefix}manifest.json" in list(served.store.list(report.output_prefix))
    assert f"{report.output_prefix}deep/result ä.txt" in list(served.store.list(root_of(job_id)))
    assert "train step 2" in served.log(job_id, "train")
    pids = {line.split()[-1] for line in served.notes("") if " start " in line}
    assert len(pids) == 1, "one warm process serves all stages of a slot"
    mesh = served.stage(job_id, "mesh")
    spied = json.loads(b"".join(served.store.read(f"{mesh.output_prefix}environment.json")))
    assert not [name for name in spied if "TOKEN" in name or "REDIS" in name or "SECRET" in name]
    served.wait(lambda: not list((served.folder / "home" / "work").iterdir()), 45)


@pytest.mark.parametrize("skip", [("frames",), ("train", "mesh", "video")])
def test_skipped_stages_are_passed_over(served: Engine, skip: tuple[str, ...]) -> None:
    """One in the middle, as a capture skips it; and all that needs training, as a preset does."""
    job = served.wait_for(served.submit({}, skip=skip), "succeeded", "failed")
    assert job.state == "succeeded", job.error
    wanted = {stage.name: "skipped" if stage.name in skip else "succeeded" for stage in STAGES}
    assert {row.name: row.state for row in job.stages} == wanted
    assert {note.split()[0] for note in served.notes("")} == set(wanted) - set(skip)
    report = served.stage(job.id, "report").summary
    assert report is not None
    assert report["read"] == [
        name for name in ("ingest", "train", "mesh", "video") if name not in skip
    ]


def test_an_error_of_the_input_fails_the_job_at_once_with_its_code(served: Engine) -> None:
    job = served.wait_for(served.submit({"frames": {"fail": True}}), "succeeded", "failed")
    assert job.state == "failed"
    assert job.error is not None
    assert (job.error["code"], job.error["stage"]) == ("no_images", "frames")
    assert {row.name: row.state for row in job.stages}["train"] == "cancelled"
    assert len(served.notes("frames start")) == 1
    failed = served.stage(job.id, "frames")
    report = json.loads(b"".join(served.store.read(f"{failed.report_prefix}report.json")))
    assert report["state"] == "failed"
    assert (report["error"]["stage"], report["error"]["code"]) == ("frames", "no_images")
    assert report["failed_report"] == {"said": "The plan says no."}
    assert set(report["timings"]) == {"ingest_s"}


def test_a_fault_of_ours_shows_no_path_but_leaves_its_trace_in_the_log(served: Engine) -> None:
    job = served.wait_for(served.submit({"frames": {"fault": True}}), "succeeded", "failed")
    assert job.error is not None
    assert job.error["code"] == "internal_error"
    assert "/secret" not in json.dumps(job.error)
    assert any("ZeroDivisionError: /secret/path" in line for line in served.log(job.id))


def test_a_retryable_error_is_tried_again(served: Engine) -> None:
    job_id = served.submit({"frames": {"fail_times": 1}})
    assert served.wait_for(job_id, "succeeded", "failed").state == "succeeded"
    assert served.stage(job_id, "frames").attempt == 2
    first, second = served.runs(job_id, "frames")
    assert first.finished_at is not None
    assert (second.started_at - first.finished_at).total_seconds() >= BACKOFF_FIRST_S


@pytest.mark.parametrize(("what", "processes"), [("gpu_lost_times", 2), ("fail_times", 1)])
def test_a_lost_gpu_costs_the_process_and_not_the_job(
    served: Engine, what: str, processes: int
) -> None:
    """A process whose GPU does not answer any more is of no use to the next attempt."""
    job_id = served.submit({"train": {what: 1}})
    served.cut_pause(job_id, "train")
    job = served.wait_for(job_id, "succeeded", "failed")
    assert job.state == "succeeded", job.error
    started = served.notes("train start")
    assert len(started) == 2
    assert len({line.split()[-1] for line in started}) == processes


def test_cancel_stops_a_busy_stage_and_what_it_started(served: Engine) -> None:
    job_id = served.submit({"train": {"steps": 600, "step_s": 0.1, "child": True}})
    served.wait(lambda: served.notes("train child"))
    begun = time.monotonic()
    served.cancel(job_id)
    assert served.wait_for(job_id, "cancelled").finished_at is not None
    assert time.monotonic() - begun < 10
    assert not served.notes("train end")


def test_cancel_kills_a_deaf_stage_within_ten_seconds_with_all_it_started(served: Engine) -> None:
    job_id = served.submit({"train": {"child": True, "deaf_s": 300}})
    served.wait(lambda: served.notes("train child"))
    stage_pid = int(served.notes("train start")[0].split()[-1])
    child_pid = int(served.notes("train child")[0].split()[-1])
    begun = time.monotonic()
    served.cancel(job_id)
    served.wait_for(job_id, "cancelled")
    assert time.monotonic() - begun < 10
    assert not is_running(stage_pid)
    served.wait(lambda: not is_running(child_pid), 5)
    second = served.submit({})
    assert served.wait_for(second, "succeeded", "failed").state == "succeeded"


def test_a_stage_over_its_time_limit_fails(engine: Engine) -> None:
    engine.environment["NERFWORKS_REGISTRY"] = "tests.integration.hasty_stages"
    engine.start_worker()
    job = engine.wait_for(
        engine.submit({"mesh": {"steps": 600, "step_s": 0.1}}), "succeeded", "failed"
    )
    assert job.error is not None
    assert (job.error["code"], job.error["stage"]) == ("time_limit", "mesh")


def test_a_killed_stage_process_resumes_from_its_checkpoint(served: Engine) -> None:
    job_id = served.submit(slow(served))
    served.wait(lambda: served.stage(job_id, "train").checkpoint_prefix)
    os.kill(int(served.notes("train start")[0].split()[-1]), signal.SIGKILL)
    hurry(served)
    job = served.wait_for(job_id, "succeeded", "failed")
    assert job.state == "succeeded", job.error
    train = served.stage(job_id, "train")
    assert train.attempt == 2
    assert served.outcomes(job_id, "train") == ["killed", "succeeded"]
    assert train.summary is not None
    assert train.summary["first"] >= 5
    assert len(served.notes("train resume")) == 1
    assert all(len(served.notes(f"{stage.name} end")) == 1 for stage in STAGES)
    kept = list(served.store.list(stage_prefix(root_of(job_id), "train")))
    assert all(key.startswith(str(train.output_prefix)) for key in kept), "checkpoints are gone"


def test_a_stage_that_crashes_each_time_fails_the_job(served: Engine) -> None:
    job_id = served.submit({"train": {"crash_times": 9}})
    served.cut_pause(job_id, "train")
    job = served.wait_for(job_id, "succeeded", "failed", timeout_s=60)
    assert job.state == "failed"
    assert job.error is not None
    assert job.error["code"] == "worker_lost"
    assert len(served.notes("train start")) == 3
    train = served.stage(job_id, "train")
    report = json.loads(b"".join(served.store.read(f"{train.report_prefix}report.json")))
    assert (report["error"]["code"], report["failed_report"]) == ("worker_lost", None)
    kept = list(served.store.list(stage_prefix(root_of(job_id), "train")))
    assert kept == [f"{train.report_prefix}report.json"], "those of the first two crashes are gone"


def test_a_killed_worker_takes_its_stage_process_along_and_its_next_self_resumes(
    engine: Engine,
) -> None:
    worker = engine.start_worker("w1")
    job_id = engine.submit(slow(engine, child=True))
    engine.wait(lambda: engine.stage(job_id, "train").checkpoint_prefix)
    stage_pid = int(engine.notes("train start")[0].split()[-1])
    child_pid = int(engine.notes("train child")[0].split()[-1])
    worker.kill()
    worker.wait()
    engine.wait(lambda: not is_running(stage_pid) and not is_running(child_pid), 10)
    hurry(engine)
    engine.start_worker("w1")
    job = engine.wait_for(job_id, "succeeded", "failed")
    assert job.state == "succeeded", job.error
    assert len(engine.notes("train resume")) == 1
    assert all(len(engine.notes(f"{stage.name} end")) == 1 for stage in STAGES)


def test_a_deaf_stage_dies_with_its_killed_worker(engine: Engine) -> None:
    worker = engine.start_worker()
    engine.submit({"train": {"child": True, "deaf_s": 300}})
    engine.wait(lambda: engine.notes("train child"))
    stage_pid = int(engine.notes("train start")[0].split()[-1])
    child_pid = int(engine.notes("train child")[0].split()[-1])
    worker.kill()
    worker.wait()
    engine.wait(lambda: not is_running(stage_pid) and not is_running(child_pid), 10)


def test_another_worker_takes_over_when_the_lease_has_run_out(
    tmp_path: Path, redis_server: RedisServer
) -> None:
    engine = Engine(
        tmp_path,
        redis_server.url,
        NERFWORKS_WORKER_LEASE_S="2",
        NERFWORKS_WORKER_HEARTBEAT_S="0.5",
    )
    try:
        first = engine.start_worker("w1")
        job_id = engine.submit(slow(engine))
        engine.wait(lambda: engine.stage(job_id, "train").checkpoint_prefix)
        engine.start_worker("w2")
        first.kill()
        hurry(engine)
        job = engine.wait_for(job_id, "succeeded", "failed")
        assert job.state == "succeeded", job.error
        assert len(engine.notes("train resume")) == 1
        assert engine.outcomes(job_id, "train") == ["lost", "succeeded"]
    finally:
        engine.close()


def test_a_frozen_worker_loses_its_stage_to_another_in_the_same_home(
    tmp_path: Path, redis_server: RedisServer
) -> None:
    """Its stage process goes on, in the folder that the other is to use, until that ends it."""
    engine = Engine(
        tmp_path,
        redis_server.url,
        NERFWORKS_WORKER_LEASE_S="2",
        NERFWORKS_WORKER_HEARTBEAT_S="0.5",
        NERFWORKS_WORKER_PREPARE="false",
    )
    try:
        first = engine.start_worker("w1")
        gate = tmp_path / "go on"
        job_id = engine.submit(slow(engine, until=str(gate), hurry=str(gate)))
        engine.wait(lambda: engine.stage(job_id, "train").checkpoint_prefix)
        stage_pid = int(engine.notes("train start")[0].split()[-1])
        first.send_signal(signal.SIGSTOP)
        engine.start_worker("w2")
        engine.wait(lambda: len(engine.notes("train start")) == 2)
        engine.wait(lambda: not is_running(stage_pid))
        first.send_signal(signal.SIGCONT)
        gate.touch()
        job = engine.wait_for(job_id, "succeeded", "failed")
        assert job.state == "succeeded", job.error
        assert engine.outcomes(job_id, "train") == ["lost", "succeeded"]
        assert len(engine.notes("train end")) == 1
    finally:
        engine.close()


def test_jobs_succeed_though_somebody_deletes_the_folder_of_jobs(engine: Engine) -> None:
    """Between two jobs, and under a stage that runs: its process must be let into the new one."""
    engine.start_worker("w1")
    first = engine.wait_for(engine.submit({}), "succeeded", "failed")
    assert first.state == "succeeded", first.error
    work = engine.folder / "home" / "work"

    def delete() -> None:
        aside = work.rename(
            work.with_name(f"deleted-{time.monotonic_ns()}")
        )  # at once: the worker cleans up there, too
        shutil.rmtree(aside, ignore_errors=True)

    delete()
    go_on = engine.folder / "home" / "cache" / "go on"
    job_id = engine.submit({"train": {"until": str(go_on)}})
    engine.wait(lambda: engine.notes("train start")[1:])
    delete()
    go_on.touch()
    engine.cut_pause(job_id, "train")
    job = engine.wait_for(job_id, "succeeded", "failed", timeout_s=60)
    assert job.state == "succeeded", job.error
    assert engine.outcomes(job_id, "train") == ["error", "succeeded"]
    for stage in STAGES:
        prefix = engine.stage(job_id, stage.name).output_prefix
        assert f"{prefix}deep/result ä.txt" in list(engine.store.list(str(prefix)))


def test_sigterm_gives_the_stage_back_without_counting_and_ends_in_seconds(engine: Engine) -> None:
    worker = engine.start_worker("w1")
    job_id = engine.submit(slow(engine, save_every=0, save_at_shutdown=True))
    engine.wait(lambda: engine.stage(job_id, "train").progress > 0.1)
    assert engine.stage(job_id, "train").checkpoint_prefix is None
    begun = time.monotonic()
    worker.terminate()
    worker.wait(20)
    assert time.monotonic() - begun < 10
    train = engine.stage(job_id, "train")
    assert (train.state, train.attempt) == ("ready", 0)
    assert engine.outcomes(job_id, "train") == ["released"]
    assert train.checkpoint_prefix is not None
    hurry(engine)
    engine.start_worker("w2")
    assert engine.wait_for(job_id, "succeeded", "failed").state == "succeeded"
    assert len(engine.notes("train resume")) == 1


def test_duplicate_messages_start_nothing_twice(engine: Engine) -> None:
    job_id = engine.submit({"train": {"steps": 10, "step_s": 0.1}})
    for _ in range(5):
        for stage in STAGES:
            engine.bell.ring([f"{job_id}-{stage.name}"])
        assert engine.bell.flush(10)
    engine.start_worker("w1", "--slots", "2")
    engine.start_worker("w2")
    assert engine.wait_for(job_id, "succeeded", "failed").state == "succeeded"
    time.sleep(1.5)
    assert all(len(engine.notes(f"{stage.name} start")) == 1 for stage in STAGES)


def test_a_job_that_was_never_rung_for_is_found(served: Engine) -> None:
    job_id = served.submit({}, ring=False)
    assert served.wait_for(job_id, "succeeded", "failed").state == "succeeded"


def test_work_goes_on_while_redis_is_gone(engine: Engine, redis_server: RedisServer) -> None:
    engine.environment["NERFWORKS_WORKER_DIRECT_AFTER_S"] = "2"
    engine.start_worker()
    engine.wait_for(engine.submit({}), "succeeded")
    redis_server.kill()
    job_id = engine.submit({"train": {"steps": 5, "step_s": 0.1}})
    assert engine.wait_for(job_id, "succeeded", "failed", timeout_s=60).state == "succeeded"


@pytest.mark.parametrize(
    ("setting", "refuses", "takes"), [("maxmemory", "1", "0"), ("min-replicas-to-write", "1", "0")]
)
def test_a_redis_that_refuses_to_write_costs_no_worker_and_no_attempt(
    engine: Engine, redis_server: RedisServer, setting: str, refuses: str, takes: str
) -> None:
    """Full, or as one whose disk is full or whose replicas are gone: it refuses what writes, and
    taking a message does."""
    worker = engine.start_worker()
    job_id = engine.submit({"train": {"steps": 40, "step_s": 0.1}})
    engine.wait(lambda: engine.stage(job_id, "train").progress > 0)
    redis_server.configure(setting, refuses)
    beside = engine.submit({})
    job = engine.wait_for(job_id, "succeeded", "failed")
    assert job.state == "succeeded", job.error
    assert engine.outcomes(job_id, "train") == ["succeeded"]
    assert engine.wait_for(beside, "succeeded", "failed", timeout_s=60).state == "succeeded"
    redis_server.configure(setting, takes)
    later = engine.submit({})
    assert engine.wait_for(later, "succeeded", "failed").state == "succeeded"
    assert worker.poll() is None


def test_a_worker_hears_the_bell_again_after_redis_was_killed_and_started(
    engine: Engine, redis_server: RedisServer
) -> None:
    """Redis is away when a message is acknowledged, which deafens Celery: one job comes late."""
    engine.start_worker()
    for _ in range(2):
        last = engine.submit({"report": {"steps": 5, "step_s": 0.1}})

        def is_running(job: str = last) -> bool:
            return engine.stage(job, "report").state == "running"

        engine.wait(is_running)
        redis_server.kill()
        assert engine.wait_for(last, "succeeded", "failed").state == "succeeded"
        time.sleep(0.5)
        redis_server.start()
    time.sleep(3)
    late = engine.submit({})
    assert engine.wait_for(late, "succeeded", "failed", timeout_s=20).state == "succeeded"
    heard = engine.submit({})
    assert engine.wait_for(heard, "succeeded", "failed").state == "succeeded"
    first = engine.stage(heard, "ingest")
    assert first.started_at is not None
    assert first.ready_at is not None
    assert (first.started_at - first.ready_at).total_seconds() < 3.0


def test_training_goes_on_while_redis_is_killed_and_started(
    engine: Engine, redis_server: RedisServer
) -> None:
    engine.start_worker()
    busy = engine.submit(slow(engine))
    engine.wait(lambda: engine.notes("train start"))
    redis_server.kill()
    before = engine.stage(busy, "train").progress
    time.sleep(2)
    assert engine.stage(busy, "train").progress > before
    redis_server.start()
    hurry(engine)
    assert engine.wait_for(busy, "succeeded", "failed").state == "succeeded"
    assert all(len(engine.notes(f"{stage.name} start")) == 1 for stage in STAGES)
