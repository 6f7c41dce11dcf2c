"""Comparing algorithms: curves over steps and CPU seconds, gains, and the options laid over."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.algorithms import (
    ALGORITHMS,
    BASE,
    Algorithm,
    Curve,
    chosen,
    curve,
    curves_table,
    draw,
    gain,
    gains_table,
    half_tables,
    marks_of,
    value_at,
)
from tests.benchmarks.capture_data import load_capture
from tests.benchmarks.made_capture import write_made_capture
from tests.benchmarks.runs import Mark, Run, run_with_marks
from tests.benchmarks.scores import Score
from tests.unit.benchmarks.test_runs import CONFIG

STEPS = [10, 20, 40]


def _curve(name: str, cpu_s: list[float], psnr: list[float], capture: str = "made") -> Curve:
    return Curve(name, capture, STEPS, cpu_s, psnr, [psnr[-1]])


def _run(seed: int, cpu_s: list[float], psnr: list[float]) -> Run:
    marks = [
        Mark(step, 1.0, {"a": Score(value - 1.0, 0.5), "b": Score(value + 1.0, 0.5)}, cpu)
        for step, cpu, value in zip(STEPS, cpu_s, psnr, strict=True)
    ]
    return Run(seed, marks, STEPS[-1], 1.0, 1.0, None)


def test_a_curve_is_the_mean_over_seeds_and_images() -> None:
    runs = [_run(0, [1.0, 2.0, 4.0], [10.0, 12.0, 14.0]), _run(1, [3.0, 4.0, 8.0], [12.0, 16, 18])]
    found = curve("x", "made", runs)
    assert found.over_steps() == [(10.0, 11.0), (20.0, 14.0), (40.0, 16.0)]
    assert found.over_cpu() == [(2.0, 11.0), (3.0, 14.0), (6.0, 16.0)]
    assert found.psnr_by_seed == [14.0, 18.0]


def test_values_between_marks_lie_on_straight_lines() -> None:
    points = [(1.0, 10.0), (3.0, 14.0), (4.0, 13.0)]
    assert [value_at(points, x) for x in (0.0, 1.0, 2.0, 3.5, 9.0)] == [
        10.0,
        10.0,
        12.0,
        13.5,
        13.0,
    ]


def test_gains_are_worked_out_at_equal_steps_and_at_equal_seconds() -> None:
    base = _curve(BASE, [1.0, 2.0, 4.0], [10.0, 14.0, 16.0])
    # Half the time a step; worse by 1 dB after the same steps, at 2 s it is 15 where base is 14.
    fast = _curve("fast", [0.5, 1.0, 2.0], [9.0, 12.0, 15.0])
    found = gain(base, fast)
    assert (found.at_steps, found.at_cpu, found.cpu_ratio) == (-1.0, 1.0, 0.5)
    assert found.speed_up is None
    # 16 dB is half way between its second and third mark, at 3 s of the base's 4.
    better = gain(base, _curve("better", [1.0, 2.0, 4.0], [11.0, 15.0, 17.0]))
    assert better.speed_up == pytest.approx(4.0 / 3.0)
    same = gain(base, base)
    assert (same.at_steps, same.at_cpu, same.cpu_ratio, same.speed_up) == (0.0, 0.0, 1.0, 1.0)


def test_tables_and_pictures_hold_every_algorithm_and_capture() -> None:
    algorithms = [Algorithm(BASE), Algorithm("fast")]
    curves = [
        _curve(name, [1.0, 2.0, 4.0], [10.0, 14.0, last], capture)
        for capture, last in (("one", 16.0), ("two", 18.0))
        for name in (BASE, "fast")
    ]
    text = gains_table(curves, algorithms)
    for row in ("base, one", "fast, two", "fast, mean"):
        assert row in text
    assert "18.00 / 4.0" in curves_table(curves)
    left, right = draw(curves[:2], "title").size
    assert left > 2 * right


def test_names_choose_algorithms_and_their_bases_come_along() -> None:
    assert [item.name for item in chosen("coarse images", [])] == [BASE, "coarse images"]
    by_samples = chosen("batches by samples", [])
    assert [item.name for item in by_samples] == ["instant-ngp base", "batches by samples"]
    found = chosen(BASE, ["more rays: rays_per_step=64 optimizer.lr=0.02"])[-1]
    assert found.assignments(9) == ["rays_per_step=64", "optimizer.lr=0.02"]
    assert chosen("", []) == list(ALGORITHMS)
    with pytest.raises(ValueError, match="no algorithm nonsense"):
        chosen("nonsense", [])


def test_options_follow_the_length_of_the_run() -> None:
    found = Algorithm("x", ("data.coarse_steps={half}", "model.grid.steps_per_level={sixteenth}"))
    wanted = ["data.coarse_steps=120", "model.grid.steps_per_level=15"]
    assert found.assignments(240) == wanted
    assert found.assignments(3) == ["data.coarse_steps=1", "model.grid.steps_per_level=1"]


def test_marks_end_with_the_run() -> None:
    assert marks_of(240)[-1] == 240
    assert marks_of(250)[-1] == 250
    assert marks_of(3) == [1, 2, 3]


def test_half_tables_compare_two_files_of_one_model(tmp_path: Path) -> None:
    write_made_capture(tmp_path / "made", 8, 12, 16)
    capture = load_capture(tmp_path / "made", CONFIG.data)
    run = run_with_marks(
        capture, CONFIG, seed=0, images=capture.test[:1], steps=[3, 7], render_engine="plain"
    )
    cpu = [mark.cpu_s for mark in run.marks]
    assert 0.0 < cpu[0] < cpu[1]
    config = run.model.config
    found = half_tables(run.model, capture, capture.test[:1], "plain")
    assert run.model.config == config
    assert 0.5 < found.bytes_half / found.bytes_full < 1.0
    assert found.psnr_full == pytest.approx(run.marks[-1].mean_psnr(), abs=1e-6)
    assert found.psnr_half == pytest.approx(found.psnr_full, abs=0.05)
