"""`python -m pipelines`: run stages on a local folder, with no service.

    python -m pipelines run all FOLDER --input FILE [--preset P] [--set stage.option=value ...]
    python -m pipelines run STAGE FOLDER [--input FILE] [--preset P] [--set ...]

`run all` leaves alone what is complete and still current; `run STAGE` runs that stage anew.
Exit codes: 0 done, 1 a stage failed, 2 the command was wrong, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

from pipelines.assignments import AssignmentError, parse_assignments
from pipelines.captures.sniff import sniff
from pipelines.errors import CaptureError, PipelineError
from pipelines.manifest import (
    RunHooks,
    file_sha256,
    missing_inputs,
    run_job_locally,
    run_stage,
)
from pipelines.options import OptionsError, resolve_options
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, get_stage
from pipelines.stage import Stage
from pipelines.stages.report import write_failed_report_locally
from pipelines.workspace import Workspace

ALL = "all"
FAILED, WRONG_COMMAND, INTERRUPTED = 1, 2, 130


class ProgressLine:
    """One line per stage, redrawn in place on a terminal; only ends are written elsewhere.

    A stage may come to its end more than once, a part of it each time, and say the same there over
    and over but for the seconds that are left: it is written when its words are new.
    """

    def __init__(self, stage: Stage, stream: TextIO) -> None:
        self._name = stage.name
        self._stream = stream
        self._redraw = stream.isatty()
        self._written: str | None = None

    def __call__(self, fraction: float, message: str, eta_s: float | None) -> None:
        left = "" if eta_s is None else f", {eta_s:.0f} s left"
        line = f"{self._name:<10} {fraction:5.0%} {message}{left}"
        if self._redraw:
            self._stream.write(f"\r\x1b[K{line[:110]}")
            self._stream.flush()
        elif fraction >= 1.0 and message != self._written:
            self._written = message
            self._stream.write(line + "\n")


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(prog="python -m pipelines", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run one stage, or all of them, on a local folder")
    run.add_argument("stage", choices=[ALL, *STAGE_NAMES], metavar="STAGE")
    run.add_argument("folder", type=Path, metavar="FOLDER")
    run.add_argument("--input", type=Path, metavar="FILE", help="the capture: a video or a .zip")
    run.add_argument("--preset", choices=sorted(PRESETS), default="preview")
    run.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="stage.option=value",
        dest="assignments",
    )
    run.add_argument("--seed", type=int, default=None, help="of random choices; 0 by default")
    run.add_argument(
        "--until", choices=STAGE_NAMES, default=None, help="with all: stop after this stage"
    )
    return parser


def prepare_job(workspace: Workspace, source: Path | None, seed: int | None) -> dict[str, object]:
    """Bring the capture into the folder and write `job.json`; returns what that holds.

    source: the file to take, or None to go on with the one that is there.
    Raises CaptureError: capture_missing, and what `sniff` raises.
    """
    target = workspace.capture_file
    known: dict[str, object] = {}
    if workspace.job_file.is_file():
        known = json.loads(workspace.job_file.read_text("utf-8"))
    filename = str(known.get("filename", "capture"))
    if source is not None:
        if not source.is_file():
            raise CaptureError(
                f"There is no file {source.name}.",
                code="capture_missing",
                hint="Name a video or a .zip with --input.",
            )
        filename = source.name
        if not target.is_file() or file_sha256(target) != file_sha256(source):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
    if not target.is_file():
        raise CaptureError(
            "The folder holds no capture.",
            code="capture_missing",
            hint="Name a video or a .zip with --input.",
        )
    chosen = seed if seed is not None else known.get("seed", 0)
    job = {"filename": filename, "kind": sniff(target, filename).kind, "seed": chosen}
    workspace.job_file.write_text(json.dumps(job, indent=1), "utf-8")
    return job


def _run_one(
    name: str, workspace: Workspace, options: dict[str, object], preset: str, kind: str
) -> None:
    missing = missing_inputs(name, preset, kind, workspace)
    if missing:
        raise PipelineError(
            f"{name} needs the results of {', '.join(missing)}, which are not there.",
            code="inputs_missing",
            hint=f"Run `python -m pipelines run {missing[0]} FOLDER` first, or `run all`.",
        )
    stage = get_stage(name)
    seed = json.loads(workspace.job_file.read_text("utf-8"))["seed"]
    hooks = RunHooks(on_progress=ProgressLine(stage, sys.stderr))
    with _reported(workspace, lambda: name):
        manifest = run_stage(stage, options, workspace, seed=seed, hooks=hooks)
    _show(name, manifest)


@contextlib.contextmanager
def _reported(workspace: Workspace, stage: Callable[[], str | None]) -> Iterator[None]:
    """Write the report of a job whose stage fails. stage: the one that runs, None before any."""
    try:
        yield
    except PipelineError as error:
        name = stage()
        if name is not None:
            path = write_failed_report_locally(workspace, name, error.as_dict())
            print(f"\nwhat is known of it: {path}", file=sys.stderr)
        raise


def _show(name: str, manifest: dict[str, object]) -> None:
    print(json.dumps({"stage": name, "summary": manifest["summary"]}, indent=1))


def run(arguments: argparse.Namespace) -> int:
    """Carry out `run`; returns the exit code.

    Raises PipelineError, OptionsError, AssignmentError.
    """
    workspace = Workspace(arguments.folder.resolve())
    overrides = parse_assignments(arguments.assignments)
    options = resolve_options(arguments.preset, overrides)
    job = prepare_job(workspace, arguments.input, arguments.seed)
    kind = str(job["kind"])
    if arguments.stage != ALL:
        _run_one(arguments.stage, workspace, options[arguments.stage], arguments.preset, kind)
        return 0
    started: list[str] = []

    def hooks_for(stage: Stage) -> RunHooks:
        started.append(stage.name)
        return RunHooks(on_progress=ProgressLine(stage, sys.stderr))

    with _reported(workspace, lambda: started[-1] if started else None):
        manifests = run_job_locally(
            workspace,
            arguments.preset,
            overrides,
            kind=kind,
            seed=int(str(job["seed"])),
            hooks_for=hooks_for,
            on_reused=lambda stage: print(f"{stage.name:<10} is current", file=sys.stderr),
            until=arguments.until,
        )
    for name, manifest in manifests.items():
        _show(name, manifest)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    arguments = build_parser().parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        return run(arguments)
    except OptionsError as error:
        for path, problem in error.errors:
            print(f"error: {path}: {problem}", file=sys.stderr)
        return WRONG_COMMAND
    except AssignmentError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_COMMAND
    except PipelineError as error:
        print(f"\nerror ({error.code}): {error.message}\n{error.hint}", file=sys.stderr)
        for line in error.details.get("log", [])[-10:]:
            print(f"  | {line}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return INTERRUPTED
