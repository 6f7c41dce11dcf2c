"""The Triton kernels as the compilers for several GPUs make them: do they fit, and are they lean?

The kernels are compiled in a process of their own: others may be interpreting them.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.services import missing

ROOT = Path(__file__).resolve().parents[6]
LIMIT_S = 300
WHOLE, LARGEST = "90", ("75", "80", "120")
GRID_KERNELS = {"forward_kernel", "table_gradient_kernel", "point_gradient_kernel"}
SHARED_KIB = {75: 64, 80: 163, 90: 227, 120: 99}
"""One block's share. Source: CUDA C++ programming guide, "Technical specifications per compute
capability"."""

Kernel = dict[str, Any]


def printed(module: str, cache: Path, *arguments: str) -> str:
    """What a module beside this one prints, with an empty cache of Triton's."""
    if importlib.util.find_spec("triton") is None:
        missing("Triton")
    environment = dict(os.environ, OMP_NUM_THREADS="1", TRITON_CACHE_DIR=str(cache))
    environment.pop("TRITON_INTERPRET", None)
    answer = subprocess.run(
        [sys.executable, "-m", f"tests.unit.pipelines.nerf.engines.gpu.{module}", *arguments],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert answer.returncode == 0, answer.stderr[-4000:]
    return answer.stdout


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> list[Kernel]:
    """Everything that `compile_kernels` tells of the kernels."""
    cache = tmp_path_factory.mktemp("triton")
    lines = printed("compile_kernels", cache, WHOLE, *LARGEST).splitlines()
    return [json.loads(line) for line in lines]


def is_grid(kernel: Kernel) -> bool:
    return "F" in kernel["constants"]


def count(kernel: Kernel, start: str) -> int:
    """Machine instructions whose names begin so."""
    return sum(n for name, n in kernel["instructions"].items() if name.startswith(start))


def chosen(kernels: list[Kernel], wanted: Callable[[Kernel], bool]) -> list[Kernel]:
    found = [kernel for kernel in kernels if wanted(kernel)]
    assert found
    return found


def test_every_kernel_of_training_and_rendering_is_compiled(kernels: list[Kernel]) -> None:
    hopper = [kernel for kernel in kernels if kernel["arch"] == 90]
    assert {kernel["name"] for kernel in hopper if is_grid(kernel)} == GRID_KERNELS
    # Forward: two grids in training, both again on half-precision copies. Backward: two tables and
    # the points of the field. Three networks, forward and backward.
    assert len(hopper) == (2 + 2) + (2 + 1) + 2 * 3
    assert {kernel["arch"] for kernel in kernels} == {75, 80, 90, 120}


def test_nothing_is_spilled_and_shared_memory_suffices(kernels: list[Kernel]) -> None:
    for kernel in kernels:
        assert kernel["stack"] == kernel["local"] == 0, kernel
        assert count(kernel, "LDL") == count(kernel, "STL") == 0, kernel
        assert kernel["shared"] <= SHARED_KIB[kernel["arch"]] * 1024, kernel
        assert kernel["registers"] <= 255


def test_grids_leave_room_for_many_reads_under_way(kernels: list[Kernel]) -> None:
    # Eight or sixteen reads of a thread at once: a third of the threads hides a miss in the cache.
    for kernel in chosen(kernels, is_grid):
        assert kernel["resident_share"] >= 0.4, kernel


def test_two_features_are_read_by_one_load(kernels: list[Kernel]) -> None:
    def reads_floats(kernel: Kernel) -> bool:
        return kernel["name"] == "forward_kernel" and is_grid(kernel)

    for kernel in chosen(kernels, reads_floats):
        points = kernel["constants"]["B"] // (32 * kernel["warps"])
        wide = count(kernel, "LDG.E.64")
        if kernel["constants"]["IS_HALF"]:
            # Two float16 are one word; three coordinates besides.
            assert count(kernel, "LDG.E") - wide <= (8 + 3) * points + 3
        else:
            assert wide >= 8 * points


def test_the_gradient_of_a_table_is_added_without_waiting(kernels: list[Kernel]) -> None:
    for kernel in chosen(kernels, lambda k: k["name"] == "table_gradient_kernel"):
        points = kernel["constants"]["B"] // (32 * kernel["warps"])
        # Two features by one addition where the GPU has it; what ATOM would give back, nobody asks.
        parts = 1 if kernel["arch"] >= 90 else 2
        assert count(kernel, "RED") == 8 * points * parts, kernel
        assert count(kernel, "ATOM") == 0


def test_grids_divide_nothing(kernels: list[Kernel]) -> None:
    # Remainders are masks; a division would show as a reciprocal.
    for kernel in chosen(kernels, is_grid):
        assert count(kernel, "MUFU") == 0, kernel


def test_networks_use_the_matrix_units(kernels: list[Kernel]) -> None:
    for kernel in chosen(kernels, lambda k: not is_grid(k)):
        assert count(kernel, "HMMA") + count(kernel, "HGMMA") > 0, kernel


def test_no_kernel_is_compiled_once_a_kind_of_step_has_run(tmp_path: Path) -> None:
    """Compiling while a CUDA graph is captured would break it."""
    steps = json.loads(printed("pretend_launches", tmp_path))
    kinds: dict[str, int] = {}
    before = 0
    for kind, compiled, _ in steps:
        if kind in kinds:
            assert compiled == before, steps
        kinds[kind] = kinds.get(kind, 0) + 1
        before = compiled
    assert set(kinds) == {"True True", "True False", "False True", "False False"}
    # Three grids forward; backward the field's table and points, with an update two tables more.
    launched = [number for _, _, number in steps]
    each = {after - earlier for earlier, after in itertools.pairwise(launched)}
    assert each == {3 + 2, 3 + 2 + 2}
