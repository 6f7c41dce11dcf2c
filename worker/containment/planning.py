"""What a stage may touch: worked out by the worker, given to its stage processes as JSON.

A stage reads the code that it runs, the system's programs and libraries, and devices; it reads and
writes the folder of jobs, caches, and its temporary folder inside its job's. Everything else is
closed: the rest of the home (keys, database, objects, logs), other people's files, /tmp. Where
something closed lies inside something open, such as the default home inside a checkout, the open
folder's other children are opened one by one.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import site
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from storage.settings import StorageSettings
from worker.containment.apply import ContainmentError
from worker.containment.environment import (
    CODE_ROOT,
    TEMPORARY,
    kernel_folder,
    stage_environment,
)
from worker.containment.limits import Limits, default_memory_bytes
from worker.containment.plan import Plan
from worker.containment.toolchain import compiler_folders
from worker.settings import WorkerSettings

_SYSTEM = (
    *("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/nix/store", "/gnu/store"),
    *("/opt/rocm", "/opt/nvidia", "/opt/cuda", "/opt/intel", "/run/opengl-driver", "/run/nvidia"),
    "/run/nvidia-persistenced",
    *("/proc", "/sys"),
)
_SETTINGS = (
    *("ld.so.cache", "ld.so.conf", "ld.so.conf.d", "ld.so.preload", "alternatives", "fonts"),
    *("localtime", "timezone", "passwd", "group", "nsswitch.conf", "os-release", "locale.alias"),
    *("mime.types", "magic", "OpenCL", "vulkan", "glvnd", "nvidia", "ssl", "pki"),
    *("hosts", "host.conf", "resolv.conf", "gai.conf", "ca-certificates"),
)
_DEVICES = ("null", "zero", "full", "random", "urandom", "tty")
_GPUS = ("nvidia*", "dri", "kfd", "dxg", "nvhost*", "nvmap", "nvgpu")
_CACHE_NAMES = (
    *("TRITON_CACHE_DIR", "CUDA_CACHE_PATH", "TORCH_HOME", "XDG_CACHE_HOME"),
    "TORCHINDUCTOR_CACHE_DIR",
)
_WEIGHTS = "NERFWORKS_LPIPS_WEIGHTS"
_GPU_EXPECTED = "NERFWORKS_GPU_EXPECTED"
"""`pipelines.nerf.devices`, whose import takes PyTorch."""


def _children(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def open_except(
    folder: Path, private: Sequence[Path], *, hidden: bool = True
) -> tuple[list[Path], list[Path]]:
    """(paths to open, folders to list) so that all of a folder is open but what is private.

    hidden: whether names that start with a dot are opened too.
    """
    if any(folder.is_relative_to(path) for path in private):
        return [], []
    if hidden and not any(path.is_relative_to(folder) for path in private):
        return [folder], []
    opened, listed = [], [folder]
    for child in _children(folder):
        if hidden or not child.name.startswith("."):
            inner = open_except(child, private)
            opened += inner[0]
            listed += inner[1]
    return opened, listed


def _split(text: str) -> list[Path]:
    return [Path(part).resolve() for part in text.split(os.pathsep) if part]


def _private_paths(storage: StorageSettings) -> list[Path]:
    """What is nobody's business but the service's: the home, database and objects elsewhere."""
    found = [storage.home.resolve()]
    url = storage.resolved_database_url
    if url.startswith("sqlite") and (path := url.partition("///")[2].partition("?")[0]):
        base = Path(path).resolve()
        found += [base, *(base.with_name(base.name + end) for end in ("-wal", "-shm", "-journal"))]
    if storage.resolved_objects_url.startswith("file:"):
        found.append(Path(storage.resolved_objects_url.removeprefix("file://")).resolve())
    return found


def _libraries(environment: Mapping[str, str]) -> list[Path]:
    """Folders that hold programs and libraries as a whole."""
    found = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.exec_prefix)]
    found += [Path(path) for path in site.getsitepackages()]
    found.append(Path(site.getusersitepackages()))
    for name in ("PATH", "LD_LIBRARY_PATH"):
        found += _split(environment.get(name, ""))
    if program := environment.get("NERFWORKS_FFMPEG"):
        found.append(Path(program).resolve().parent)
    return [path.resolve() for path in found]


def _code() -> list[Path]:
    """Folders of Python code that may be a checkout's root, with other things beside the code.

    Not the current folder, which `python -m` puts in front: it may be anything.
    """
    found = [Path(path).resolve() for path in sys.path if path]
    return [CODE_ROOT, *(path for path in found if path != Path.cwd())]


def _existing(paths: Iterable[Path]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(str(path) for path in paths if path.exists()))


def _make_gpu_devices() -> None:
    """Have NVIDIA's driver make its devices. It does so at their first use, by a helper that gains
    privileges, and nothing gains any in a contained process."""
    if Path("/dev/nvidia-uvm").exists() or not (helper := shutil.which("nvidia-modprobe")):
        return
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        subprocess.run([helper, "-u", "-c", "0"], capture_output=True, timeout=20, check=False)


def check_plan(plan: Plan) -> None:
    """Try a plan that must be had in a process of its own. Raises ContainmentError with the reason.

    Any other is not tried: what it lacks is said by the first stage process.
    """
    if plan.mode != "required":
        return
    tried = subprocess.run(
        [sys.executable, "-m", "worker.containment", "--plan", plan.to_json()],
        env=dict(plan.environment),
        capture_output=True,
        text=True,
        check=False,
    )
    if tried.returncode != 0:
        raise ContainmentError(tried.stderr.strip())


def make_plan(
    storage: StorageSettings,
    settings: WorkerSettings,
    environment: Mapping[str, str],
    *,
    has_gpu: bool,
) -> Plan:
    """What the stages of a worker may touch. Makes the folders that they write to.

    environment: the worker's own.
    """
    home = storage.home.resolve() / "cache" / "home"
    names = [name.strip() for name in settings.stage_environment.split(",") if name.strip()]
    given = stage_environment(environment, home=home, more=names)
    if has_gpu:
        given[_GPU_EXPECTED] = "1"
    private = _private_paths(storage)
    weights = [part.strip() for part in environment.get(_WEIGHTS, "").split(",") if part.strip()]
    remote = any("://" in source for source in weights)

    caches = [Path(given[name]) for name in _CACHE_NAMES if given.get(name)]
    write = [storage.work_dir, home.parent, kernel_folder(environment), *caches]
    for folder in write:
        folder.mkdir(parents=True, exist_ok=True)
    (home / TEMPORARY).mkdir(parents=True, exist_ok=True)

    opened: list[Path] = [Path(source).resolve() for source in weights if "://" not in source]
    opened += [Path("/etc") / name for name in _SETTINGS]
    opened += _split(settings.stage_readable)
    listed: list[Path] = []
    libraries = [*(Path(path) for path in _SYSTEM), *_libraries(environment)]
    if has_gpu:  # Triton calls a C compiler
        libraries += compiler_folders(given)
    for folder, hidden in (
        *((path, True) for path in libraries),
        *((path, False) for path in _code()),
    ):
        if any(folder.is_relative_to(path) for path in opened if path.is_dir()):
            continue  # within another
        inner = open_except(folder, private, hidden=hidden)
        opened += inner[0]
        listed += inner[1]
    devices = [Path("/dev") / name for name in _DEVICES]
    if has_gpu:
        _make_gpu_devices()
        devices += [path for pattern in _GPUS for path in Path("/dev").glob(pattern)]
    memory = settings.stage_memory_bytes
    if memory is None:
        memory = 0 if has_gpu else default_memory_bytes()
    return Plan(
        mode=settings.contain,
        read=_existing(opened),
        list=_existing(listed),
        write=_existing([*write, *_split(settings.stage_writable), Path("/dev/shm")]),  # noqa: S108
        devices=_existing(devices),
        limits=Limits(
            memory, settings.stage_file_bytes, settings.stage_processes, settings.stage_open_files
        ),
        network=remote,
        unix_sockets=has_gpu,
        names_threads=has_gpu,
        environment=given,
    )
