"""A stage's result is complete or not there, and known to be current or stale."""

from __future__ import annotations

import dataclasses
import errno
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipelines.errors import Cancelled, CaptureError, PipelineError, ResourceError
from pipelines.manifest import (
    RunHooks,
    file_sha256,
    fingerprint,
    input_manifests,
    is_current,
    missing_inputs,
    run_job_locally,
    run_stage,
)
from pipelines.options import ON_REQUEST, stages_skipped
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, STAGES, get_stage
from pipelines.stage import Stage, StageContext
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.archives import nerfstudio_files, picture, write_zip

Body = Callable[[Any, StageContext], dict[str, Any]]


@pytest.fixture
def stage_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[Body], Stage]:
    """A stage with the options of `frames` that runs the given function."""

    def make(body: Body) -> Stage:
        module = types.ModuleType("nerfworks_stage_under_test")
        module.run = body  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
        run = f"{module.__name__}:run"
        return Stage("frames", 1, ("ingest",), ("ingest",), run, "FramesOptions")

    return make


def write_hello(options: Any, ctx: StageContext) -> dict[str, Any]:
    (ctx.out / "sub").mkdir()
    (ctx.out / "sub" / "a.txt").write_text("hello")
    return {"wanted": options.num_frames}


def test_result_is_published_whole_with_its_manifest(
    tmp_path: Path, stage_of: Callable[[Body], Stage]
) -> None:
    workspace = Workspace(tmp_path)
    manifest = run_stage(stage_of(write_hello), {"num_frames": 9}, workspace, seed=5)
    assert workspace.is_complete("frames")
    assert workspace.manifest("frames") == manifest
    (entry,) = manifest["files"]
    assert entry == {
        "path": "sub/a.txt",
        "bytes": 5,
        "sha256": file_sha256(tmp_path / "frames" / "sub" / "a.txt"),
    }
    assert (manifest["summary"], manifest["seed"]) == ({"wanted": 9}, 5)
    assert manifest["options"]["num_frames"] == 9
    assert manifest["options"]["jpeg_quality"] == 95
    assert manifest["timings"]["wall_s"] >= 0
    assert "python" in manifest["versions"]
    assert not workspace.partial("frames").exists()


def test_out_is_empty_at_the_start_and_an_older_result_is_replaced(
    tmp_path: Path, stage_of: Callable[[Body], Stage]
) -> None:
    workspace = Workspace(tmp_path)
    for folder in (workspace.partial("frames"), workspace.stage("frames")):
        folder.mkdir(parents=True)
        (folder / "old.txt").touch()
    run_stage(stage_of(write_hello), {}, workspace)
    assert not (workspace.stage("frames") / "old.txt").exists()


def test_what_a_failed_stage_says_of_itself_is_kept_until_it_runs_again(
    tmp_path: Path, stage_of: Callable[[Body], Stage]
) -> None:
    def fail(options: Any, ctx: StageContext) -> dict[str, Any]:
        (ctx.out / "half.txt").touch()
        (ctx.out / "report.json").write_text('{"why": 1}')
        raise CaptureError("no")

    def cancel(options: Any, ctx: StageContext) -> dict[str, Any]:
        (ctx.out / "report.json").touch()
        raise Cancelled("no more")

    workspace = Workspace(tmp_path)
    with pytest.raises(CaptureError):
        run_stage(stage_of(fail), {}, workspace)
    (kept,) = workspace.failed("frames").iterdir()
    assert kept.read_text() == '{"why": 1}'
    assert not workspace.partial("frames").exists()
    with pytest.raises(Cancelled):
        run_stage(stage_of(cancel), {}, workspace)
    assert not workspace.failed("frames").exists()


def test_failed_stage_leaves_the_checkpoint_and_nothing_else(
    tmp_path: Path, stage_of: Callable[[Body], Stage]
) -> None:
    def fail(options: Any, ctx: StageContext) -> dict[str, Any]:
        (ctx.out / "half.txt").touch()
        (ctx.checkpoint / "state").write_text("step 100")
        raise CaptureError("No.", code="unknown_type")

    workspace = Workspace(tmp_path)
    with pytest.raises(CaptureError):
        run_stage(stage_of(fail), {}, workspace)
    assert not workspace.stage("frames").exists()
    assert not workspace.partial("frames").exists()
    assert (workspace.checkpoint("frames") / "state").read_text() == "step 100"

    def go_on(options: Any, ctx: StageContext) -> dict[str, Any]:
        return {"from": (ctx.checkpoint / "state").read_text()}

    assert run_stage(stage_of(go_on), {}, workspace)["summary"] == {"from": "step 100"}
    assert not workspace.checkpoint("frames").exists()


class OutOfMemoryError(RuntimeError):
    """Stands in torch's place by its name, which is all that is asked for."""


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "disk_full"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), "disk_full"),
        (MemoryError(), "out_of_memory"),
        (OutOfMemoryError("CUDA out of memory"), "out_of_memory"),
    ],
)
def test_what_the_machine_lacks_becomes_a_retryable_error(
    tmp_path: Path, stage_of: Callable[[Body], Stage], error: Exception, code: str
) -> None:
    def fail(options: Any, ctx: StageContext) -> dict[str, Any]:
        raise error

    with pytest.raises(ResourceError) as caught:
        run_stage(stage_of(fail), {}, Workspace(tmp_path))
    assert (caught.value.code, caught.value.retryable) == (code, True)


def test_other_errors_pass_unchanged(tmp_path: Path, stage_of: Callable[[Body], Stage]) -> None:
    def fail(options: Any, ctx: StageContext) -> dict[str, Any]:
        raise FileNotFoundError(errno.ENOENT, "gone")

    with pytest.raises(FileNotFoundError):
        run_stage(stage_of(fail), {}, Workspace(tmp_path))


def test_hooks_reach_the_stage(tmp_path: Path, stage_of: Callable[[Body], Stage]) -> None:
    seen: list[object] = []

    def body(options: Any, ctx: StageContext) -> dict[str, Any]:
        ctx.progress(0.5, "half", 3.0)
        ctx.checkpoint_saved()
        return {"seed": ctx.seed}

    hooks = RunHooks(
        on_progress=lambda *report: seen.append(report), on_checkpoint=lambda: seen.append("saved")
    )
    run_stage(stage_of(body), {}, Workspace(tmp_path), seed=3, hooks=hooks)
    assert seen == [(0.5, "half", 3.0), "saved"]
    with pytest.raises(PipelineError) as caught:
        run_stage(
            stage_of(body), {}, Workspace(tmp_path), hooks=RunHooks(is_cancelled=lambda: True)
        )
    assert caught.value.code == "cancelled"


def test_fingerprint_covers_all_that_shapes_a_result() -> None:
    stage = get_stage("frames")
    base = fingerprint(stage, {"a": 1}, {"ingest": {"content": "x", "seed": 1}})
    assert base == fingerprint(stage, {"a": 1}, {"ingest": {"content": "x", "seed": 2}})
    others = {
        fingerprint(stage, {"a": 2}, {"ingest": {"content": "x"}}),
        fingerprint(stage, {"a": 1}, {"ingest": {"content": "y"}}),
        fingerprint(stage, {"a": 1}, {}),
        fingerprint(stage, {"a": 1}, {"ingest": {"content": "x"}}, seed=1),
        fingerprint(get_stage("poses"), {"a": 1}, {"ingest": {"content": "x"}}),
    }
    assert len(others - {base}) == 5


def capture(workspace: Workspace, files: dict[str, bytes | str]) -> None:
    workspace.capture_file.parent.mkdir(parents=True, exist_ok=True)
    write_zip(workspace.capture_file, files)


def test_job_skips_what_is_current_and_redoes_what_is_stale(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    capture(workspace, nerfstudio_files())
    reused: list[str] = []

    def run(**overrides: Any) -> list[str]:
        reused.clear()
        manifests = run_job_locally(
            workspace,
            "preview",
            overrides,
            kind="nerfstudio",
            on_reused=lambda stage: reused.append(stage.name),
            until="frames",
        )
        assert list(manifests) == ["ingest"]  # no frames for a capture with poses
        return list(reused)

    assert run() == []
    assert run() == ["ingest"]
    assert run(ingest={"max_images": 77}) == []
    assert run(ingest={"max_images": 77}) == ["ingest"]
    capture(workspace, {**nerfstudio_files(), "images/extra.jpg": picture()})
    assert run(ingest={"max_images": 77}) == []


def test_result_with_changed_input_is_not_current(
    tmp_path: Path, stage_of: Callable[[Body], Stage]
) -> None:
    workspace = Workspace(tmp_path)
    capture(workspace, nerfstudio_files())
    run_stage(get_stage("ingest"), {}, workspace)
    stage = stage_of(write_hello)
    run_stage(stage, {}, workspace)
    assert is_current(stage, {}, workspace)
    assert not is_current(stage, {"num_frames": 9}, workspace)
    assert not is_current(stage, {}, workspace, seed=1)
    assert list(input_manifests(stage, workspace)) == ["ingest"]
    run_stage(get_stage("ingest"), {"max_images": 99}, workspace)
    assert is_current(stage, {}, workspace)  # ingest gave the same files again
    capture(workspace, nerfstudio_files(5))
    run_stage(get_stage("ingest"), {}, workspace)
    assert not is_current(stage, {}, workspace)


def test_missing_inputs_leave_out_skipped_stages(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    before = ["ingest", "frames", "poses", "depth"]
    assert missing_inputs("train", "preview", "video", workspace) == before
    assert missing_inputs("train", "preview", "polycam", workspace) == ["ingest", "poses", "depth"]
    assert missing_inputs("report", "draft", "video", workspace) == [
        *before[:3],
        "check",
        "depth",
        "draft",
    ]
    assert missing_inputs("report", "check", "polycam", workspace) == ["ingest", "poses", "check"]


@pytest.fixture
def empty_stages(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The registry's stages, which only write down that they ran, into this list."""
    ran: list[str] = []

    def body(options: Any, ctx: StageContext) -> dict[str, Any]:
        ran.append(ctx.stage)
        return {}

    module = types.ModuleType("nerfworks_stages_under_test")
    module.run = body  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    stages = tuple(dataclasses.replace(stage, run=f"{module.__name__}:run") for stage in STAGES)
    monkeypatch.setattr("pipelines.manifest.STAGES", stages)
    return ran


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("kind", ["video", "polycam"])
def test_a_job_runs_what_neither_capture_nor_preset_leave_out(
    tmp_path: Path, empty_stages: list[str], preset: str, kind: str
) -> None:
    manifests = run_job_locally(Workspace(tmp_path), preset, {}, kind=kind)
    skipped = stages_skipped(preset, kind)
    assert empty_stages == [name for name in STAGE_NAMES if name not in skipped]
    assert list(manifests) == empty_stages


def test_what_is_on_request_runs_where_it_has_options(
    tmp_path: Path, empty_stages: list[str]
) -> None:
    wish = {"views": {"num_views": 3}, "meshvideo": {}}
    run_job_locally(Workspace(tmp_path), "preview", wish, kind="video")
    assert empty_stages == list(STAGE_NAMES)


def test_another_preset_goes_on_from_what_it_shares_and_removes_what_it_skips(
    tmp_path: Path, empty_stages: list[str]
) -> None:
    workspace = Workspace(tmp_path)
    run_job_locally(workspace, "preview", {}, kind="video")
    assert empty_stages == [name for name in STAGE_NAMES if name not in ON_REQUEST]
    empty_stages.clear()
    run_job_locally(workspace, "draft", {}, kind="video")
    assert empty_stages == ["depth", "draft", "report"], "the same frames and poses"
    assert not workspace.stage("train").exists(), "the report must not count it"
