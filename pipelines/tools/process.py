"""Run another program: argument lists only, a time limit, a cancel check, and its last log lines.

A started program stays in the process group of the process that starts it, so whoever kills that
group (a worker ending its stage process, or Ctrl-C in a terminal) takes the program along; nothing
is orphaned in a session of its own.
"""

from __future__ import annotations

import errno
import os
import select
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

from pipelines.errors import Cancelled, ToolError

LOG_LINES = 40
"""How many of a program's last lines are kept for its error."""

_POLL_S = 0.1
_CHUNK_BYTES = 1 << 20

_SIGNAL_ADVICE: Mapping[int, str] = {
    signal.SIGKILL: "The system probably ran out of memory: use smaller pictures or a larger "
    "machine.",
    signal.SIGILL: "The program was built for another processor: install a build for this one.",
    signal.SIGSEGV: "The program has a fault: try the input converted to another format.",
    signal.SIGABRT: "The program has a fault: try the input converted to another format.",
    signal.SIGXFSZ: "It wrote a larger file than it may: have the bound of the worker raised.",
    signal.SIGXCPU: "It used all the processor time that it may: try a shorter input.",
}
_NO_LIMIT = float("inf")


@dataclass(frozen=True)
class ProgramResult:
    """A program that ended well. log: its last stderr lines. wall_s: how long it ran."""

    log: tuple[str, ...]
    wall_s: float


def _never() -> bool:
    return False


def exit_advice(returncode: int, advice: Mapping[int, str]) -> str | None:
    """What to do about an exit code, or None where nothing is known.

    A negative code is the signal that ended the program; shells report it as 128 + signal.
    """
    if returncode in advice:
        return advice[returncode]
    number = -returncode if returncode < 0 else returncode - 128
    return _SIGNAL_ADVICE.get(number)


class Program:
    """A running program, as a context: whatever happens inside, it is gone afterwards.

    argv: the program and its arguments, never a shell string.
    on_line: called with each stderr line, in a thread of its own; what it raises, `wait` raises.
    on_stdout: called with each chunk of stdout, in the caller's thread, by `wait`; without it
    stdout is dropped.
    stdin: whether `write` will be used; then not together with on_stdout, since each would wait
    for the other.
    is_cancelled: polled in `write` and `wait`; once true the program is killed.
    advice: what to do about exit codes of this program.
    Raises ToolError where the program cannot be started.
    """

    def __init__(
        self,
        argv: Sequence[str],
        *,
        time_limit_s: float = _NO_LIMIT,
        is_cancelled: Callable[[], bool] = _never,
        on_line: Callable[[str], None] | None = None,
        on_stdout: Callable[[bytes], None] | None = None,
        stdin: bool = False,
        advice: Mapping[int, str] | None = None,
    ) -> None:
        self._argv = list(argv)
        self._name = Path(self._argv[0]).name
        self._time_limit_s = time_limit_s
        self._is_cancelled = is_cancelled
        self._on_line = on_line
        self._on_stdout = on_stdout
        if stdin and on_stdout:
            raise ValueError("stdin and on_stdout cannot be used together")
        self._wants_stdin = stdin
        self._advice = dict(advice or {})
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._callback_error: Exception | None = None
        self._passed_limit_s: float | None = None

    def __enter__(self) -> Program:
        try:
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                self._argv,
                stdin=subprocess.PIPE if self._wants_stdin else subprocess.DEVNULL,
                stdout=subprocess.PIPE if self._on_stdout else subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
        except OSError as error:
            if error.errno in (errno.ENOMEM, errno.EMFILE, errno.EAGAIN):
                raise  # it is there; there is no room for it
            raise ToolError(
                f"{self._name} cannot be started: {os.strerror(error.errno or 0)}.",
                code="tool_missing",
                hint=f"Install {self._name}, or repair its installation.",
            ) from error
        self._started = time.monotonic()
        self._log_thread = threading.Thread(target=self._read_log, daemon=True)
        self._log_thread.start()
        self._timer: threading.Timer | None = None
        if self._time_limit_s != _NO_LIMIT:
            limit = self._time_limit_s
            self._timer = threading.Timer(limit, self._on_time_limit, [limit])
            self._timer.daemon = True
            self._timer.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.kill()
        if self._timer:
            self._timer.cancel()
        self._log_thread.join()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe:
                _close_quietly(pipe)

    def write(self, data: bytes | memoryview) -> None:
        """Feed the program's stdin. Raises ToolError where it has ended, and Cancelled."""
        self._check_cancelled()
        assert self._process.stdin is not None, "the program was started without stdin"
        try:
            self._process.stdin.write(data)
        except BrokenPipeError:
            self.wait()
            raise ToolError(
                f"{self._name} ended before it had read all of its input.",
                details={"log": list(self._log)},
            ) from None

    def wait(self, at_most_s: float = _NO_LIMIT) -> ProgramResult:
        """Close stdin and wait for the end, from now on at most so long.

        Raises ToolError for an exit code other than 0 or a passed time limit, Cancelled, and what
        a callback raised.
        """
        if self._process.stdin:
            _close_quietly(self._process.stdin)
        self._drain_stdout()
        begun = time.monotonic()
        while True:
            try:
                returncode = self._process.wait(_POLL_S)
                break
            except subprocess.TimeoutExpired:
                self._check_cancelled()
                if time.monotonic() - begun > at_most_s:
                    self._on_time_limit(at_most_s)
        self._log_thread.join()
        if self._callback_error is not None:
            raise self._callback_error
        self._raise_for(returncode)
        return ProgramResult(tuple(self._log), time.monotonic() - self._started)

    def _raise_for(self, returncode: int) -> None:
        log = list(self._log)
        if self._passed_limit_s is not None:
            raise ToolError(
                f"{self._name} was stopped: it took longer than {self._passed_limit_s:.0f} s.",
                code="tool_timeout",
                hint="Try a shorter or smaller input.",
                details={"log": log},
            )
        if returncode != 0:
            last = next((line for line in reversed(log) if line.strip()), "it said nothing")
            how = f"signal {-returncode}" if returncode < 0 else f"exit code {returncode}"
            raise ToolError(
                f"{self._name} failed with {how}: {last.strip()}",
                hint=exit_advice(returncode, self._advice),
                details={"log": log, "exit_code": returncode},
            )

    def _check_cancelled(self) -> None:
        if self._is_cancelled():
            self.kill()
            raise Cancelled(f"The job was cancelled while {self._name} was running.")

    def _on_time_limit(self, limit_s: float) -> None:
        if self._process.poll() is None:
            self._passed_limit_s = limit_s
            self.kill()

    def kill(self) -> None:
        """End the program at once; a `write` that another thread waits in raises ToolError."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()

    def _read_log(self) -> None:
        assert self._process.stderr is not None
        # Programs redraw a progress line with \r: universal newlines split there too.
        with open(
            self._process.stderr.fileno(), encoding="utf-8", errors="replace", closefd=False
        ) as lines:
            for line in lines:
                text = line.rstrip("\n")
                self._log.append(text)
                if self._on_line is None or self._callback_error is not None:
                    continue
                try:
                    self._on_line(text)
                except Exception as error:  # noqa: BLE001  carried to the caller's thread
                    self._callback_error = error
                    self._process.kill()

    def _drain_stdout(self) -> None:
        """Hand stdout on until it ends, noticing a cancel within `_POLL_S` or a chunk's work."""
        if self._on_stdout is None or self._process.stdout is None:
            return
        descriptor = self._process.stdout.fileno()
        while True:
            self._check_cancelled()
            if not select.select([descriptor], [], [], _POLL_S)[0]:
                continue
            chunk = os.read(descriptor, _CHUNK_BYTES)
            if not chunk:
                return
            self._on_stdout(chunk)


def _close_quietly(pipe: IO[bytes]) -> None:
    """Close a pipe whose other end may be gone."""
    try:
        pipe.close()
    except BrokenPipeError:
        return


def run_program(
    argv: Sequence[str],
    *,
    time_limit_s: float = _NO_LIMIT,
    is_cancelled: Callable[[], bool] = _never,
    on_line: Callable[[str], None] | None = None,
    on_stdout: Callable[[bytes], None] | None = None,
    advice: Mapping[int, str] | None = None,
) -> ProgramResult:
    """Run a program to its end; the arguments and errors are those of `Program`."""
    with Program(
        argv,
        time_limit_s=time_limit_s,
        is_cancelled=is_cancelled,
        on_line=on_line,
        on_stdout=on_stdout,
        advice=advice,
    ) as program:
        return program.wait()
