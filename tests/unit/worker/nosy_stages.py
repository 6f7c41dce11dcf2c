"""A registry whose stage does whatever it is told and says what came of it."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipelines.stage import Stage, StageContext
from pipelines.tools.ffmpeg import ffmpeg_version

STAGES = (Stage("ingest", 1, (), (), f"{__name__}:run", "IngestOptions"),)


def get_stage(name: str) -> Stage:
    """The stage of that name."""
    return next(stage for stage in STAGES if stage.name == name)


def run(options: Any, ctx: StageContext) -> dict[str, Any]:
    """Do each of `orders.json`, a list of `[verb, *arguments]`; the summary has what came of it.

    What an order raises is its outcome, unless it is the last: that one may fail the stage.
    """
    del options
    orders = json.loads((ctx.workspace.root / "orders.json").read_text())
    said: list[Any] = []
    for verb, *arguments in orders["tolerant"]:
        try:
            said.append(VERBS[verb](ctx, *arguments))
        except OSError as error:
            said.append(type(error).__name__)
    for verb, *arguments in orders["strict"]:
        said.append(VERBS[verb](ctx, *arguments))
    return {"said": said}


def _read(ctx: StageContext, path: str) -> str:
    with open(path, "rb") as file:
        return file.read(4096).decode("utf-8", "replace")


def _read_by_program(ctx: StageContext, path: str) -> str:
    done = subprocess.run(["cat", path], capture_output=True, check=False)
    return done.stdout.decode("utf-8", "replace")


def _write(ctx: StageContext, path: str) -> str:
    with open(path, "w") as file:
        file.write("nosy")
    return "written"


def _name_thread(ctx: StageContext) -> str:
    """Name another thread, as glibc does for whoever asks for it."""
    end = threading.Event()
    other = threading.Thread(target=end.wait, daemon=True)
    other.start()
    path = Path(f"/proc/self/task/{other.native_id}/comm")
    try:
        descriptor = os.open(path, os.O_RDWR)
        os.write(descriptor, b"nosy")
        os.close(descriptor)
        return path.read_text().strip()
    finally:
        end.set()
        other.join()


def _peek(ctx: StageContext, pid: int) -> str:
    """Read another process's memory by a system call."""
    local, remote = (ctypes.c_size_t * 2)(), (ctypes.c_size_t * 2)(4096, 8)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.process_vm_readv(pid, local, 1, remote, 1, 0) < 0:
        raise OSError(ctypes.get_errno(), "process_vm_readv")
    return "read"


def _trace(ctx: StageContext, pid: int) -> str:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.ptrace(0x4206, pid, None, None) < 0:  # PTRACE_SEIZE
        raise OSError(ctypes.get_errno(), "ptrace")
    return "traced"


def _connect(ctx: StageContext, family: str, address: Any) -> str:
    with socket.socket(getattr(socket, family)) as made:
        made.connect(tuple(address) if isinstance(address, list) else address)
    return "connected"


def _escape(ctx: StageContext) -> int:
    """Leave a process behind that did all it could to be nobody's child."""
    reader, writer = os.pipe()
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            os.setpgid(0, 0)
            os.write(writer, str(os.getpid()).encode())
            time.sleep(600)
        os._exit(0)
    os.wait()
    return int(os.read(reader, 20))


def _fork_bomb(ctx: StageContext, wanted: int) -> int:
    """Start processes that stay until one is refused; how many there were."""
    started: list[int] = []
    try:
        while len(started) < wanted:
            if (pid := os.fork()) == 0:
                time.sleep(600)
                os._exit(0)
            started.append(pid)
    except BlockingIOError:
        pass
    for pid in started:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    return len(started)


def _fill_file(ctx: StageContext, num_bytes: int) -> str:
    with (ctx.out / "big").open("wb") as file:
        for _ in range(num_bytes >> 16):
            file.write(bytes(1 << 16))
    return "filled"


def _open_files(ctx: StageContext, wanted: int) -> int:
    opened: list[int] = []
    try:
        while len(opened) < wanted:
            opened.append(os.open(os.devnull, os.O_RDONLY))
    except OSError:
        pass
    for descriptor in opened:
        os.close(descriptor)
    return len(opened)


def _spin(ctx: StageContext) -> None:
    while True:
        pass


def _litter(ctx: StageContext) -> str:
    folder = Path(tempfile.mkdtemp())
    (folder / "left").write_text("left")
    program = "import tempfile; print(tempfile.mkdtemp())"
    subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)
    return str(folder)


def _work(ctx: StageContext) -> str:
    """What every real stage does, in short."""
    (ctx.out / "a" / "b").mkdir(parents=True)
    (ctx.out / "draft").write_text("x")
    os.replace(ctx.out / "draft", ctx.out / "a" / "b" / "final")
    os.link(ctx.out / "a" / "b" / "final", ctx.out / "linked")
    (ctx.checkpoint / "state").write_text("x")
    ctx.checkpoint_saved()
    Path("/proc/self/status").read_text()
    Path(os.environ["NUMBA_CACHE_DIR"], "kernel").write_text("x")
    Path("~").expanduser().joinpath("cached").write_text("x")
    with tempfile.NamedTemporaryFile(dir="/dev/shm") as shared:
        shared.write(b"x")
    # Imported where it runs: numpy's threads come and go with forks, and `_fork_bomb` counts those.
    from pipelines.captures.decoders import open_picture

    for name, kind, size in (("photo.heic", "HEIF", (96, 64)), ("photo.dng", "TIFF", (96, 64))):
        with open_picture(ctx.workspace.root / name, kind) as image:
            image.load()
            assert image.size == size
    return ffmpeg_version()


VERBS: dict[str, Callable[..., Any]] = {
    "read": _read,
    "read_by_program": _read_by_program,
    "write": _write,
    "name_thread": _name_thread,
    "peek": _peek,
    "trace": _trace,
    "connect": _connect,
    "escape": _escape,
    "fork_bomb": _fork_bomb,
    "fill_file": _fill_file,
    "open_files": _open_files,
    "spin": _spin,
    "litter": _litter,
    "work": _work,
    "kill": lambda ctx, pid, number: os.kill(pid, number),
    "symlink": lambda ctx, target: os.symlink(target, ctx.out / "link"),
    "link": lambda ctx, target: os.link(target, ctx.out / "link"),
    "allocate": lambda ctx, num_bytes: len(bytearray(num_bytes)),
    "environment": lambda ctx: dict(os.environ),
    "environment_of_program": lambda ctx: (
        subprocess.run(["env"], capture_output=True, check=True, text=True).stdout
    ),
    "die": lambda ctx: os.kill(os.getpid(), signal.SIGKILL),
}
