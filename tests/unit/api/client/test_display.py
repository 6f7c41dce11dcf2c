"""What a job says of itself where nobody looks at a terminal."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from api.client import display
from api.client.client import Client, Job

NOW = datetime(2026, 1, 1, tzinfo=UTC)


class Looks:
    """A client whose job is what it is told, look by look."""

    def __init__(self, looks: list[Job]) -> None:
        self._looks = looks

    def wait(self, job_id: str, on_update: Callable[[Job], None]) -> Job:
        for job in self._looks:
            on_update(job)
        return self._looks[-1]


def _job(**stages: dict[str, Any]) -> Job:
    rows = [
        {
            "name": name,
            "state": "running",
            "progress": 0.0,
            "eta_s": None,
            "attempt": 1,
            "message": "",
            "started_at": NOW,
            "finished_at": None,
            **values,
        }
        for name, values in stages.items()
    ]
    values = {"id": "j", "state": "running", "preset": "preview", "preset_reason": "asked for"}
    times = {"created_at": NOW, "started_at": NOW, "finished_at": None}
    rest: dict[str, Any] = {
        "options": {},
        "labels": {},
        "capture_id": "c",
        "metrics": None,
        "error": None,
    }
    return Job.model_validate({**values, **times, **rest, "stages": rows})


def _said(looks: list[Job]) -> list[str]:
    screen = io.StringIO()
    display.watch_job(cast(Client, Looks(looks)), "j", Console(file=screen, width=120))
    return screen.getvalue().splitlines()


def test_the_same_is_not_said_again_for_other_seconds_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(display, "PLAIN_EVERY_S", 0.0)
    same = {"progress": 0.996, "message": "measuring floaters"}
    looks = [_job(evaluate={**same, "eta_s": float(left)}) for left in range(60, 0, -1)]
    looks.append(_job(evaluate={**same, "progress": 0.5, "eta_s": 9.0}))
    looks.append(_job(evaluate={**same, "progress": 0.5, "message": "comparing", "eta_s": 9.0}))
    looks.append(_job(evaluate={"state": "succeeded", "progress": 1.0, "finished_at": NOW}))
    assert [" ".join(line.split()) for line in _said(looks)] == [
        "evaluate running 100% measuring floaters 1 m 00 s left",
        "evaluate running 50% measuring floaters 9 s left",
        "evaluate running 50% comparing 9 s left",
        "evaluate succeeded took 0 s",
    ]


def test_stages_that_run_at_once_are_all_told_when_it_is_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = itertools.count()
    # Whenever it looks at the clock, a line has been due since it last did.
    clock = SimpleNamespace(monotonic=lambda: display.PLAIN_EVERY_S * next(looks))
    monkeypatch.setattr(display, "time", clock)
    made = [_job(mesh={"progress": p}, video={"progress": p / 2}) for p in (0.1, 0.2, 0.3)]
    assert [" ".join(line.split()) for line in _said(made)] == [
        f"{name} running {percent}%"
        for percents in ((10, 5), (20, 10), (30, 15))
        for name, percent in zip(("mesh", "video"), percents, strict=True)
    ]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.6, "1 m 00 s"), (125, "2 m 05 s"), (3725, "1 h 02 m"), (-3, "0 s")],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert display.duration(seconds) == text


def test_sizes_read_well() -> None:
    assert [
        display.size(0),
        display.size(999),
        display.size(1500),
        display.size(2_500_000_000),
    ] == [
        "0 B",
        "999 B",
        "1.5 kB",
        "2.5 GB",
    ]
