"""Slots: which stages run side by side, and with how many threads.

Real stage processes and a real database; no broker.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import pytest

from deploy.embedded import free_port
from storage.models import StageRow
from tests.integration.engine import Engine
from worker.__main__ import MANY_CORES, default_slots, parse_arguments
from worker.runtime import WorkerIdentity, WorkerRuntime
from worker.settings import WorkerSettings

TOYS = "tests.integration.toy_stages"
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


def submit_two(engine: Engine) -> tuple[str, str]:
    """Two jobs; the frames of the second take until the training of the first is half done."""
    longer = {**SECOND, "steps": 15}
    return (
        engine.submit({"frames": SECOND, "train": SECOND}, ring=False),
        engine.submit({"frames": longer, "train": SECOND}, ring=False),
    )


def check_overlap(engine: Engine, first: str, second: str) -> None:
    for job in (first, second):
        assert engine.wait_for(job, "succeeded", "failed").state == "succeeded"
    assert overlap(engine.stage(first, "train"), engine.stage(second, "frames"))
    assert not overlap(engine.stage(first, "train"), engine.stage(second, "train"))


def test_a_gpu_worker_trains_one_job_while_a_cpu_worker_prepares_the_next(engine: Engine) -> None:
    first, second = submit_two(engine)
    gpu = WorkerIdentity("gpu", 1, ("gpu",), True)
    cpu = WorkerIdentity("cpu", 1, ("cpu", "light"), False)
    with workers(engine, gpu, cpu):
        check_overlap(engine, first, second)


def test_two_slots_beside_one_gpu_do_the_same_and_share_the_gpu_with_nobody(
    engine: Engine,
) -> None:
    first, second = submit_two(engine)
    with workers(engine, WorkerIdentity("both", 2, ("cpu", "gpu", "light"), True)):
        check_overlap(engine, first, second)


def test_stages_of_one_job_that_wait_for_the_same_run_side_by_side_in_two_slots(
    engine: Engine,
) -> None:
    job = engine.submit({"mesh": SECOND, "video": SECOND}, ring=False)
    with workers(engine, WorkerIdentity("w", 2, ("cpu", "light"), False)):
        assert engine.wait_for(job, "succeeded", "failed").state == "succeeded"
    assert overlap(engine.stage(job, "mesh"), engine.stage(job, "video"))


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
        for _ in range(4):
            runtime._free.get_nowait()
            found.append(runtime._threads_now())
        assert found == [8, 4, 2, 2]
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
