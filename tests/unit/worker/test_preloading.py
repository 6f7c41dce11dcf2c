"""What a stage process loads while it is idle."""

from __future__ import annotations

import queue
import sys
from pathlib import Path

import pytest

from worker.preloading import preload_steps
from worker.stage_process import next_command


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A registry of three stages: two in one module with `preload`, one whose import fails."""
    (tmp_path / "made_registry.py").write_text(
        "from types import SimpleNamespace\n"
        "RUNS = {'a': 'made_stage:run', 'b': 'made_stage:other', 'c': 'made_broken:run'}\n"
        "def get_stage(name):\n"
        "    return SimpleNamespace(run=RUNS[name])\n"
    )
    (tmp_path / "made_stage.py").write_text("loaded = []\ndef preload():\n    loaded.append(1)\n")
    (tmp_path / "made_broken.py").write_text("import there_is_no_such_module\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("made_registry", "made_stage", "made_broken"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return "made_registry"


def test_each_module_is_imported_once_and_then_asked_to_preload(registry: str) -> None:
    steps = preload_steps(registry, ["a", "b"])
    assert next(steps) == "made_stage"
    assert sys.modules["made_stage"].loaded == []
    assert list(steps) == ["made_stage.preload"]
    assert sys.modules["made_stage"].loaded == [1]


def test_a_module_that_cannot_be_loaded_is_a_warning(
    registry: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert list(preload_steps(registry, ["c"])) == []
    assert "there_is_no_such_module" in caplog.text


def test_a_command_waits_for_one_piece_at_most() -> None:
    commands: queue.Queue[dict[str, object]] = queue.Queue()
    done = []

    def pieces() -> object:
        for number in range(5):
            done.append(number)
            if number == 2:
                commands.put({"do": "run"})
            yield number

    assert next_command(commands, iter(pieces())) == {"do": "run"}  # type: ignore[call-overload]
    assert done == [0, 1, 2]


def test_a_waiting_command_is_served_before_anything_is_loaded() -> None:
    commands: queue.Queue[dict[str, object]] = queue.Queue()
    commands.put({"do": "run"})
    pieces = iter(["a", "b"])
    assert next_command(commands, pieces) == {"do": "run"}
    assert list(pieces) == ["a", "b"]
