"""Training with marks, and the clock that splits it: on a made-up capture of a few small images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import pytest
import torch

from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import DataConfig, TrainConfig
from pipelines.nerf.training.loop import train
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.made_capture import write_made_capture
from tests.benchmarks.phases import PhaseClock, watching
from tests.benchmarks.runs import run_with_marks
from tests.benchmarks.scores import evaluate
from tests.benchmarks.train_speed import PHASES, REST, Round, measure, median_of, ratio_of

GRID = HashGridConfig(num_levels=2, min_res=4, max_res=8, log2_table_size=8)
CONFIG = TrainConfig(
    max_steps=7,
    rays_per_step=16,
    engine="plain",
    device="cpu",
    model=NerfactoConfig(
        num_proposal_samples=(8,),
        num_nerf_samples=4,
        proposals=(ProposalConfig(grid=GRID, hidden_dim=4),),
        grid=GRID,
        hidden_dim=8,
        hidden_dim_color=8,
        appearance_dim=2,
        camera_mode="off",
    ),
    data=DataConfig(long_side_px=32),
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> BenchmarkCapture:
    folder = tmp_path_factory.mktemp("captures") / "made"
    write_made_capture(folder, 8, 12, 16)
    return load_capture(folder, CONFIG.data)


# In PyTorch: compiling the renderer would take longer than all tests here.
marked_run = partial(run_with_marks, render_engine="plain")


def test_marks_are_at_the_steps_asked_for_and_leave_training_alone(
    capture: BenchmarkCapture,
) -> None:
    run = marked_run(capture, CONFIG, seed=3, images=capture.test, steps=[2, 6])
    assert [mark.step for mark in run.marks] == [2, 6, 7]
    assert run.steps == 7
    times = [mark.train_s for mark in run.marks]
    assert times == sorted(times)
    assert 0.0 < times[0] <= times[-1] == run.train_s
    names = {capture.names[index] for index in capture.test}
    assert all(set(mark.scores) == names for mark in run.marks)
    alone = train(capture.images, capture.cameras, capture.train, CONFIG, seed=3)
    for name, value in alone.state_dict().items():
        assert torch.equal(value, run.model.state_dict()[name]), name
    assert evaluate(alone, capture, capture.test, "plain") == run.marks[-1].scores


def test_a_mark_is_the_state_of_a_run_of_that_many_steps(capture: BenchmarkCapture) -> None:
    run = marked_run(capture, CONFIG, seed=1, images=capture.test[:1], steps=[3])
    short = replace(CONFIG, max_steps=3)
    model = train(capture.images, capture.cameras, capture.train, short, seed=1)
    assert run.marks[0].step == 3
    assert run.marks[0].scores == evaluate(model, capture, capture.test[:1], "plain")


def test_marks_by_time_are_behind_the_seconds_asked_for(capture: BenchmarkCapture) -> None:
    config = replace(CONFIG, max_steps=40)
    run = marked_run(capture, config, seed=0, images=capture.test[:1], seconds=[1e-6, 2e-6, 1e6])
    # The first two fall together, at the first look at the clock; the third is never reached.
    assert [mark.step for mark in run.marks] == [5, 40]


def test_a_run_that_ends_by_time_is_measured_at_its_end(capture: BenchmarkCapture) -> None:
    config = replace(CONFIG, max_steps=10**6, max_seconds=0.05)
    run = marked_run(capture, config, seed=0, images=capture.test[:1], seconds=[0.05])
    assert run.marks[-1].step == run.steps
    assert run.train_s >= 0.05
    assert run.rays_per_s == pytest.approx(run.steps * 16 / run.train_s)


def ticking(times: list[tuple[float, float]]) -> PhaseClock:
    readings: Iterator[tuple[float, float]] = iter(times)
    return PhaseClock(now=lambda: next(readings))


def test_an_inner_phase_is_taken_out_of_the_outer_one() -> None:
    clock = ticking([(0.0, 0.0), (1.0, 2.0), (4.0, 3.0), (6.0, 7.0)])
    clock.begin("outer")
    clock.begin("inner")
    clock.end()
    clock.end()
    assert clock.wall_s == {"outer": 1.0 + 2.0, "inner": 3.0}
    assert clock.cpu_s == {"outer": 2.0 + 4.0, "inner": 1.0}


def test_time_outside_of_phases_and_before_a_reset_counts_nowhere() -> None:
    clock = ticking([(0.0, 0.0), (1.0, 1.0), (5.0, 5.0), (6.0, 6.0), (8.0, 8.0)])
    clock.begin("a")
    clock.end()
    clock.begin("a")
    clock.reset()
    clock.end()
    assert clock.wall_s == {"a": 2.0}


class Worker:
    """Something with a function that can be watched."""

    def work(self, value: int) -> int:
        return 2 * value


def test_watched_functions_and_optimisers_are_timed_and_put_back() -> None:
    original = Worker.__dict__["work"]
    clock = PhaseClock()
    weight = torch.nn.Parameter(torch.ones(1))
    weight.grad = torch.ones(1)
    optimizer = torch.optim.SGD([weight], lr=0.5)
    with watching(clock, [(Worker, "work", "working")], "optimiser"):
        assert Worker().work(4) == 8
        optimizer.step()
    assert weight.item() == 0.5
    assert clock.wall_s.keys() == {"working", "optimiser"}
    assert all(seconds > 0.0 for seconds in clock.wall_s.values())
    assert Worker.__dict__["work"] is original
    clock.wall_s.clear()
    Worker().work(1)
    optimizer.step()
    assert not clock.wall_s


def test_phases_of_training_add_up_to_the_step(capture: BenchmarkCapture) -> None:
    found = measure(capture, CONFIG, 2, split=True)
    assert found.steps == 5
    assert all(found.phase_s[name] > 0.0 for name in PHASES)
    assert sum(found.phase_s.values()) == pytest.approx(found.step_s, rel=0.25)
    assert found.rays_per_s == pytest.approx(16 / found.step_s)
    assert set(found.phase_s) == {*PHASES, REST}


def test_engines_are_compared_round_by_round() -> None:
    def one(engine: str, rate: float) -> Round:
        return Round(engine, 5, 1.0 / rate, 1.0, rate, {}, {})

    rounds = [one("fast", 90.0), one("plain", 30.0), one("fast", 40.0), one("plain", 10.0)]
    rounds += [one("fast", 80.0), one("plain", 40.0)]
    assert ratio_of(rounds, "fast", "plain") == 3.0
    assert median_of(rounds, "fast").rays_per_s == 80.0
