"""Programs are run without a shell, ended when asked, and their failures explained."""

from __future__ import annotations

import os
import sys
import threading
import time

import pytest

from pipelines.errors import Cancelled, ToolError
from pipelines.tools.process import LOG_LINES, Program, exit_advice, run_program


def python(program: str) -> list[str]:
    return [sys.executable, "-c", program]


def test_stdout_and_stderr_lines_are_handed_on() -> None:
    chunks: list[bytes] = []
    lines: list[str] = []
    program = "import sys; sys.stdout.write('x' * 3_000_000); print('one\\rtwo', file=sys.stderr)"
    result = run_program(python(program), on_line=lines.append, on_stdout=chunks.append)
    assert len(b"".join(chunks)) == 3_000_000
    assert lines == ["one", "two"]
    assert result.log == ("one", "two")


def test_failure_carries_the_exit_code_the_last_lines_and_advice() -> None:
    program = "import sys\nfor n in range(99): print('line', n, file=sys.stderr)\nsys.exit(7)"
    with pytest.raises(ToolError, match="exit code 7: line 98") as caught:
        run_program(python(program), advice={7: "Turn it around."})
    assert caught.value.hint == "Turn it around."
    assert caught.value.details["exit_code"] == 7
    assert len(caught.value.details["log"]) == LOG_LINES


def test_program_that_was_killed_is_explained() -> None:
    with pytest.raises(ToolError, match="signal 9") as caught:
        run_program(python("import os; os.kill(os.getpid(), 9)"))
    assert "memory" in caught.value.hint


def test_shell_codes_mean_the_same_as_signals() -> None:
    assert exit_advice(137, {}) == exit_advice(-9, {})
    assert exit_advice(1, {}) is None


def test_missing_program_is_an_error_that_names_it() -> None:
    with pytest.raises(ToolError, match="no-such-program") as caught:
        run_program(["no-such-program"])
    assert caught.value.code == "tool_missing"


def test_time_limit_ends_the_program() -> None:
    begun = time.monotonic()
    with pytest.raises(ToolError) as caught:
        run_program(python("import time; time.sleep(60)"), time_limit_s=0.5)
    assert caught.value.code == "tool_timeout"
    assert time.monotonic() - begun < 10


@pytest.mark.parametrize("reads_stdout", [True, False])
def test_cancel_ends_the_program(reads_stdout: bool) -> None:
    cancelled = threading.Event()
    pids: list[int] = []

    def cancel_once_it_runs(line: str) -> None:
        pids.append(int(line))
        cancelled.set()

    begun = time.monotonic()
    with pytest.raises(Cancelled):
        run_program(
            python("import os, sys, time; print(os.getpid(), file=sys.stderr); time.sleep(60)"),
            is_cancelled=cancelled.is_set,
            on_line=cancel_once_it_runs,
            on_stdout=(lambda chunk: None) if reads_stdout else None,
        )
    assert time.monotonic() - begun < 30
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_program_stays_in_the_group_of_its_starter() -> None:
    groups: list[int] = []
    program = "import os, sys; print(os.getpgid(0), file=sys.stderr)"
    run_program(python(program), on_line=lambda line: groups.append(int(line)))
    assert groups == [os.getpgid(0)]


@pytest.mark.parametrize("where", ["on_line", "on_stdout"])
def test_error_in_a_callback_ends_the_program_and_is_raised(where: str) -> None:
    def fail(_: object) -> None:
        raise LookupError("from the callback")

    program = (
        "import sys, time; print('x', flush=True); print('y', file=sys.stderr, flush=True);"
        "time.sleep(60)"
    )
    begun = time.monotonic()
    with pytest.raises(LookupError, match="from the callback"):
        run_program(python(program), **{where: fail})  # type: ignore[arg-type]
    assert time.monotonic() - begun < 10


def test_stdin_is_fed_and_closed() -> None:
    program = "import sys; data = sys.stdin.buffer.read(); print(len(data), file=sys.stderr)"
    with Program(python(program), stdin=True) as running:
        for _ in range(10):
            running.write(bytes(100_000))
        assert running.wait().log == ("1000000",)


def test_writing_to_a_program_that_failed_raises_its_failure() -> None:
    program = "import sys; print('no room', file=sys.stderr); sys.exit(3)"
    with Program(python(program), stdin=True) as running, pytest.raises(ToolError, match="no room"):
        running.write(bytes(50_000_000))


def test_leaving_the_context_ends_the_program() -> None:
    with Program(python("import time; time.sleep(60)"), stdin=True) as running:
        pid = running._process.pid
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_wait_with_a_limit_ends_the_program_that_does_not_come_to_its_end() -> None:
    begun = time.monotonic()
    with (
        Program(python("import time; time.sleep(60)"), stdin=True) as running,
        pytest.raises(ToolError, match="longer than 1 s") as caught,
    ):
        running.wait(0.6)
    assert caught.value.code == "tool_timeout"
    assert time.monotonic() - begun < 10


def test_killing_the_program_frees_the_thread_that_feeds_it() -> None:
    failures: list[ToolError] = []

    def feed(running: Program) -> None:
        try:
            running.write(bytes(50_000_000))
        except ToolError as error:
            failures.append(error)

    with Program(python("import time; time.sleep(60)"), stdin=True) as running:
        feeder = threading.Thread(target=feed, args=(running,))
        feeder.start()
        time.sleep(0.3)
        assert feeder.is_alive()
        running.kill()
        feeder.join(10.0)
        assert not feeder.is_alive()
    assert "signal 9" in failures[0].message
