"""Slots: which stages run side by side, and with how many threads.

Real stage processes and a real database; no broker.
"""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from deploy.embedded import free_port
from storage.claims import claim_stage
from storage.jobs import stage_id
from storage.leases import owner_name
from storage.models import Capture, Job, StageRow
from storage.queries import list_events
from storage.records import live_workers, register_worker
from tests.integration import toy_stages
from tests.integration.engine import Engine, is_running
from worker.__main__ import MANY_CORES, default_slots, parse_arguments
from worker.pulse import Pulse
from worker.runtime import WorkerIdentity, WorkerRuntime
from worker.settings import WorkerSettings

TOYS = "tests.integration.toy_stages"
ENDS = ("succeeded", "failed")
LONG_S = 180.0
"""Far longer than anything here takes: a loaded machine must not decide a test."""
SECOND = {"steps": 10, "step_s": 0.15}


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    made = Engine(tmp_path, f"redis://127.0.0.1:{free_port()}/0")
    yield made
    made.close()


@contextmanager
def workers(engine: Engine, *identities: WorkerIdentity) -> Iterator[list[WorkerRuntime]]:
    """Workers in this process. Nobody rings: their housekeeping finds what is ready."""
    settings = WorkerSettings(tick_s=0.1, direct_after_s=0.0, ring_again_s=600.0, clean_s=600.0)
    made = [
        WorkerRuntime(identity, engine.settings, settings, registry=TOYS) for identity in identities
    ]
    for runtime in made:
        runtime.start()
    try:
        yield made
    finally:
        for runtime in made:
            runtime.close()


def span(row: StageRow) -> tuple[datetime, datetime]:
    assert row.started_at is not None
    assert row.finished_at is not None
    return row.started_at, row.finished_at


def overlap(one: StageRow, other: StageRow) -> bool:
    (a, b), (c, d) = span(one), span(other)
    return max(a, c) < min(b, d)


class Gates:
    """Files that toy stages wait for before they end, so that no test waits for a clock."""

    def __init__(self, engine: Engine) -> None:
        self._folder = engine.witness.parent  # which a contained stage can read

    def plan(self, name: str) -> dict[str, str]:
        """Of a stage that ends once the gate of that name is open."""
        return {"until": str(self._folder / name)}

    def open(self, name: str) -> None:
        (self._folder / name).touch()


def wait_until_running(engine: Engine, *stages: tuple[str, str]) -> None:
    """Until stages, (job, name), run at one moment."""

    def states() -> set[str]:
        with engine.database.read_scope() as session:  # one transaction: one moment
            found = {row.id: row.state for row in session.scalars(select(StageRow))}
        return {found[stage_id(job, name)] for job, name in stages}

    engine.wait(lambda: states() == {"running"}, LONG_S)


def check_overlap(engine: Engine, *identities: WorkerIdentity) -> None:
    """One job trains while the frames of the next are made; the GPU is for one training."""
    gates = Gates(engine)
    first = engine.submit({"train": gates.plan("trained")}, ring=False)
    second = engine.submit({"frames": gates.plan("framed")}, ring=False)
    with workers(engine, *identities):
        wait_until_running(engine, (first, "train"), (second, "frames"))
        gates.open("framed")
        engine.wait(lambda: engine.stage(second, "train").state != "blocked", LONG_S)
        # What comes later is taken and done: who took it has passed over the second training.
        third = engine.submit({}, skip=("train", "mesh", "video"), ring=False)
        assert engine.wait_for(third, *ENDS, timeout_s=LONG_S).state == "succeeded"
        assert engine.stage(first, "train").state == "running"
        assert engine.stage(second, "train").state == "ready"
        gates.open("trained")
        for job in (first, second):
            assert engine.wait_for(job, *ENDS, timeout_s=LONG_S).state == "succeeded"
    assert overlap(engine.stage(first, "train"), engine.stage(second, "frames"))
    assert not overlap(engine.stage(first, "train"), engine.stage(second, "train"))


def test_a_gpu_worker_trains_one_job_while_a_cpu_worker_prepares_the_next(engine: Engine) -> None:
    gpu = WorkerIdentity("gpu", 1, ("gpu",), True)
    check_overlap(engine, gpu, WorkerIdentity("cpu", 1, ("cpu", "light"), False))


def test_two_slots_beside_one_gpu_do_the_same_and_share_the_gpu_with_nobody(
    engine: Engine,
) -> None:
    check_overlap(engine, WorkerIdentity("both", 2, ("cpu", "gpu", "light"), True))


def test_stages_of_one_job_that_wait_for_the_same_run_side_by_side_in_two_slots(
    engine: Engine,
) -> None:
    gates = Gates(engine)
    job = engine.submit({"mesh": gates.plan("both"), "video": gates.plan("both")}, ring=False)
    with workers(engine, WorkerIdentity("w", 2, ("cpu", "light"), False)):
        wait_until_running(engine, (job, "mesh"), (job, "video"))
        gates.open("both")
        assert engine.wait_for(job, *ENDS, timeout_s=LONG_S).state == "succeeded"


def test_what_holds_a_workers_stages_in_is_on_record(engine: Engine) -> None:
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)):
        deadline = time.monotonic() + 60.0
        while True:
            with engine.database.read_scope() as session:
                (row,) = live_workers(session)
            if row.contained is not None:
                break
            assert time.monotonic() < deadline, "the stage process said hello to nobody"
            time.sleep(0.05)
    assert "environment" in row.contained["on"]
    assert any(one.startswith("limits of") for one in row.contained["on"])
    assert set(row.contained) == {"on", "lacks"}


def test_a_stage_alone_has_all_cores(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.runtime.num_cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    job = engine.submit({"train": {"spy": True}}, ring=False)
    with workers(engine, WorkerIdentity("w", 2, ("cpu", "light"), False)):
        assert engine.wait_for(job, "succeeded", "failed").state == "succeeded"
    prefix = engine.stage(job, "train").output_prefix
    spied = json.loads(b"".join(engine.store.read(f"{prefix}environment.json")))
    assert spied["OMP_NUM_THREADS"] == "8"
    assert spied["OMP_WAIT_POLICY"] == "passive"


def test_busy_slots_share_the_cores(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.runtime.num_cores", lambda: 8)
    identity = WorkerIdentity("w", 4, ("cpu",), False)
    settings = WorkerSettings(prepare=False)
    runtime = WorkerRuntime(identity, engine.settings, settings, registry=TOYS)
    runtime.start()
    try:
        found = []
        for stage in range(4):
            runtime._running.add(str(stage))
            found.append(runtime._threads_now())
        assert found == [8, 4, 2, 2]
    finally:
        runtime.close()


def test_a_slot_that_looks_for_work_takes_no_cores(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a lone job trains on half of them, if the other slot's query happens to be slow."""
    monkeypatch.setattr("worker.runtime.num_cores", lambda: 8)
    identity = WorkerIdentity("w", 2, ("cpu",), False)
    settings = WorkerSettings(prepare=False)
    runtime = WorkerRuntime(identity, engine.settings, settings, registry=TOYS)
    runtime.start()
    looked = []
    monkeypatch.setattr(runtime, "_take", lambda *_: looked.append(runtime._threads_now()))
    try:
        runtime._running.add("the other slot's")
        runtime.serve()
        assert looked == [8]
    finally:
        runtime.close()


def test_a_worker_chooses_a_second_slot_where_it_pays() -> None:
    assert default_slots(has_gpu=False, cores=2) == 1
    assert default_slots(has_gpu=False, cores=MANY_CORES) == 2
    assert default_slots(has_gpu=True, cores=2) == 2
    assert parse_arguments([]).slots is None
    assert parse_arguments(["--slots", "3"]).slots == 3


def test_timings_of_a_stage_cover_its_claim(engine: Engine) -> None:
    job = engine.submit({"train": SECOND}, ring=False)
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)):
        assert engine.wait_for(job, "succeeded", "failed").state == "succeeded"
    row = engine.stage(job, "train")
    assert row.manifest is not None
    timings = row.manifest["timings"]
    begun, ended = span(row)
    parts = sum(timings[name] for name in ("fetch_s", "start_s", "run_s", "store_s"))
    assert timings["load_s"] + timings["compile_s"] <= timings["wall_s"] <= timings["run_s"]
    assert timings["run_s"] >= SECOND["steps"] * SECOND["step_s"]
    assert 0.0 < parts <= (ended - begun).total_seconds() + 0.01


@pytest.mark.parametrize("lives", [True, False])
def test_only_a_former_self_that_is_dead_is_robbed(engine: Engine, lives: bool) -> None:
    """A second worker that is started under the id of one that lives goes on under its own."""
    job = engine.submit({}, ring=False)
    first = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        with engine.database.session_scope() as session:
            register_worker(
                session,
                "w",
                hostname=socket.gethostname(),
                pid=first.pid,
                boot="first",
                queues=["cpu"],
                slots=1,
                has_gpu=False,
            )
            owner = owner_name("w", "first")
            assert claim_stage(session, stage_id(job, "ingest"), owner, 60.0) is not None
        if not lives:
            first.kill()  # and nobody has buried it yet
            engine.wait(lambda: not is_running(first.pid), 10)
        settings = WorkerSettings(prepare=False, tick_s=60.0, direct_after_s=60.0)
        identity = WorkerIdentity("w", 1, ("cpu",), False)
        runtime = WorkerRuntime(identity, engine.settings, settings, registry=TOYS)
        runtime.start()
        try:
            assert runtime.identity.id == ("w-" + identity.boot if lives else "w")
            assert engine.stage(job, "ingest").state == ("running" if lives else "ready")
            assert engine.outcomes(job, "ingest") == [None if lives else "lost"]
        finally:
            runtime.close()
        with engine.database.read_scope() as session:
            assert [row.id for row in live_workers(session)] == (["w"] if lives else [])
    finally:
        first.kill()
        first.wait()


def test_a_worker_whose_place_was_taken_while_it_slept_goes_on_under_another_id(
    engine: Engine,
) -> None:
    settings = WorkerSettings(prepare=False, tick_s=0.1, direct_after_s=60.0)
    identity = WorkerIdentity("w", 1, ("cpu",), False)
    runtime = WorkerRuntime(identity, engine.settings, settings, registry=TOYS)
    runtime.start()
    try:
        newer = {"queues": ["cpu"], "slots": 1, "has_gpu": False}
        with engine.database.session_scope() as session:
            register_worker(
                session,
                "w",
                hostname="far",
                pid=1,
                boot="newer",
                take_over=True,
                **newer,  # type: ignore[arg-type]
            )
        mine = f"w-{identity.boot}"

        def workers_now() -> dict[str, str]:
            with engine.database.read_scope() as session:
                return {row.id: row.boot for row in live_workers(session)}

        engine.wait(lambda: workers_now() == {"w": "newer", mine: identity.boot}, 10)
    finally:
        runtime.close()


@pytest.mark.parametrize(
    ("times", "at", "stall_s", "ends"),
    [(1, 1.0, 10.0, "succeeded"), (2, 0.1, 1.5, "failed")],
    ids=["flood", "drip"],
)
def test_a_stage_that_hangs_is_ended_once_and_then_fails_the_job(
    engine: Engine,
    monkeypatch: pytest.MonkeyPatch,
    times: int,
    at: float,
    stall_s: float,
    ends: str,
) -> None:
    """It is alive and reports, always the same; what is done is told without a pause between.

    Who is to succeed has the time that a new process takes to start.
    """
    video = replace(toy_stages.get_stage("video"), stall_s=stall_s)
    stages = (video if stage.name == "video" else stage for stage in toy_stages.STAGES)
    monkeypatch.setattr(toy_stages, "STAGES", tuple(stages))
    job = engine.submit({"video": {"hang_times": times, "hang_at": at}}, ring=False)
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)):
        assert engine.wait_for(job, "succeeded", "failed").state == ends
    outcomes = engine.outcomes(job, "video")
    assert outcomes == ["stalled", "succeeded" if times == 1 else "stalled"]
    error = engine.job(job).error
    assert (error or {}).get("code") == (None if times == 1 else "stalled")


def test_a_stage_that_gives_up_unasked_is_tried_again(engine: Engine) -> None:
    """Were it taken for cancelled, its job would never end."""
    skip = ("frames", "train", "mesh", "video")
    job = engine.submit({"ingest": {"give_up_times": 1}}, skip=skip, ring=False)
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)):
        engine.wait(lambda: engine.outcomes(job, "ingest") == ["error"])
        row = engine.stage(job, "ingest")
        assert (row.state, (row.error or {}).get("code")) == ("ready", "internal_error")
        assert engine.wait_for(job, "succeeded", "failed").state == "succeeded"


@pytest.mark.parametrize("appetite", ["hungry", "starving"])
def test_a_stage_without_memory_is_tried_once_more_with_less(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, appetite: str
) -> None:
    monkeypatch.setattr("worker.runtime.num_cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    job = engine.submit({"frames": {appetite: True}}, ring=False)
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)):
        ended = engine.wait_for(job, "succeeded", "failed", timeout_s=240)
    second = "succeeded" if appetite == "hungry" else "out_of_memory"
    assert engine.outcomes(job, "frames") == ["out_of_memory", second]
    assert ended.state == ("succeeded" if appetite == "hungry" else "failed")
    assert (ended.error or {}).get("code") == (None if appetite == "hungry" else "out_of_memory")
    with engine.database.read_scope() as session:
        said = [event for event in list_events(session, job) if event.stage == "frames"]
    assert [event.reason for event in said if event.kind == "stage.ready"][-1] == "less_memory"
    assert any("this attempt takes less" in line for line in engine.log(job, "frames"))
    if appetite == "hungry":
        assert engine.notes("ingest end") == ["ingest end full 8"]
        assert engine.notes("frames end") == ["frames end small 4"]
        assert engine.notes("train end") == ["train end full 8"]


def test_silence_counts_only_while_somebody_watches() -> None:
    pulse = Pulse()
    begun = time.monotonic()
    for second in range(10):
        pulse.silent_s(begun + second / 2)
    assert pulse.silent_s(begun + 5) == pytest.approx(5.0, abs=0.1)
    assert pulse.silent_s(begun + 5000) == pytest.approx(6.0, abs=0.1)  # it was frozen
    assert pulse.notice({"type": "progress", "fraction": 0.5, "message": "half"})
    assert pulse.silent_s(begun + 5000) == 0.0
    pulse.silent_s(begun + 5001)
    assert not pulse.notice({"type": "progress", "fraction": 0.5, "message": "half"})
    assert pulse.silent_s(begun + 5001) == 1.0
    assert pulse.notice({"type": "checkpoint"})
    assert pulse.silent_s(begun + 5001) == 0.0


def test_a_stage_whose_inputs_do_not_fit_does_not_begin(engine: Engine) -> None:
    """Nothing is fetched; the job waits for its next try, and the error says how much is needed."""
    job = engine.submit({}, ring=False)
    with engine.database.session_scope() as session:
        session.get_one(Capture, session.get_one(Job, job).capture_id).bytes = 2**60
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)):
        engine.wait(lambda: engine.stage(job, "ingest").error, 20)
    error = engine.stage(job, "ingest").error
    assert error is not None
    assert error["code"] == "disk_full"
    assert "needs 1073741824." in error["message"]
    assert not engine.notes("ingest start")


def test_a_full_disk_fails_no_job_and_the_queue_goes_on_once_there_is_room(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full = threading.Event()
    full.set()
    real = shutil.disk_usage

    def usage(path: Path) -> Any:
        found = real(path)
        return found._replace(free=2**20) if full.is_set() else found

    monkeypatch.setattr("worker.disk.shutil.disk_usage", usage)
    job = engine.submit({}, ring=False)
    with workers(engine, WorkerIdentity("w", 1, ("cpu", "light"), False)) as (runtime,):
        for _ in range(3):
            runtime.serve(stage_id(job, "ingest"))  # the bell rang
        row = engine.stage(job, "ingest")
        assert (row.state, row.attempt, row.error) == ("ready", 0, None)
        said = [text for text in caplog.messages if "no stage is begun" in text]
        assert len(said) == 1, "once, not every two seconds"
        full.clear()
        engine.wait(lambda: engine.stage(job, "ingest").state == "succeeded", 20)
