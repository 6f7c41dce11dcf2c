"""Whether a worker says that it has a GPU: real processes, with a stand-in for NVIDIA's driver.

The stand-in is a library in C that starts as the driver does: it names a thread by writing to a
file of it, and gives error 304 where it must not. In the place of PyTorch with CUDA, which has
gigabytes, is a module that adds numbers up.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from storage.settings import StorageSettings
from worker.__main__ import main
from worker.containment import landlock
from worker.containment.planning import make_plan
from worker.gpu import detect_gpu, find_gpu, trial_problem
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

confined = pytest.mark.skipif(
    landlock.version() < landlock.OLDEST, reason="needs a kernel with Landlock"
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
    assert trial_problem(plan) is None
    problem = trial_problem(replace(plan, names_threads=False))
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
    # What hangs in the kernel outlives its kill, so nobody may wait for its end.
    monkeypatch.setattr(subprocess.Popen, "wait", lambda *_, **__: pytest.fail("it was waited for"))
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


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_contained_process_computes_on_this_machines_gpu(tmp_path: Path) -> None:
    assert is_found(tmp_path)


def test_a_worker_for_the_gpu_alone_does_not_start_without_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NERFWORKS_HOME", str(tmp_path))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with pytest.raises(SystemExit, match="serves only the queue gpu"):
        main(["--queues", "gpu"])
