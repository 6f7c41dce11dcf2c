"""Running one stage on a local folder, and the manifest that makes its result worth keeping.

A stage writes to `.partial/<stage>`; its manifest is written last; then the folder is renamed to
`<stage>`. So a folder with a manifest is complete, and a crash leaves nothing that looks so. The
command (`pipelines.cli`) and the workers call `run_stage` alike.

`fingerprint` says whether a result still stands: it covers the stage and its version, the resolved
options, the seed, and the content of all that was read.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import importlib.metadata
import json
import logging
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.errors import Cancelled, PipelineError, ResourceError
from pipelines.options import resolve_options, stage_options, stages_skipped
from pipelines.registry import STAGES, get_stage, load_explainer, load_function
from pipelines.stage import REPORT, Memory, ProgressSink, Stage, StageContext
from pipelines.workspace import MANIFEST, Workspace

FORMAT_VERSION = 1
CAPTURE_INPUT = "input"
"""Name under which the upload itself counts as an input of `ingest`."""

_PACKAGES = ("nerfworks", "torch", "numpy", "pillow", "pycolmap", "open3d", "open3d-cpu", "numba")
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_BOUNDS = {
    errno.EFBIG: ("file_too_large", "a larger file"),
    errno.EMFILE: ("too_many_files", "more open files"),
    errno.EAGAIN: ("too_many_processes", "more processes"),
}
"""What a system says where a process has reached a bound: see worker/containment/limits.py."""


def _ignore_progress(fraction: float, message: str, eta_s: float | None) -> None:
    del fraction, message, eta_s


def _never() -> bool:
    return False


def _ignore() -> None:
    return


@dataclass(frozen=True)
class RunHooks:
    """How the surroundings of a stage take part in it; the defaults do nothing."""

    on_progress: ProgressSink = _ignore_progress
    is_cancelled: Callable[[], bool] = _never
    is_shutdown: Callable[[], bool] = _never
    on_checkpoint: Callable[[], None] = _ignore
    logger: logging.Logger = field(default_factory=lambda: logging.getLogger("nerfworks.stage"))


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fingerprint(
    stage: Stage,
    options: Mapping[str, Any],
    input_manifests: Mapping[str, Mapping[str, Any]],
    *,
    seed: int = 0,
) -> str:
    """What a result depends on, as one hexadecimal number.

    options: resolved and JSON-able. input_manifests: by stage; of each only `content` counts, so a
    stage that was run again with the same result does not make later ones stale.
    """
    return _digest(
        {
            "stage": stage.name,
            "version": stage.version,
            "options": dict(options),
            "seed": seed,
            "inputs": {name: manifest["content"] for name, manifest in input_manifests.items()},
        }
    )


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that shape a result, without importing them."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def list_files(folder: Path) -> list[dict[str, Any]]:
    """`{path, bytes, sha256}` of all files below a folder but its manifest, sorted by path."""
    return [
        {
            "path": path.relative_to(folder).as_posix(),
            "bytes": path.stat().st_size,
            "sha256": file_sha256(path),
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path != folder / MANIFEST
    ]


def write_manifest(
    folder: Path,
    stage: Stage,
    options: Mapping[str, Any],
    summary: Mapping[str, Any],
    timings: Mapping[str, float],
    inputs: Mapping[str, Mapping[str, Any]],
    *,
    seed: int = 0,
) -> dict[str, Any]:
    """Hash a stage's folder and write its manifest, the last file to appear in it.

    summary: what the stage returned. timings: seconds by name, see `run_stage`.
    inputs: manifests of what it read. Returns the manifest.
    """
    files = list_files(folder)
    manifest = {
        "format": FORMAT_VERSION,
        "stage": stage.name,
        "version": stage.version,
        "fingerprint": fingerprint(stage, options, inputs, seed=seed),
        "content": _digest([[item["path"], item["sha256"]] for item in files]),
        "seed": seed,
        "options": dict(options),
        "summary": dict(summary),
        "timings": dict(timings),
        "inputs": {name: item["content"] for name, item in inputs.items()},
        "files": files,
        "versions": versions(),
    }
    draft = folder / (MANIFEST + ".partial")
    draft.write_text(json.dumps(manifest, indent=1), "utf-8")
    os.replace(draft, folder / MANIFEST)
    return manifest


def input_manifests(stage: Stage, workspace: Workspace) -> dict[str, dict[str, Any]]:
    """Manifests of what a stage reads and is there; for the first stage, the upload stands in.

    A stage that was skipped has no folder and is left out.
    """
    found = {name: workspace.manifest(name) for name in stage.reads if workspace.is_complete(name)}
    if not stage.after and workspace.capture_file.is_file():
        found[CAPTURE_INPUT] = {"content": file_sha256(workspace.capture_file)}
    return found


def run_stage(
    stage: Stage,
    options_values: Mapping[str, Any],
    workspace: Workspace,
    *,
    seed: int = 0,
    hooks: RunHooks | None = None,
    memory: Memory = "full",
) -> dict[str, Any]:
    """Run a stage on a job's folder and publish its result as `workspace.stage(name)`.

    options_values: of this stage, as `resolve_options` gives them. memory: see `StageContext`.
    Returns the manifest; in its timings `wall_s` is the whole without hashing and publishing, of
    which `load_s` went into hashing inputs and importing the stage's code, and `compile_s` into
    compiling kernels. A worker adds what lies around (`worker.runner`).
    Raises what the stage raises; a full disk, a lack of memory and a bound of the worker become
    ResourceError (disk_full, out_of_memory, file_too_large, too_many_files, too_many_processes).
    What a failed stage wrote is removed, but for its
    report.json, which `workspace.failed(name)` keeps; its checkpoint stays, too. A stage that
    succeeds has no checkpoint any more.
    """
    hooks = hooks or RunHooks()
    options = stage_options(stage.name, dict(options_values))
    out = workspace.partial(stage.name)
    checkpoint = workspace.checkpoint(stage.name)
    with _translated(stage):
        _remove(out)
        _remove(workspace.failed(stage.name))
        out.mkdir(parents=True)
        checkpoint.mkdir(parents=True, exist_ok=True)
    context = StageContext(
        stage=stage.name,
        workspace=workspace,
        out=out,
        checkpoint=checkpoint,
        seed=seed,
        memory=memory,
        logger=hooks.logger,
        on_progress=hooks.on_progress,
        is_cancelled=hooks.is_cancelled,
        is_shutdown=hooks.is_shutdown,
        on_checkpoint=hooks.on_checkpoint,
    )
    begun, compiled = time.monotonic(), _compile_seconds()
    try:
        with _translated(stage):
            inputs = input_manifests(stage, workspace)
            function = load_function(stage)
            loaded_s = time.monotonic() - begun
            summary = function(options, context)
            timings = {
                "wall_s": round(time.monotonic() - begun, 3),
                "load_s": round(loaded_s, 3),
                "compile_s": round(_compile_seconds() - compiled, 3),
            }
            manifest = write_manifest(
                out, stage, options.model_dump(mode="json"), summary, timings, inputs, seed=seed
            )
            _publish(out, workspace.stage(stage.name))
    except BaseException as error:
        if isinstance(error, Exception) and not isinstance(error, Cancelled):
            _keep_report(out, workspace.failed(stage.name))
            known = error if isinstance(error, PipelineError) else internal_error(stage.name, error)
            _explain(stage, workspace, known, hooks.logger)
        shutil.rmtree(out, ignore_errors=True)
        raise
    shutil.rmtree(checkpoint, ignore_errors=True)
    return manifest


def internal_error(stage: str, error: BaseException) -> PipelineError:
    """What people read of an exception that nobody foresaw. Its own text stays out: it may hold
    paths."""
    return PipelineError(
        f"The stage {stage} failed with {type(error).__name__}.",
        code="internal_error",
        hint="This is a fault of the service: see the job's logs for the step that failed.",
    )


def _compile_seconds() -> float:
    """Seconds that this process spent on compiling kernels, without loading the compiler for it."""
    runtime = sys.modules.get("pipelines.nerf.engines.cpu.parts.runtime")
    return 0.0 if runtime is None else float(runtime.compile_seconds())


def _keep_report(out: Path, target: Path) -> None:
    """Move what a failed stage said of itself out of its folder, if it said anything."""
    if (out / REPORT).is_file():
        with contextlib.suppress(OSError):  # a full disk must not hide why the stage failed
            target.mkdir(parents=True, exist_ok=True)
            os.replace(out / REPORT, target / REPORT)


def _explain(
    stage: Stage, workspace: Workspace, error: PipelineError, logger: logging.Logger
) -> None:
    """Let the stage's explainer say more of a failure."""
    try:
        explainer = load_explainer(stage)
        if explainer is not None:
            error.details["check"] = explainer(workspace, stage.name, error.as_dict())
    except Exception:
        logger.warning("no more could be said of the failure of %s", stage.name, exc_info=True)


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


def _publish(out: Path, target: Path) -> None:
    """Put a complete folder in the place of an older one, which is incomplete first."""
    if target.exists():
        (target / MANIFEST).unlink(missing_ok=True)
        shutil.rmtree(target)
    os.replace(out, target)


@contextlib.contextmanager
def _translated(stage: Stage) -> Iterator[None]:
    """Turn what the machine lacks into errors that say so."""
    try:
        yield
    except PipelineError:
        raise
    except MemoryError as error:
        raise _out_of_memory(stage) from error
    except OSError as error:
        if error.errno in _DISK_FULL:
            raise ResourceError(
                f"The disk was full during {stage.name}.",
                code="disk_full",
                hint="Free some space where jobs are kept, and try again.",
            ) from error
        if error.errno == errno.ENOMEM:
            raise _out_of_memory(stage) from error
        if error.errno in _BOUNDS:
            code, what = _BOUNDS[error.errno]
            raise ResourceError(
                f"{stage.name} wanted {what} than it may have.",
                code=code,
                hint="Use fewer or smaller images, or have the bound of the worker raised.",
            ) from error
        raise
    except RuntimeError as error:
        # torch.cuda.OutOfMemoryError, known by name so that this file does not load torch.
        if type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error):
            raise _out_of_memory(stage) from error
        raise


def _out_of_memory(stage: Stage) -> ResourceError:
    return ResourceError(
        f"The machine ran out of memory during {stage.name}.",
        code="out_of_memory",
        hint="Use smaller pictures or a smaller preset, or a machine with more memory.",
    )


def is_current(
    stage: Stage, options_values: Mapping[str, Any], workspace: Workspace, *, seed: int = 0
) -> bool:
    """Whether the stage's folder is complete and what it was made from is unchanged."""
    if not workspace.is_complete(stage.name):
        return False
    options = stage_options(stage.name, dict(options_values)).model_dump(mode="json")
    wanted = fingerprint(stage, options, input_manifests(stage, workspace), seed=seed)
    return bool(workspace.manifest(stage.name).get("fingerprint") == wanted)


def run_job_locally(
    workspace: Workspace,
    preset: str,
    overrides: Mapping[str, Any],
    *,
    kind: str,
    seed: int = 0,
    hooks_for: Callable[[Stage], RunHooks] = lambda stage: RunHooks(),
    on_reused: Callable[[Stage], None] = lambda stage: None,
    until: str | None = None,
) -> dict[str, dict[str, Any]]:
    """All stages in order on a local folder, those that are current left as they are.

    kind: what `sniff` says of the capture; it and the preset decide which stages are skipped.
        What an earlier run left of those is removed.
    hooks_for: progress and cancel of each stage. on_reused: called for each that is current.
    until: stop after this stage.
    Returns the manifests by stage. Raises OptionsError, KeyError (preset), and what stages raise.
    """
    options = resolve_options(preset, dict(overrides))
    skipped = stages_skipped(preset, kind, overrides)
    manifests: dict[str, dict[str, Any]] = {}
    for stage in STAGES:
        values = options[stage.name]
        if stage.name in skipped:
            _remove(workspace.stage(stage.name))
        elif is_current(stage, values, workspace, seed=seed):
            manifests[stage.name] = workspace.manifest(stage.name)
            on_reused(stage)
        else:
            manifests[stage.name] = run_stage(
                stage, values, workspace, seed=seed, hooks=hooks_for(stage)
            )
        if stage.name == until:
            break
    return manifests


def missing_inputs(stage_name: str, preset: str, kind: str, workspace: Workspace) -> list[str]:
    """Stages that must be run before this one and are not complete."""
    skipped = stages_skipped(preset, kind)
    return [
        name
        for name in get_stage(stage_name).reads
        if name not in skipped and not workspace.is_complete(name)
    ]
