"""Keeps a few processes running: starts them in order, restarts what dies, stops them all.

Each process gets a process group of its own, so that Ctrl-C in the terminal reaches the supervisor
alone, which then stops them in the reverse order. On Linux the kernel ends them too when the
supervisor itself is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

POLL_S = 0.2
READY_POLL_S = 0.05
FIRST_RESTART_DELAY_S = 0.2
LONGEST_RESTART_DELAY_S = 3.0
STEADY_AFTER_S = 20.0
"""A process that ran this long starts with the shortest delay again."""

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def _end_with_parent() -> None:
    """Runs in the child between fork and exec: ask the kernel for SIGTERM if the parent dies."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@dataclass(frozen=True)
class Program:
    """One process to keep running.

    ready: called until it returns True; start-up waits for it.
    alone: it is started once all before it are ready; otherwise beside the one before it.
    stop_s: how long it may take to end after SIGTERM before it is killed.
    """

    name: str
    command: list[str]
    environment: Mapping[str, str]
    log: Path
    ready: Callable[[], bool] = lambda: True
    ready_s: float = 60.0
    stop_s: float = 10.0
    alone: bool = True


@dataclass
class _Running:
    program: Program
    process: subprocess.Popen[bytes]
    started: float
    delay: float = FIRST_RESTART_DELAY_S
    restart_at: float | None = None


class StartFailed(RuntimeError):
    """A program ended, or never became ready; the message holds the end of its log."""


@dataclass
class Supervisor:
    """Runs `programs` between `start` and `stop`. say: receives one line per event."""

    programs: list[Program]
    say: Callable[[str], None] = print
    _running: list[_Running] = field(default_factory=list)
    _stopping: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self) -> None:
        """Start all in order, as `Program.alone` says. Raises StartFailed; then none is left."""
        coming: list[_Running] = []
        try:
            for program in self.programs:
                if program.alone:
                    self._wait_ready(coming)
                running = _Running(program, _launch(program), time.monotonic())
                self._running.append(running)
                coming.append(running)
            self._wait_ready(coming)
        except BaseException:
            self.stop()
            raise
        self._thread = threading.Thread(target=self._watch, name="supervisor", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop all in reverse order. Safe to call twice."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        with self._lock:
            while self._running:
                running = self._running.pop()
                _end(running.process, running.program.stop_s)

    def _wait_ready(self, coming: list[_Running]) -> None:
        """Until all of them are; the list is empty then."""
        while coming:
            for running in [*coming]:
                program, status = running.program, running.process.poll()
                if program.ready():
                    coming.remove(running)
                elif status is not None:
                    raise StartFailed(
                        f"{program.name} ended with status {status} at its start:\n"
                        + tail(program.log)
                    )
                elif time.monotonic() > running.started + program.ready_s:
                    raise StartFailed(
                        f"{program.name} was not ready within {program.ready_s:.0f} s:\n"
                        + tail(program.log)
                    )
            if coming:
                time.sleep(READY_POLL_S)

    def _watch(self) -> None:
        while not self._stopping.wait(POLL_S):
            with self._lock:
                for running in self._running:
                    self._revive(running)

    def _revive(self, running: _Running) -> None:
        now = time.monotonic()
        if running.process.poll() is None:
            if now - running.started > STEADY_AFTER_S:
                running.delay = FIRST_RESTART_DELAY_S
            return
        if running.restart_at is None:
            status = running.process.returncode
            reason = f"signal {-status}" if status < 0 else f"status {status}"
            self.say(f"{running.program.name} ended with {reason}; starting it again")
            running.restart_at = now + running.delay
        if now >= running.restart_at:
            running.process = _launch(running.program)
            running.started = now
            running.restart_at = None
            running.delay = min(running.delay * 2, LONGEST_RESTART_DELAY_S)

    def pids(self) -> dict[str, int]:
        """Process ids by program name, as of now."""
        with self._lock:
            return {running.program.name: running.process.pid for running in self._running}


def tail(log: Path, lines: int = 15) -> str:
    """The last lines of a log file."""
    if not log.is_file():
        return "(no output)"
    return "\n".join(log.read_text("utf-8", "replace").splitlines()[-lines:]) or "(no output)"


def _launch(program: Program) -> subprocess.Popen[bytes]:
    program.log.parent.mkdir(parents=True, exist_ok=True)
    with program.log.open("ab") as log:
        # preexec_fn is safe here: it calls into libc only, through a handle made beforehand.
        return subprocess.Popen(
            program.command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=dict(program.environment),
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )


def _end(process: subprocess.Popen[bytes], stop_s: float) -> None:
    if process.poll() is None:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(stop_s)
    with contextlib.suppress(ProcessLookupError, PermissionError):  # the group ended by itself
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
