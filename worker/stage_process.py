"""The warm child that runs heavy stages; one per slot: `python -m worker.stage_process`.

It reads commands as JSON lines from stdin and writes messages as JSON lines to a descriptor of its
own; what stages print to stdout and stderr are log lines.

    commands:  {"do": "run", "stage", "options", "root", "seed", "threads", "cpu_s", "temporary",
                "memory", "token", "run_id"}
               {"do": "stop", "run_id", "reason"}, reason "cancel", "lost" or "shutdown"
    messages:  {"type": "hello", "pid", "guardian", "contained"}, the first of all
               {"type": "begun"}, the first of a run
               {"type": "progress", "fraction", "message", "eta_s"}
               {"type": "checkpoint", "path", "files": {name: [bytes, mtime_ns]}}
               {"type": "done", "manifest"} | {"type": "failed", "error"} | {"type": "cancelled"}
    log line:  END_OF_LOG + run_id after the last line of a run

It never outlives its worker. A guardian, forked before anything heavy is loaded, waits for the end
of a pipe that only the worker holds open, and then kills the whole process group: also where the
main thread sits in a long native call and no Python thread can run, and with it the programs that
a stage started. When the stage process itself ends, the guardian kills what it left behind.

Right after that it confines itself (`worker.containment`): nothing that it loads or runs can reach
the worker's keys, the database, or the network. The guardian stays outside.

While nothing is asked of it, it loads the code of the stages that it may be given
(`worker.preloading`), piece by piece; a command waits for one piece at most.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import faulthandler
import gc
import importlib
import json
import logging
import os
import queue
import select
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

from pipelines.errors import Cancelled, PipelineError, ResourceError
from pipelines.manifest import RunHooks, internal_error, run_stage
from pipelines.workspace import Workspace
from worker.containment.apply import apply_plan
from worker.containment.limits import allow_cpu_seconds
from worker.containment.plan import Plan
from worker.locks import FolderInUseError, folder_lock
from worker.outcomes import folder_in_use
from worker.predecessors import holder_note, run_lock
from worker.preloading import preload_steps

END_OF_LOG = "\x01end-of-log "
GUARDIAN_STEP_S = 0.5
PROGRESS_STEP_S = 0.25
PREDECESSOR_TIMEOUT_S = 20.0
OOM_SCORE = 500


def kill_group() -> NoReturn:
    """End this process, its guardian and all that a stage started."""
    os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)


def start_guardian(life_fd: int, message_fd: int) -> int:
    """Fork the process that kills the group when the worker, or this process, is gone. Its pid."""
    parent = os.getpid()
    if (guardian := os.fork()) != 0:
        os.close(life_fd)
        return guardian
    os.close(message_fd)
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    while os.getppid() == parent:
        readable, _, _ = select.select([life_fd], [], [], GUARDIAN_STEP_S)
        if readable and not os.read(life_fd, 1):
            break
    kill_group()


def offer_to_oom_killer() -> None:
    """When memory runs out, let the kernel end this process and not the worker."""
    try:
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE))
    except OSError:
        return  # not Linux, or not allowed: a preference, no more


class PeakMemory:
    """Has the kernel count the most memory that this process holds anew.

    Opened before the process is confined, which closes /proc for writing.
    """

    def __init__(self) -> None:
        self._descriptor = -1
        with contextlib.suppress(OSError):  # not Linux, or not allowed: then it is that of all runs
            self._descriptor = os.open("/proc/self/clear_refs", os.O_WRONLY | os.O_CLOEXEC)

    def forget(self) -> None:
        """Before the next run."""
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.write(self._descriptor, b"5")


@contextlib.contextmanager
def temporary_folder(path: Path) -> Iterator[None]:
    """Where the run's temporary files go; removed with all that is in it."""
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    usual = os.environ["TMPDIR"]
    os.environ["TMPDIR"] = tempfile.tempdir = str(path)
    try:
        yield
    finally:
        os.environ["TMPDIR"] = tempfile.tempdir = usual
        shutil.rmtree(path, ignore_errors=True)


def error_of(error: BaseException, stage: str) -> dict[str, Any]:
    """What the API will show of an exception. Foreign texts stay out: they may hold paths."""
    if isinstance(error, PipelineError):
        return error.as_dict()
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return ResourceError(
            f"Memory ran out during {stage}.",
            code="out_of_memory",
            hint="Use a smaller preset, or fewer or smaller images, or a larger machine.",
        ).as_dict()
    if isinstance(error, FolderInUseError):
        return folder_in_use(stage)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ResourceError(
            f"The disk is full: {stage} could not write its results.",
            code="disk_full",
            hint="Free some space on the worker's disk; then submit the job again.",
        ).as_dict()
    return internal_error(stage, error).as_dict()


class Messages:
    """Writes messages to the worker; a worker that is gone ends this process."""

    def __init__(self, descriptor: int) -> None:
        self._file = os.fdopen(descriptor, "w", encoding="utf-8")
        self._lock = threading.Lock()

    def send(self, kind: str, **fields: Any) -> None:
        """Write one message."""
        line = json.dumps({"type": kind, **fields})
        with self._lock:
            try:
                self._file.write(line + "\n")
                self._file.flush()
            except BrokenPipeError:
                kill_group()


class Run:
    """One run of one stage."""

    def __init__(
        self, command: dict[str, Any], messages: Messages, stops: dict[str, str], registry: str
    ) -> None:
        self._registry = registry
        self._run_id: str = command["run_id"]
        self._stage_name: str = command["stage"]
        self._command = command
        self._messages = messages
        self._stops = stops
        self._workspace = Workspace(Path(command["root"]))
        self._progress_at = 0.0
        self._snapshots = 0

    def execute(self) -> None:
        """Run the stage and send how it ended."""
        self._messages.send("begun")
        allow_cpu_seconds(self._command["cpu_s"])
        # What stages and libraries that they load for the first time ask (`use_all_cores`).
        os.environ["OMP_NUM_THREADS"] = str(self._command["threads"])
        root, lock = self._workspace.root, run_lock(self._stage_name)
        note = holder_note(self._command["token"])
        try:
            with (
                folder_lock(root, lock, PREDECESSOR_TIMEOUT_S, note),
                temporary_folder(Path(self._command["temporary"])),
            ):
                manifest = self._run()
        except Cancelled:
            ending: tuple[str, dict[str, Any]] = ("cancelled", {})
        except Exception as error:
            expected = isinstance(error, PipelineError)
            logging.getLogger("nerfworks.stage").error(
                "%s failed: %s", self._stage_name, error, exc_info=not expected
            )
            ending = ("failed", {"error": error_of(error, self._stage_name)})
        else:
            ending = ("done", {"manifest": manifest})
        sys.stdout.flush()
        sys.stderr.flush()
        os.write(1, f"{END_OF_LOG}{self._run_id}\n".encode())
        self._messages.send(ending[0], **ending[1])

    def _run(self) -> dict[str, Any]:
        registry = importlib.import_module(self._registry)
        return run_stage(
            registry.get_stage(self._stage_name),
            self._command["options"],
            self._workspace,
            seed=self._command["seed"],
            memory=self._command["memory"],
            hooks=RunHooks(
                on_progress=self._on_progress,
                is_cancelled=lambda: self._run_id in self._stops,
                is_shutdown=lambda: self._stops.get(self._run_id) == "shutdown",
                on_checkpoint=self._on_checkpoint,
            ),
        )

    def _on_progress(self, fraction: float, message: str, eta_s: float | None) -> None:
        moment = time.monotonic()
        if moment - self._progress_at >= PROGRESS_STEP_S or fraction >= 1.0:
            self._progress_at = moment
            self._messages.send("progress", fraction=fraction, message=message, eta_s=eta_s)

    def _on_checkpoint(self) -> None:
        """Hold the state as it is now, by hard links, to upload it while the stage goes on.

        A stage replaces checkpoint files and never writes into old ones; sizes and times are noted
        so that the worker notices one that does.
        """
        source = self._workspace.checkpoint(self._stage_name)
        self._snapshots += 1
        target = source.with_name(f"{self._stage_name}.saved-{self._run_id}-{self._snapshots}")
        shutil.rmtree(target, ignore_errors=True)
        files: dict[str, list[int]] = {}
        for path in sorted(source.rglob("*")):
            if path.is_file():
                name = path.relative_to(source).as_posix()
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                os.link(path, target / name)
                found = path.stat()
                files[name] = [found.st_size, found.st_mtime_ns]
        self._messages.send("checkpoint", path=str(target), files=files)


def read_commands(commands: queue.Queue[dict[str, Any]], stops: dict[str, str]) -> None:
    """Take commands from stdin; its end means that the worker is gone."""
    for line in sys.stdin:
        command = json.loads(line)
        if command["do"] == "stop":
            stops[command["run_id"]] = command["reason"]
        else:
            commands.put(command)
    kill_group()


def next_command(commands: queue.Queue[dict[str, Any]], pieces: Iterator[object]) -> dict[str, Any]:
    """The next command; until there is one, do one piece of what can be done in advance."""
    while commands.empty() and next(pieces, None) is not None:
        tidy_memory()
    return commands.get()


def tidy_memory() -> None:
    """Give back what the last stage held: the process stays, its caches need not.

    What outlives a collection is code and tables of modules; freezing it makes the next collection
    look at what is new only. Without, each stage would begin some tenths of a second later.
    """
    gc.collect()
    gc.freeze()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def main() -> None:
    """Serve runs until the worker ends or kills this process."""
    parser = argparse.ArgumentParser(description="Runs stages for a worker; not for people.")
    parser.add_argument("--message-fd", type=int, required=True)
    parser.add_argument("--life-fd", type=int, required=True)
    parser.add_argument("--registry", required=True)
    parser.add_argument("--plan", required=True, help="what it may touch")
    parser.add_argument("--preload", nargs="*", default=[], help="stages to load in advance")
    arguments = parser.parse_args()
    guardian = start_guardian(arguments.life_fd, arguments.message_fd)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.set_inheritable(arguments.message_fd, False)
    offer_to_oom_killer()
    peak = PeakMemory()
    contained = apply_plan(Plan.of_json(arguments.plan))  # before there are other threads
    faulthandler.enable()
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s"
    )
    messages = Messages(arguments.message_fd)
    commands: queue.Queue[dict[str, Any]] = queue.Queue()
    stops: dict[str, str] = {}  # by run, why it should end
    threading.Thread(target=read_commands, args=(commands, stops), daemon=True).start()
    messages.send("hello", pid=os.getpid(), guardian=guardian, contained=asdict(contained))
    pieces = preload_steps(arguments.registry, arguments.preload)
    while True:
        command = next_command(commands, pieces)
        peak.forget()
        Run(command, messages, stops, arguments.registry).execute()
        stops.pop(command["run_id"], None)
        tidy_memory()


if __name__ == "__main__":
    main()
