"""The split of a job's wall time."""

from __future__ import annotations

import pytest

from tests.benchmarks.job_overhead import JOB_PARTS, TARGET_PARTS, JobTimes, StageTimes, share

TIMINGS = {
    "fetch_s": 0.5,
    "start_s": 0.25,
    "run_s": 8.0,
    "store_s": 1.0,
    "wall_s": 7.0,
    "load_s": 0.5,
    "compile_s": 2.5,
}


def job(*spans: tuple[float, float]) -> JobTimes:
    stages = [
        StageTimes(f"stage {index}", begin, end, TIMINGS)
        for index, (begin, end) in enumerate(spans)
    ]
    return JobTimes(
        sent=100.0, created=101.0, finished=130.0, seen=131.5, ended=134.0, stages=stages
    )


def test_a_stage_is_split_without_rest() -> None:
    parts = StageTimes("train", 10.0, 20.0, TIMINGS).parts()
    assert parts == {
        "inputs": 0.5,
        "start": 0.25,
        "load": 0.5,
        "compile": 2.5,
        "work": 4.0,
        "seal": 1.0,
        "outputs": 1.0,
        "record": 0.25,
    }


def test_parts_of_a_job_sum_to_its_wall_time() -> None:
    measured = job((103.0, 113.0), (113.5, 124.0), (126.0, 130.0))
    parts = measured.parts()
    assert tuple(parts) == JOB_PARTS
    assert sum(parts.values()) == pytest.approx(measured.wall_s)
    assert (parts["upload"], parts["first wait"], parts["notice"], parts["download"]) == (
        1.0,
        2.0,
        1.5,
        2.5,
    )
    assert parts["gaps"] == pytest.approx(0.5 + 2.0)
    assert parts["work"] == pytest.approx(12.0)


def test_time_under_two_stages_at_once_is_no_gap() -> None:
    assert job((103.0, 120.0), (110.0, 115.0), (118.0, 130.0)).parts()["gaps"] == 0.0


def test_share_is_of_the_wall_time() -> None:
    measured = job((101.0, 130.0))
    parts = measured.parts()
    wanted = parts["inputs"] + parts["start"] + parts["load"] + parts["seal"] + parts["outputs"]
    wanted += parts["record"] + parts["gaps"] + parts["first wait"]
    assert share(parts, TARGET_PARTS, measured.wall_s) == pytest.approx(wanted / 34.0)
