"""How kernels are cached and counted. What they compute is tested beside each of them."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines import nerf
from pipelines.nerf.engines.cpu.parts import kernel_cache, runtime


def _half(values: NDArray[np.floating]) -> NDArray[np.floating]:
    return values / 2


def _double_half(
    share: int, shares: int, values: NDArray[np.floating], out: NDArray[np.floating]
) -> None:
    for index in range(share, len(values), shares):
        out[index] = _compiled_half(values[index])


_compiled_half = runtime.compiled(_half)


def _saved(name: str) -> list[Path]:
    return list(kernel_cache.CACHE_FOLDER.rglob(f"test_runtime.{name}-*.nbi"))


@pytest.fixture
def nothing_saved() -> None:
    for name in ("_half", "_double_half"):
        for path in _saved(name):
            path.unlink()


def test_a_kernel_counts_once_with_all_that_it_calls(nothing_saved: None) -> None:
    kernel = runtime.compiled(_double_half)
    known = runtime.kernels_known()
    kernels, seconds = runtime.kernels_compiled(), runtime.compile_seconds()
    out = np.zeros(4)
    kernel(0, 1, np.arange(4.0), out)
    np.testing.assert_array_equal(out, [0.0, 0.5, 1.0, 1.5])
    assert runtime.kernels_compiled() == kernels + 1
    assert runtime.compile_seconds() > seconds
    again = runtime.compiled(_double_half)
    seconds = runtime.compile_seconds()
    again(0, 1, np.arange(4.0), out)
    assert runtime.compile_seconds() == seconds, "from the cache"
    assert runtime.kernels_compiled() == kernels + 1
    assert runtime.kernels_known() == known + 1


def test_processes_take_turns_at_saving_and_loading(nothing_saved: None) -> None:
    # As another process would: locks belong to open files, not to processes.
    mine = runtime.compiled(_half)
    with ThreadPoolExecutor(1) as pool:
        with kernel_cache.file_lock(kernel_cache.CACHE_FOLDER / "lock", fcntl.LOCK_EX):
            waiting = pool.submit(mine, 3.0)
            with pytest.raises(TimeoutError):
                waiting.result(timeout=1.0)
            assert not _saved("_half")
        assert waiting.result(timeout=60) == 1.5
    assert len(_saved("_half")) == 1


@pytest.mark.parametrize(
    ("source", "constant"),
    [
        ("along_ray/losses.py", "INTERLEVEL_EPS = 1e-7"),
        ("along_ray/intervals.py", "HISTOGRAM_PADDING = 0.01"),
        ("networks/fields.py", "GRADIENT_CLAMP = 15.0"),
        ("space/hash_levels.py", "HASH_PRIMES = (1, 2654435761, 805459861)"),
        ("engines/cpu/parts/lanes.py", "LANES = 16"),
        ("engines/cpu/train/losses.py", "def "),
    ],
)
def test_kernels_are_compiled_anew_when_a_constant_in_them_changes(
    source: str, constant: str, tmp_path: Path
) -> None:
    copied = tmp_path / "nerf"
    shutil.copytree(
        Path(nerf.__file__).parent, copied, ignore=shutil.ignore_patterns("__pycache__")
    )
    version = kernel_cache.kernel_version(copied)
    assert kernel_cache.CACHE_FOLDER.name == f"kernels-{version}"
    text = (copied / source).read_text("utf-8")
    assert constant in text
    (copied / source).write_text(text.replace(constant, f"# changed\n{constant}", 1), "utf-8")
    assert kernel_cache.kernel_version(copied) != version
    (copied / source).write_text(text, "utf-8")
    assert kernel_cache.kernel_version(copied) == version
    # What no kernel is made of may change without compiling anything.
    (copied / "judging" / "metrics.py").write_text("", "utf-8")
    assert kernel_cache.kernel_version(copied) == version


def test_what_one_copy_of_the_sources_has_compiled_serves_another(tmp_path: Path) -> None:
    code = (
        "from pipelines.nerf.engines.cpu.parts import dense_layers, runtime;"
        "import numpy as np, torch;"
        "out = np.zeros((4, dense_layers.TILE), np.float32);"
        "layer = dense_layers.pack_layer(torch.nn.Linear(4, 4));"
        "dense_layers.apply_layer(out, layer, 4, True, False, out.copy());"
        "print(dense_layers.__file__, runtime.compile_seconds())"
    )
    copied = tmp_path / "elsewhere" / "pipelines"
    ours = Path(nerf.__file__).parents[1]
    # As a fresh clone has them: of another day.
    shutil.copytree(
        ours, copied, ignore=shutil.ignore_patterns("__pycache__"), copy_function=shutil.copyfile
    )
    seconds = []
    for root in (ours.parent, copied.parent):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(root)}
        command = [sys.executable, "-P", "-c", code]
        told = subprocess.run(
            command, env=environment, cwd=tmp_path, check=True, capture_output=True, text=True
        )
        file, spent = told.stdout.split()
        assert Path(file).is_relative_to(root)
        seconds.append(float(spent))
    assert seconds[0] > 0.0
    assert seconds[1] == 0.0


def test_a_lock_that_is_held_can_be_refused(tmp_path: Path) -> None:
    exclusive = fcntl.LOCK_EX | fcntl.LOCK_NB
    with (
        kernel_cache.file_lock(tmp_path / "lock", exclusive),
        pytest.raises(BlockingIOError),
        kernel_cache.file_lock(tmp_path / "lock", exclusive),
    ):
        raise AssertionError("both hold it")
    with kernel_cache.file_lock(tmp_path / "lock", exclusive):
        return


def test_shares_leave_no_thread_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "num_threads", lambda: 3)
    before, seen = threading.active_count(), []

    def note(share: int, shares: int) -> None:
        seen.append((share, shares, threading.active_count()))

    runtime.run_threads(note)
    assert sorted(share for share, _, _ in seen) == list(range(3 * runtime.SHARES_PER_THREAD))
    assert threading.active_count() == before
