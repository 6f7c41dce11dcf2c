"""Processes that stop and go on (SIGSTOP, SIGCONT): a machine that sleeps, a Redis that hangs; and
two workers that were started under one id."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from storage.records import live_workers
from tests.histories import check_history
from tests.integration.engine import Engine, with_descendants
from tests.integration.toy_stages import STAGES
from tests.services import RedisServer

pytestmark = pytest.mark.services
SLEEPS = 5
LEASE_S = 3.0


@contextmanager
def engine_at(folder: Path, redis: RedisServer, **environment: str) -> Iterator[Engine]:
    made = Engine(folder, redis.url, NERFWORKS_WORKER_PREPARE="false", **environment)
    try:
        yield made
    finally:
        made.close()


@contextmanager
def asleep(*pids: int) -> Iterator[None]:
    """The processes, and all that they started, stand still while the block runs."""
    frozen = with_descendants(*pids)
    for pid in frozen:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in frozen:
            os.kill(pid, signal.SIGCONT)


def test_a_job_succeeds_though_the_machine_sleeps_five_times(
    tmp_path: Path, redis_server: RedisServer
) -> None:
    """Longer than a lease each time, without a checkpoint between, with a second worker that has
    nothing to do: five leases lost would fail the job for good."""
    gate = tmp_path / "go on"
    times = {"LEASE_S": str(LEASE_S), "HEARTBEAT_S": "0.5"}
    environment = {f"NERFWORKS_WORKER_{name}": value for name, value in times.items()}
    with engine_at(tmp_path, redis_server, **environment) as engine:
        workers = [engine.start_worker(name) for name in ("w1", "w2")]
        assert redis_server.process is not None
        machine = [*(worker.pid for worker in workers), redis_server.process.pid]
        job = engine.submit({"train": {"until": str(gate)}}, skip=("mesh", "video"))
        engine.wait(lambda: engine.notes("train start"), 120)
        for _ in range(SLEEPS):
            with asleep(*machine):
                time.sleep(LEASE_S + 1.0)
            awake = engine.stage(job, "train").heartbeat_at
            engine.wait(lambda: engine.stage(job, "train").heartbeat_at != awake)  # noqa: B023
        gate.touch()
        found = engine.wait_for(job, "succeeded", "failed")
        assert found.state == "succeeded", found.error
        for name in ("ingest", "frames", "train", "report"):
            assert engine.outcomes(job, name) == ["succeeded"]
            assert len(engine.notes(f"{name} end")) == 1
        with engine.database.read_scope() as session:
            check_history(session, job)


def test_two_workers_started_with_one_id_both_work_and_rob_nobody(
    tmp_path: Path, redis_server: RedisServer
) -> None:
    gate = tmp_path / "go on"
    with engine_at(tmp_path, redis_server) as engine:
        for _ in range(2):
            engine.start_worker("w")
        jobs = [engine.submit({"train": {"until": str(gate)}}) for _ in range(2)]
        engine.wait(lambda: len(engine.notes("train start")) == 2, 120)
        third = engine.start_worker("w")  # as if somebody had forgotten the others

        def ids() -> list[str]:
            with engine.database.read_scope() as session:
                return [worker.id for worker in live_workers(session)]

        engine.wait(lambda: len(ids()) == 3, 120)
        assert sum(name == "w" for name in ids()) == 1
        assert all(name == "w" or name.startswith("w-") for name in ids())
        third.kill()
        gate.touch()
        for job in jobs:
            found = engine.wait_for(job, "succeeded", "failed")
            assert found.state == "succeeded", found.error
            for stage in STAGES:
                assert engine.outcomes(job, stage.name) == ["succeeded"]


def test_work_goes_on_beside_a_redis_that_is_frozen(
    tmp_path: Path, redis_server: RedisServer
) -> None:
    """It accepts, and never answers: nobody waits for it, a cancel is obeyed, leases are kept; and
    when it goes on, so does the bell."""
    with engine_at(tmp_path, redis_server, NERFWORKS_WORKER_LEASE_S="10") as engine:
        engine.start_worker()
        engine.wait_for(engine.submit({}), "succeeded")
        assert redis_server.process is not None
        with asleep(redis_server.process.pid):
            begun = time.monotonic()
            found = engine.submit({"train": {"steps": 120, "step_s": 0.1}})
            assert time.monotonic() - begun < 2.0
            assert engine.wait_for(found, "succeeded", "failed", timeout_s=90).state == "succeeded"
            assert engine.outcomes(found, "train") == ["succeeded"]
            busy = engine.submit({"train": {"until": str(tmp_path / "never")}})
            engine.wait(lambda: len(engine.notes("train start")) == 3)
            begun = time.monotonic()
            engine.cancel(busy)
            engine.wait_for(busy, "cancelled")
            assert time.monotonic() - begun < 10

        def hears() -> bool:
            heard = engine.submit({})
            assert engine.wait_for(heard, "succeeded", "failed").state == "succeeded"
            first = engine.stage(heard, "ingest")
            assert first.started_at is not None
            assert first.ready_at is not None
            return (first.started_at - first.ready_at).total_seconds() < 3.0

        engine.wait(hears, 60)
