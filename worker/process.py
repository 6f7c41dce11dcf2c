"""The worker's end of a stage process: starts it, talks to it, kills it and all that it started."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from worker.containment.apply import Containment
from worker.containment.plan import Plan
from worker.leftovers import end_group
from worker.places import make_places, places_of
from worker.stage_process import END_OF_LOG

_log = logging.getLogger("nerfworks.worker")
_LINE_BYTES = 8_192
_EXIT_WAIT_S = 5.0
_NO_MEMORY = ("std::bad_alloc", "Cannot allocate memory", "MemoryError", "out of memory")
_said: list[str] = []  # how stages are contained, as the log was told


def oom_kills() -> int:
    """How many processes the kernel has killed for memory, in our control group or at all."""
    total = 0
    for path in ("/sys/fs/cgroup/memory.events", "/proc/vmstat"):
        with contextlib.suppress(OSError, ValueError):
            for line in Path(path).read_text().splitlines():
                name, _, value = line.partition(" ")
                if name == "oom_kill":
                    total += int(value)
    return total


class StageProcess:
    """A warm child. One run at a time; not safe for several threads at once.

    registry: dotted name of the stages' registry. plan: what it may touch. preload: names of
    stages whose code it loads while it is idle.
    messages: what the child sent, ending with {"type": "exit"} when it is gone. contained: what
    holds it in, once it has said so.
    """

    def __init__(self, registry: str, plan: Plan, preload: Sequence[str] = ()) -> None:
        self.messages: queue.Queue[dict[str, Any]] = queue.Queue()
        self._on_line: Callable[[str], None] = lambda line: None
        self._log_ended = threading.Event()
        self._run_id = ""
        self._guardian: int | None = None
        self.contained: Containment | None = None
        self._wanted_memory = False  # its last lines said that there was none
        self._oom_before = oom_kills()
        make_places(plan.write)
        self._places = places_of(plan.write)
        message_read, message_write = os.pipe()
        life_read, self._life_write = os.pipe()
        try:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "worker.stage_process"),
                    *("--message-fd", str(message_write), "--life-fd", str(life_read)),
                    *("--plan", plan.to_json(), "--registry", registry, "--preload", *preload),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=(message_write, life_read),
                start_new_session=True,
                env=dict(plan.environment),
            )
        finally:
            os.close(message_write)
            os.close(life_read)
        self._readers = [
            threading.Thread(target=self._read_messages, args=(message_read,), daemon=True),
            threading.Thread(target=self._read_log, daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        """The child's process id, also that of its group."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Whether the child still runs."""
        return self._process.poll() is None

    def is_in_place(self) -> bool:
        """Whether the folders that the child may write to are still those that it was let into."""
        return places_of(self._places) == self._places

    def peak_bytes(self) -> int | None:
        """The most memory the child held since its run began; None where the system does not say,
        or the child is gone."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            for line in Path(f"/proc/{self.pid}/status").read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024
        return None

    def exit_reason(self) -> tuple[int, bool]:
        """(exit status, negative for a signal; whether memory ran out). Only after the exit.

        It ran out where the kernel killed for it, or where the process broke down, as native code
        does, right after it had said that it got none.
        """
        status = self._process.wait(_EXIT_WAIT_S)
        killed = status in (-signal.SIGKILL, 128 + signal.SIGKILL)
        if killed:
            return status, self.memory_ran_out()
        return status, status < 0 and self._wanted_memory

    def memory_ran_out(self) -> bool:
        """Whether the kernel killed something for memory since the run began."""
        return oom_kills() > self._oom_before

    def start_run(self, run_id: str, on_line: Callable[[str], None], **command: Any) -> None:
        """Start a run. Raises BrokenPipeError where the child is gone."""
        self._run_id, self._on_line = run_id, on_line
        self._oom_before, self._wanted_memory = oom_kills(), False
        self._log_ended.clear()
        self._send({"do": "run", "run_id": run_id, **command})

    def ask_to_stop(self, reason: str) -> None:
        """Ask the stage to stop at its next report of progress.

        reason: "shutdown" lets it save what it has; "cancel" or "lost" means that nobody wants it.
        """
        with contextlib.suppress(BrokenPipeError):
            self._send({"do": "stop", "run_id": self._run_id, "reason": reason})

    def finish_log(self, timeout_s: float) -> None:
        """Wait until the last line of the run has arrived."""
        self._log_ended.wait(timeout_s)
        self._on_line = lambda line: None

    def end_leftovers(self) -> int:
        """Kill what the last run started and left behind; how many."""
        if self._guardian is None:
            return 0  # it never got so far as to run anything
        return end_group(self.pid, spare={self.pid, self._guardian})

    def kill(self) -> None:
        """Kill the child and its group, and wait until it is gone."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        try:
            self._process.wait(_EXIT_WAIT_S)
        except subprocess.TimeoutExpired:
            _log.error("stage process %s does not die: it hangs in the kernel", self.pid)
        self._close()

    def _close(self) -> None:
        if self._life_write >= 0:
            os.close(self._life_write)
            self._life_write = -1
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()

    def _send(self, command: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write((json.dumps(command) + "\n").encode())
            self._process.stdin.flush()
        except (OSError, ValueError) as error:
            raise BrokenPipeError("the stage process is gone") from error

    def _read_messages(self, descriptor: int) -> None:
        with os.fdopen(descriptor, encoding="utf-8") as file:
            for line in file:
                try:
                    message = json.loads(line)
                except ValueError:
                    break  # cut off by the child's death
                if message["type"] == "hello":
                    self._greet(message)
                else:
                    self.messages.put(message)
        self._log_ended.set()
        self.messages.put({"type": "exit"})

    def _greet(self, message: dict[str, Any]) -> None:
        """Take note of what the child says of itself; the log hears it once."""
        self._guardian = message["guardian"]
        contained = self.contained = Containment(**message["contained"])
        if (text := contained.as_text()) not in _said:
            _said.append(text)
            _log.log(
                logging.WARNING if contained.lacks else logging.INFO,
                "stages are contained by: %s",
                text,
            )

    def _read_log(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as file:
            while raw := file.readline(_LINE_BYTES):
                line = raw.decode("utf-8", "replace").rstrip("\r\n")
                if line.startswith(END_OF_LOG):
                    if line.removeprefix(END_OF_LOG) == self._run_id:
                        self._log_ended.set()
                elif line:
                    self._wanted_memory |= any(sign in line for sign in _NO_MEMORY)
                    # A progress bar redraws one line with carriage returns: keep its last state.
                    self._on_line(line.rpartition("\r")[2])
