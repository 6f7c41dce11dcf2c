"""Compiles the kernels of a job before the job waits for them.

    python -m pipelines.nerf.compiling PART [--background] < list-of-options.json

A part is a tiny job on made data (`pipelines.nerf.made_jobs`): some depth maps, two steps of
`train`, or one picture of `Renderer`. numba compiles with one thread a process; `compile_kernels`
therefore runs the parts in processes of their own, side by side, and on two cores nobody waits for
more than the longer one.

Files in the cache folder: `PART.lock` is held by who compiles, so that others wait instead of
compiling the same; `PART.progress` says how far it is; `PART-KIND.done` says that all is compiled
for options of a kind. Kinds differ where the types of a kernel's arguments may.

A background compiler has the least priority and writes its process id into the lock. Who waits for
it and sees that it gets less than half a processor ends it and compiles in its place: kernels that
it had finished stay.

Neither torch nor numba is loaded before there is something to compile: a worker asks at each start.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import fcntl
import hashlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from llvmlite.binding import get_host_cpu_name  # type: ignore[import-untyped]

from pipelines.nerf.engines.cpu.parts.kernel_cache import CACHE_FOLDER, file_lock
from pipelines.nerf.options.train import TrainConfig, config_from_dict

PARTS = ("stereo", "training", "rendering")
OnProgress = Callable[[int, int], None]
"""Receives the number of kernels that are compiled, and of those there are at most."""

_log = logging.getLogger("nerfworks.nerf")
_POLL_S = 0.1
_PROGRESS_STEP_S = 0.2
_PATIENCE_S = 2.0


def kind_of(config: TrainConfig) -> str:
    """Options whose kernels take arguments of the same types have the same kind.

    Of numbers it counts whether they are zero, which switches things off; texts and switches count
    as they are. The processor counts too: compiled code is for one.
    """
    values = [config.method, config.engine, _shape(dataclasses.asdict(config.model))]
    machine = [sys.version_info[:2], get_host_cpu_name()]
    text = json.dumps([values, machine], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _shape(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _shape(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_shape(item) for item in value]
    return value if isinstance(value, bool | str | None) else value != 0


def _marker(part: str, config: TrainConfig) -> Path:
    return CACHE_FOLDER / f"{part}-{kind_of(config)}.done"


def parts_to_compile(config: TrainConfig) -> list[str]:
    """The parts that nobody has compiled on this machine so far."""
    return [part for part in PARTS if not _marker(part, config).exists()]


def compile_kernels(config: TrainConfig, on_progress: OnProgress) -> None:
    """Have all kernels compiled that a job with these options launches on the CPU.

    on_progress: called ten times a second while somebody compiles, never when all was there; may
    raise, which ends the compilers that this call started.
    The time counts in `runtime.compile_seconds`. A compiler that fails is logged and no error here:
    the kernels are then compiled where they are used, and that may say why it failed.
    """
    begun = time.monotonic()
    waiting = parts_to_compile(config)
    started: dict[str, subprocess.Popen[bytes]] = {}
    limit = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
    try:
        while waiting or any(process.poll() is None for process in started.values()):
            running = sum(process.poll() is None for process in started.values())
            if waiting and running < max(limit, 1):
                part = waiting.pop(0)
                started[part] = start_compiler(part, config)
            else:
                on_progress(*_progress_of(list(started)))
                time.sleep(_POLL_S)
    finally:
        for part, process in started.items():
            process.kill()
            if status := process.wait():
                _log.warning("the kernels for %s were not compiled: status %s", part, status)
        if started:
            # Here and below: the compiler is loaded where something is compiled, or was.
            from pipelines.nerf.engines.cpu.parts.runtime import count_as_compiling

            count_as_compiling(time.monotonic() - begun)


def start_compiler(part: str, config: TrainConfig) -> subprocess.Popen[bytes]:
    """A process that compiles a part. It ends when this one does."""
    process = subprocess.Popen(
        [sys.executable, "-m", "pipelines.nerf.compiling", part, "--parent", str(os.getpid())],
        stdin=subprocess.PIPE,
        cwd=Path(__file__).resolve().parents[2],
    )
    assert process.stdin is not None
    with process.stdin:
        process.stdin.write(json.dumps([dataclasses.asdict(config)]).encode())
    return process


def _progress_file(part: str) -> Path:
    return CACHE_FOLDER / f"{part}.progress"


def _progress_of(parts: Sequence[str]) -> tuple[int, int]:
    done = known = 0
    for part in parts:
        try:
            one, all_of_them = _progress_file(part).read_text().split()
        except (OSError, ValueError):
            continue  # not begun
        done, known = done + int(one), known + int(all_of_them)
    return done, known


def load_compiled(config: TrainConfig) -> None:
    """Load into this process what lies compiled, so that the first step need not."""
    from pipelines.nerf.made_jobs import run_part

    for part in PARTS:
        if _marker(part, config).exists():
            run_part(part, config)


def _wanted_file(lock: Path) -> Path:
    """By its being there, whoever waits for a lock asks a background compiler to leave it."""
    return lock.with_name(f"{lock.name}.wanted")


def _watch(part: str, parent: int, background: bool) -> None:
    """Say how far the compilation is; end this process when nobody is there to use it, or when it
    stands in the way."""
    from pipelines.nerf.engines.cpu.parts.runtime import kernels_compiled, kernels_known

    path, wanted = _progress_file(part), _wanted_file(CACHE_FOLDER / f"{part}.lock")
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    while os.getppid() == parent and not (background and wanted.exists()):
        if kernels_compiled():
            draft.write_text(f"{kernels_compiled()} {kernels_known()}")
            draft.replace(path)
        time.sleep(_PROGRESS_STEP_S)
    os._exit(1)


def _hold_lock(path: Path, stack: contextlib.ExitStack) -> None:
    """Take a part's lock, also from a background compiler that does not get on."""
    while True:
        try:
            stack.enter_context(file_lock(path, fcntl.LOCK_EX | fcntl.LOCK_NB))
            _wanted_file(path).unlink(missing_ok=True)
            return
        except BlockingIOError:
            holder = path.read_text()
            before, begun = _processor_seconds(holder), time.monotonic()
            time.sleep(_PATIENCE_S)
            after, passed = _processor_seconds(holder), time.monotonic() - begun
            if before is None or after is None or path.read_text() != holder:
                continue
            if after - before < 0.5 * passed:
                try:
                    os.kill(int(holder), signal.SIGTERM)
                except ProcessLookupError:
                    continue
                except PermissionError:  # contained processes do not reach each other
                    _wanted_file(path).touch()


def _processor_seconds(pid: str) -> float | None:
    """Processor time of a process so far; None where it is gone or the system does not say."""
    try:
        fields = Path(f"/proc/{int(pid)}/stat").read_text().rpartition(")")[2].split()
    except (ValueError, OSError):
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(arguments: list[str] | None = None) -> None:
    """Compile one part for options of several kinds, or wait until another process has."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.nerf.compiling")
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--background", action="store_true", help="give way to all other work")
    parser.add_argument("--parent", type=int, default=os.getppid(), help="end with this process")
    chosen = parser.parse_args(arguments)
    part: str = chosen.part
    if chosen.background:
        os.nice(19)
    configs = [config_from_dict(TrainConfig, values) for values in json.loads(sys.stdin.read())]
    if all(_marker(part, config).exists() for config in configs):
        return
    from pipelines.nerf.made_jobs import run_part

    watched = (part, chosen.parent, chosen.background)
    watch = threading.Thread(target=_watch, args=watched, daemon=True)
    watch.start()
    lock = CACHE_FOLDER / f"{part}.lock"
    with contextlib.ExitStack() as stack:
        _hold_lock(lock, stack)
        lock.write_text(str(os.getpid()) if chosen.background else "")
        for config in configs:
            if not _marker(part, config).exists():
                run_part(part, config)
                _marker(part, config).touch()
        _progress_file(part).unlink(missing_ok=True)


if __name__ == "__main__":
    main()
