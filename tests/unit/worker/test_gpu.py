"""Whether a worker says that it has a GPU: real processes, with a stand-in for NVIDIA's driver.

The stand-in is a library in C that starts as the driver does: it names a thread by writing to a
file of it, and gives error 304 where it must not. In the place of PyTorch with CUDA, which has
gigabytes, is a module that adds numbers up; in that of Triton, one that calls the C compiler as
Triton does, runs what that made, and keeps it for the next process.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from storage.settings import StorageSettings
from worker.__main__ import main
from worker.containment import landlock
from worker.containment.planning import make_plan
from worker.gpu import Trial, detect_gpu, find_gpu, try_gpu
from worker.settings import WorkerSettings

COMPILER = shutil.which("cc")
DRIVER = r"""
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

static int opens(const char *path, int how) {
    int found = open(path, how, 0600);
    if (found >= 0) close(found);
    return found >= 0;
}

int cuInit(unsigned flags) {
    const char *mode = getenv("NVIDIA_STAND_IN"), *secret = getenv("NVIDIA_SECRET");
    char name[64];
    if (!strcmp(mode, "crashes")) abort();
    if (!strcmp(mode, "hangs")) for (;;) pause();
    if (!strcmp(mode, "is too old")) return 803;
    if (!strcmp(mode, "needs what is closed")) return opens(secret, O_RDONLY) ? 0 : 304;
    if (!strcmp(mode, "wakes outside")) {
        const char *woken = getenv("NVIDIA_WOKEN");
        if (opens(woken, O_RDONLY)) return 0;
        return opens(secret, O_RDONLY) && opens(woken, O_CREAT | O_WRONLY) ? 0 : 999;
    }
    snprintf(name, sizeof name, "/proc/self/task/%ld/comm", syscall(SYS_gettid));
    return opens(name, O_RDWR) ? 0 : 304;
}

int cuGetErrorString(int error, const char **text) { *text = "OS call failed"; return 0; }
"""
TORCH = """
class ones:
    def __init__(self, count, device):
        assert device == "cuda"
        self.count = count
    def sum(self):
        return self.count
"""
TRITON = """
import ctypes, os, shutil, subprocess, tempfile
def cdiv(a, b):
    return -(-a // b)
def jit(kernel):
    return Kernel()
class Kernel:
    def __getitem__(self, grid):
        return self.launch
    def launch(self, numbers, count, block):
        kept = os.environ.get("TRITON_CACHE_DIR") or os.path.expanduser("~/.triton/cache")
        library = os.path.join(kept, "launcher.so")
        if not os.path.exists(library):
            self.compile(library)
        numbers.count = ctypes.CDLL(library).twice(numbers.count)
    def compile(self, library):
        os.makedirs(os.path.dirname(library), exist_ok=True)
        compiler = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
        with tempfile.TemporaryDirectory() as made:
            source, launcher = os.path.join(made, "launcher.c"), os.path.join(made, "launcher.so")
            with open(source, "w") as file:
                file.write("#include <stddef.h>\\nsize_t twice(size_t n) { return 2 * n; }")
            command = [compiler, source, "-O3", "-shared", "-fPIC", "-o", launcher]
            subprocess.check_call(command, stdout=subprocess.DEVNULL)
            shutil.copy(launcher, library)
"""

confined = pytest.mark.skipif(
    landlock.version() < landlock.OLDEST,
    reason="containment is NOT tested: this kernel has no Landlock",
)


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a libcuda.so.1."""
    if sys.platform != "linux" or COMPILER is None:
        pytest.skip("how a GPU is tried is NOT tested: no Linux, or no C compiler for a stand-in")
    folder = tmp_path_factory.mktemp("driver")
    made = [COMPILER, "-shared", "-fPIC", "-x", "c", "-", "-o", str(folder / "libcuda.so.1")]
    subprocess.run(made, input=DRIVER, text=True, check=True)
    return folder


@pytest.fixture
def machine(driver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with a GPU, its driver and a PyTorch for it; the folder of the latter."""
    (tmp_path / "secret").write_text("x")
    torch = tmp_path / "torch"
    torch.mkdir()
    (torch / "torch.py").write_text(TORCH)
    (torch / "triton").mkdir()
    (torch / "triton" / "__init__.py").write_text(TRITON)
    (torch / "triton" / "language.py").write_text("constexpr = int")
    monkeypatch.setattr("worker.gpu.detect_gpu", lambda: True)
    monkeypatch.setenv("LD_LIBRARY_PATH", str(driver))
    monkeypatch.setenv("PYTHONPATH", str(torch))
    monkeypatch.syspath_prepend(str(torch))  # a plan opens what Python reads code from
    monkeypatch.setenv("NVIDIA_STAND_IN", "names threads")
    monkeypatch.setenv("NVIDIA_SECRET", str(tmp_path / "secret"))
    return torch


def is_found(tmp_path: Path, **settings: str) -> bool:
    return find_gpu(StorageSettings(home=tmp_path / "home"), WorkerSettings(**settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("hidden", ["", "-1"])
def test_a_hidden_gpu_does_not_count(monkeypatch: pytest.MonkeyPatch, hidden: str) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
    assert detect_gpu() is False


def test_a_gpu_that_a_contained_process_computes_on_is_used(machine: Path, tmp_path: Path) -> None:
    assert is_found(tmp_path)


@confined
def test_the_driver_starts_where_a_stage_may_name_its_threads_and_not_elsewhere(
    machine: Path, tmp_path: Path
) -> None:
    home = StorageSettings(home=tmp_path / "home")
    plan = make_plan(home, WorkerSettings(), os.environ, has_gpu=True)
    assert try_gpu(plan) == Trial()
    problem = try_gpu(replace(plan, names_threads=False)).problem
    assert problem == "the driver does not start: CUDA error 304, OS call failed"


@confined
def test_a_gpu_that_containment_closes_is_not_used_and_the_log_says_what_to_do(
    machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NVIDIA_STAND_IN", "needs what is closed")
    with caplog.at_level(logging.ERROR):
        assert not is_found(tmp_path)
    (said,) = caplog.messages
    assert "CUDA error 304" in said
    assert "NERFWORKS_WORKER_CONTAIN=off" in said
    assert is_found(tmp_path, contain="off")


@confined
def test_devices_that_the_driver_makes_as_it_first_starts_are_had_then(
    machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NVIDIA_STAND_IN", "wakes outside")
    monkeypatch.setenv("NVIDIA_WOKEN", str(tmp_path / "home" / "cache" / "woken"))
    assert is_found(tmp_path)


@pytest.mark.parametrize(
    ("mode", "reason"), [("is too old", "CUDA error 803"), ("crashes", "ended with status -6")]
)
def test_a_driver_that_does_not_start_anywhere_leaves_the_worker_without_a_gpu(
    machine: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    mode: str,
    reason: str,
) -> None:
    monkeypatch.setenv("NVIDIA_STAND_IN", mode)
    with caplog.at_level(logging.ERROR):
        assert not is_found(tmp_path)
    (said,) = caplog.messages
    assert reason in said
    assert "CONTAIN" not in said


def test_a_driver_that_hangs_does_not_keep_the_worker_from_starting(
    machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NVIDIA_STAND_IN", "hangs")
    monkeypatch.setattr("worker.gpu._TRIAL_S", 3.0)
    wait = subprocess.Popen.wait

    def wait_for_others(process: subprocess.Popen[str], *args: Any, **named: Any) -> int:
        # What hangs in the kernel outlives its kill, so nobody may wait for its end.
        assert "worker.gpu_trial" not in process.args, "it was waited for"  # type: ignore[operator]
        return wait(process, *args, **named)

    monkeypatch.setattr(subprocess.Popen, "wait", wait_for_others)
    with caplog.at_level(logging.ERROR):
        assert not is_found(tmp_path)
    assert caplog.messages == ["This machine's GPU is not used: it did not answer within 3 s"]


def test_a_pytorch_that_cannot_compute_on_the_gpu_is_named(
    machine: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (machine / "torch.py").write_text(
        "__version__ = '2.13.0'\n"
        "def ones(*args, **kwargs):\n"
        "    raise RuntimeError('no kernel image is available\\nmore')\n"
    )
    with caplog.at_level(logging.ERROR):
        assert not is_found(tmp_path)
    assert caplog.messages == [
        "This machine's GPU is not used: PyTorch 2.13.0 cannot compute on it: "
        "no kernel image is available"
    ]


@confined
def test_a_compiler_that_lies_away_from_the_system_compiles_for_contained_stages(
    machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "toolchain"
    for name in ("bin", "lib"):
        (folder / name).mkdir(parents=True)
    (folder / "lib" / "stddef.h").write_text("typedef unsigned long size_t;\n")
    wrapper = folder / "bin" / "gcc"
    wrapper.write_text(f'#!/bin/sh\nexec {COMPILER} -isystem {folder}/lib "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("CC", str(wrapper))
    with caplog.at_level(logging.ERROR):
        assert is_found(tmp_path)
    assert not caplog.messages
    # What was seen on a real machine: the program open, its headers closed.
    monkeypatch.setattr("worker.containment.planning.compiler_folders", lambda _: [wrapper.parent])
    with caplog.at_level(logging.ERROR):
        assert is_found(tmp_path)
    (said,) = caplog.messages
    assert f"{folder}/lib/stddef.h: Permission denied" in said
    assert "ten times slower" in said
    assert "NERFWORKS_WORKER_STAGE_READABLE" in said
    caplog.clear()
    with caplog.at_level(logging.ERROR):
        assert is_found(tmp_path, stage_readable=str(folder / "lib"))
    assert not caplog.messages


def test_a_machine_without_a_compiler_uses_its_gpu_slowly_and_says_so(
    machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", str(tmp_path / "gone"))
    with caplog.at_level(logging.ERROR):
        assert is_found(tmp_path)
    (said,) = caplog.messages
    assert "FileNotFoundError" in said
    assert "It needs a C compiler" in said
    assert "STAGE_READABLE" not in said


@pytest.mark.gpu
@pytest.mark.skipif(
    not torch.cuda.is_available(), reason="a contained GPU is NOT tested: no CUDA device"
)
def test_a_contained_process_computes_on_this_machines_gpu_with_kernels_of_its_own(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR):
        assert is_found(tmp_path)
    assert not caplog.messages


def test_a_worker_for_the_gpu_alone_does_not_start_without_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NERFWORKS_HOME", str(tmp_path))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with pytest.raises(SystemExit, match="serves only the queue gpu"):
        main(["--queues", "gpu"])
