"""Compiling before anybody waits: it must cover what a job launches, and never stand in its way."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pipelines.nerf import compiling as warm
from pipelines.nerf import made_jobs
from pipelines.nerf.engines.cpu.parts import kernel_cache, runtime
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.options.train import TrainConfig, default_train_config
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import SceneTransform
from pipelines.nerf.stereo.maps import find_depth_maps
from pipelines.nerf.training.loop import train
from pipelines.options import resolve_options, stage_options, train_config
from tests.unit.pipelines.nerf.stereo.painted_wall import row_of_cameras

PREVIEW = train_config(stage_options("train", resolve_options("preview", {})["train"]))


def test_after_warming_up_a_job_compiles_nothing() -> None:
    for part in warm.PARTS:
        made_jobs.run_part(part, PREVIEW)
    before, launched = runtime.compile_seconds(), runtime.kernels_known()
    assert launched > 5
    config = dataclasses.replace(PREVIEW, max_steps=6, rays_per_step=700, device="cpu")
    cameras, images = made_jobs.made_capture()
    model = train(images, cameras, range(3), config, seed=1)
    Renderer(model, SceneTransform((0.1, 0.2, 0.3), 2.0)).render(cameras.resized(7), 1)
    views, _ = row_of_cameras(5)
    assert any(found.z.any() for found in find_depth_maps(views, StereoConfig(num_planes=24)))
    assert runtime.compile_seconds() == before


@pytest.mark.parametrize("method", ["instant-ngp", "nerf"])
def test_every_method_can_be_warmed_up(method: str) -> None:
    config = default_train_config(method)
    small = dataclasses.replace(config, engine="plain")
    made_jobs.run_part("training", small)


def test_options_that_change_only_numbers_are_of_one_kind() -> None:
    base = TrainConfig()
    assert isinstance(base.model, NerfactoConfig)
    other = dataclasses.replace(
        base, max_steps=3, model=dataclasses.replace(base.model, hidden_dim=32)
    )
    assert warm.kind_of(base) == warm.kind_of(other)
    assert base.model.appearance_dim > 0
    without_codes = dataclasses.replace(
        base, model=dataclasses.replace(base.model, appearance_dim=0)
    )
    fewer_rounds = dataclasses.replace(
        base,
        model=dataclasses.replace(
            base.model,
            num_proposal_samples=base.model.num_proposal_samples[:1],
            proposals=base.model.proposals[:1],
        ),
    )
    kinds = {warm.kind_of(item) for item in (base, without_codes, fewer_rounds)}
    assert len(kinds) == 3


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own, here and in processes that are started."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    made = tmp_path / kernel_cache.CACHE_FOLDER.name
    made.mkdir()
    monkeypatch.setattr(warm, "CACHE_FOLDER", made)
    return made


def mark_all(folder: Path) -> None:
    for part in warm.PARTS:
        (folder / f"{part}-{warm.kind_of(PREVIEW)}.done").touch()


def test_nothing_is_started_where_all_is_compiled(folder: Path) -> None:
    mark_all(folder)
    calls: list[tuple[int, int]] = []
    before = runtime.compile_seconds()
    warm.compile_kernels(PREVIEW, lambda done, known: calls.append((done, known)))
    assert calls == []
    assert runtime.compile_seconds() == before


def test_a_compiler_that_has_nothing_to_do_loads_no_compiler(folder: Path) -> None:
    mark_all(folder)
    program = (
        "import sys\n"
        "from pipelines.nerf import compiling\n"
        "compiling.main(['training'])\n"
        "print({'torch', 'numba'} & set(sys.modules))\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps([dataclasses.asdict(PREVIEW)]).encode(),
        capture_output=True,
        check=True,
    )
    assert told.stdout == b"set()\n"
    assert not list(folder.glob("*.lock"))


def test_a_cancel_while_kernels_compile_ends_the_compilers(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = warm.start_compiler

    def remembered(part: str, config: TrainConfig) -> subprocess.Popen[bytes]:
        started.append(start(part, config))
        return started[-1]

    def cancelled(done: int, known: int) -> None:
        raise InterruptedError("the job was cancelled")

    monkeypatch.setattr(warm, "start_compiler", remembered)
    before = runtime.compile_seconds()
    with pytest.raises(InterruptedError):
        warm.compile_kernels(PREVIEW, cancelled)
    assert started
    assert all(process.poll() is not None for process in started)
    assert runtime.compile_seconds() > before, "the wait counts as compiling"


def test_progress_is_the_sum_over_the_parts(folder: Path) -> None:
    (folder / "training.progress").write_text("3 9")
    assert warm._progress_of(warm.PARTS) == (3, 9)
    (folder / "rendering.progress").write_text("1 4")
    assert warm._progress_of(warm.PARTS) == (4, 13)


@contextlib.contextmanager
def holder(path: Path, text: str, seconds: float) -> Iterator[subprocess.Popen[bytes]]:
    """A process that holds the lock for a while and does nothing; `text` may name its {pid}."""
    program = (
        "import fcntl, os, sys, time\n"
        "file = open(sys.argv[1], 'w')\n"
        "fcntl.flock(file, fcntl.LOCK_EX)\n"
        "file.write(sys.argv[2].format(pid=os.getpid())); file.flush()\n"
        "print('held', flush=True)\n"
        "time.sleep(float(sys.argv[3]))\n"
    )
    command = [sys.executable, "-c", program, str(path), text, str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_background_compiler_without_processor_time_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm, "_PATIENCE_S", 0.3)
    with (
        holder(tmp_path / "lock", "{pid}", 600.0) as process,
        contextlib.ExitStack() as stack,
    ):
        warm._hold_lock(tmp_path / "lock", stack)
        assert process.wait(10) == -15
        with pytest.raises(BlockingIOError):
            stack.enter_context(
                kernel_cache.file_lock(tmp_path / "lock", fcntl.LOCK_EX | fcntl.LOCK_NB)
            )


def test_another_jobs_compiler_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm, "_PATIENCE_S", 0.1)
    with holder(tmp_path / "lock", "", 1.5) as process, contextlib.ExitStack() as stack:
        warm._hold_lock(tmp_path / "lock", stack)
        assert process.wait(10) == 0, "it ended by itself"


def test_processor_time_is_that_of_the_process() -> None:
    assert warm._processor_seconds("") is None
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert warm._processor_seconds(str(child.pid)) is not None
    assert warm._processor_seconds(str(child.pid)) is None


def test_a_compiler_ends_with_who_started_it(folder: Path) -> None:
    program = (
        "import os, subprocess, sys\n"
        "command = [sys.executable, '-m', 'pipelines.nerf.compiling', 'training']\n"
        "child = subprocess.Popen([*command, '--parent', str(os.getpid())],"
        " stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)\n"
        "child.stdin.write(b'[{}]'); child.stdin.close()\n"
        "print(child.pid, flush=True)\n"
    )
    parent = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True)
    pid = int(parent.stdout)
    deadline = time.monotonic() + 60
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{pid}").exists()
    assert not list(folder.glob("*.done"))


def test_warming_up_leaves_the_callers_random_numbers_alone() -> None:
    torch.manual_seed(5)
    wanted = torch.rand(3)
    torch.manual_seed(5)
    made_jobs.run_part("training", PREVIEW)
    assert torch.equal(torch.rand(3), wanted)
