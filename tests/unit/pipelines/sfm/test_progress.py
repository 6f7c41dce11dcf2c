"""Progress of the poses."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.sfm import progress as progress_module
from pipelines.sfm.progress import ProgressScale
from pipelines.stage import StageContext
from pipelines.workspace import Workspace


class Clock:
    """A clock that the test moves."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress_module, "time", clock)
    return clock


def scale(root: Path, told: list[float]) -> ProgressScale:
    workspace = Workspace(root)
    ctx = StageContext(
        "poses",
        workspace,
        root / "out",
        root / "checkpoint",
        on_progress=lambda fraction, *_: told.append(fraction),
    )
    return ProgressScale(ctx)


def test_progress_moves_within_an_item_that_takes_long_and_never_passes_it(
    tmp_path: Path, clock: Clock
) -> None:
    told: list[float] = []
    watch = scale(tmp_path, told).watch((0.2, 0.6), 4, "placing image")
    watch(1)
    for _ in range(100):
        clock.now += 0.5
        watch(1)
    assert told[0] == pytest.approx(0.3)
    assert all(after > before for before, after in itertools.pairwise(told))
    assert 0.38 < told[-1] < 0.4
    watch(2)
    assert told[-1] == pytest.approx(0.4)
    watch(4)
    clock.now += 30
    watch(4)
    assert told[-1] == pytest.approx(0.6)


def test_an_item_that_hangs_is_seen_to_hang(tmp_path: Path, clock: Clock) -> None:
    told: list[float] = []
    watch = scale(tmp_path, told).watch((0.0, 1.0), 4, "placing image")
    watch(1)
    for _ in range(200):
        clock.now += 0.5
        watch(1)
    assert len(set(told[130:])) == 1


def test_time_left_is_counted_by_items_that_are_done(tmp_path: Path, clock: Clock) -> None:
    left: list[float | None] = []
    progress = scale(tmp_path, [])
    progress.ctx = replace(progress.ctx, on_progress=lambda *said: left.append(said[2]))
    watch = progress.watch((0.0, 1.0), 10, "placing image")
    for _ in range(3):
        watch(0)
        clock.now += 0.5
    assert left == [None] * 3
    clock.now += 0.5
    watch(1)
    assert left[-1] == pytest.approx(18.0)
    clock.now += 1.0
    watch(1)
    assert left[-1] == pytest.approx(17.0)
