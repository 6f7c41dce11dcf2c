"""What the command shows: a bar per stage, the tables of results. Plain lines where no TTY is."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TransferSpeedColumn,
)
from rich.table import Table

from api.client.client import Artifact, Capture, Client, Job, Stage
from api.client.models import Check, Event

PLAIN_EVERY_S = 15.0
_STYLES = {"succeeded": "green", "failed": "red", "cancelled": "yellow", "running": "cyan"}


def clean(text: str) -> str:
    """Text of a service as a terminal may show it: no control characters, no markup."""
    return escape("".join(letter if letter.isprintable() else " " for letter in text))


def duration(seconds: float) -> str:
    """`45 s`, `2 m 05 s`, `1 h 02 m`."""
    whole = max(round(seconds), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} m {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} m"


def size(count: int) -> str:
    """Bytes as people read them: `1.2 MB`."""
    amount = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"


def _left(stage: Stage) -> str:
    if stage.state == "running":
        return "" if stage.eta_s is None else f"{duration(stage.eta_s)} left"
    if stage.started_at and stage.finished_at:
        return f"took {duration((stage.finished_at - stage.started_at).total_seconds())}"
    return ""


def _state(state: str) -> str:
    style = _STYLES.get(state)
    return f"[{style}]{state}[/{style}]" if style else state


class _Bars:
    """One bar per stage, drawn anew with every look at the job."""

    def __init__(self, console: Console) -> None:
        self.progress = Progress(
            TextColumn("{task.description:<11}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[state]:<9}"),
            TextColumn("{task.fields[left]:<14}"),
            TextColumn("{task.fields[message]}", markup=True),
            console=console,
        )
        self._tasks: dict[str, TaskID] = {}

    def update(self, job: Job) -> None:
        """Show the job as it stands."""
        for stage in job.stages:
            if stage.name not in self._tasks:
                self._tasks[stage.name] = self.progress.add_task(
                    stage.name, total=1.0, state="", left="", message=""
                )
            done = 1.0 if stage.state in ("succeeded", "skipped") else stage.progress
            message = stage.message if stage.state == "running" else ""
            if stage.state == "ready" and job.queue_position is not None:
                message = f"place {job.queue_position} in the queue"
            if stage.attempt > 1:
                message = f"attempt {stage.attempt}  {message}"
            self.progress.update(
                self._tasks[stage.name],
                completed=done,
                state=_state(stage.state),
                left=_left(stage),
                message=clean(message),
            )


class _Lines:
    """Plain lines: each change of a state, and now and then where the running stages are.

    No line is said twice, whatever of the time that is left changed in it.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._states: dict[str, tuple[str, int]] = {}
        self._said: dict[str, list[str]] = {}
        self._said_at = time.monotonic()

    def update(self, job: Job) -> None:
        """Say what is new."""
        is_due = time.monotonic() - self._said_at >= PLAIN_EVERY_S
        for stage in job.stages:
            before = self._states.get(stage.name)
            now = (stage.state, stage.attempt)
            self._states[stage.name] = now
            if (now != before and stage.state not in ("blocked", "ready")) or (
                stage.state == "running" and is_due
            ):
                self._say(stage)

    def _say(self, stage: Stage) -> None:
        parts = [f"{stage.name:<11}", stage.state]
        if stage.state == "running":
            parts += [f"{stage.progress:4.0%}", clean(stage.message)]
        if stage.attempt > 1:
            parts.append(f"attempt {stage.attempt}")
        if parts == self._said.get(stage.name):
            return
        self._said_at, self._said[stage.name] = time.monotonic(), parts
        parts = [*parts, _left(stage)]
        self._console.print(
            "  ".join(part for part in parts if part), highlight=False, soft_wrap=True
        )


def watch_job(client: Client, job_id: str, console: Console) -> Job:
    """Show a job until it is over. Ctrl-C passes through; the job goes on."""
    if not console.is_terminal:
        return client.wait(job_id, on_update=_Lines(console).update)
    bars = _Bars(console)
    with bars.progress:
        return client.wait(job_id, on_update=bars.update)


@contextmanager
def transfer_bar(console: Console, verb: str) -> Iterator[Any]:
    """Yields `(name, bytes, of bytes)`, to be called as a transfer goes on."""
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        DownloadColumn(),
        TransferSpeedColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    tasks: dict[str, TaskID] = {}

    def report(name: str, done: int, total: int) -> None:
        if name not in tasks:
            tasks[name] = progress.add_task(f"{verb} {clean(name)}", total=total)
        progress.update(tasks[name], completed=done, total=total)

    with progress:
        yield report


def print_events(events: Iterable[Event], console: Console) -> None:
    """What happened, a line each."""
    for event in events:
        what = event.kind if event.stage is None else f"{event.stage}: {event.kind}"
        parts = [what, event.actor, event.reason]
        line = "  ".join(clean(part) for part in parts if part)
        console.print(f"{event.created_at:%Y-%m-%d %H:%M:%S}  {line}", highlight=False)


def print_job(job: Job, console: Console) -> None:
    """A job on a few lines."""
    console.print(f"Job {job.id}: {_state(job.state)}", highlight=False)
    if job.export is not None:
        told = f"{clean(job.export.kind)} of job {job.export.job_id}"
        console.print(f"export: {told}", highlight=False)
    else:
        console.print(f"preset {job.preset} ({clean(job.preset_reason)})", highlight=False)
    for key, value in sorted(job.labels.items()):
        console.print(f"label {clean(key)}={clean(value)}", highlight=False)
    table = Table("stage", "state", "progress", "attempt", "time", "message", box=None)
    for stage in job.stages:
        table.add_row(
            stage.name,
            _state(stage.state),
            f"{stage.progress:.0%}",
            str(stage.attempt),
            _left(stage),
            clean(stage.message),
        )
    console.print(table)
    if job.queue_position is not None:
        console.print(f"place {job.queue_position} in the queue")
    if job.metrics is not None or job.assets is not None:
        quality = Table("quality", "", box=None)
        psnr = (job.metrics or {}).get("psnr")
        for what, value in [
            ("held-out PSNR", _number(psnr, ".2f", " dB")),
            *asset_rows(job.assets),
        ]:
            quality.add_row(what, value)
        console.print(quality)
    print_warnings((job.assets or {}).get("warnings", []), console)
    print_error(job, console)


def print_warnings(warnings: Iterable[dict[str, Any]], console: Console) -> None:
    """What a job that ended well should still be looked at for, and what to do about it."""
    for warning in warnings:
        console.print(
            f"[yellow]Warning[/yellow] ({clean(str(warning.get('code', '')))})\n"
            f"{clean(str(warning.get('message', '')))}\n{clean(str(warning.get('hint', '')))}",
            highlight=False,
            soft_wrap=True,
        )


def print_error(job: Job, console: Console) -> None:
    """Why a job failed, if it did."""
    if job.error is not None:
        where = f" in {job.error.stage}" if job.error.stage else ""
        console.print(
            f"[red]The job failed{where}[/red] ({clean(job.error.code)})\n"
            f"{clean(job.error.message)}\n{clean(job.error.hint)}",
            highlight=False,
            soft_wrap=True,
        )


def print_jobs(jobs: Iterable[Job], console: Console) -> None:
    """A table of jobs."""
    table = Table("job", "state", "preset", "created", "running", "PSNR", box=None)
    for job in jobs:
        running = [f"{s.name} {s.progress:.0%}" for s in job.stages if s.state == "running"]
        psnr = (job.metrics or {}).get("psnr")
        table.add_row(
            job.id,
            _state(job.state),
            job.preset if job.export is None else clean(job.export.kind),
            f"{job.created_at.astimezone():%Y-%m-%d %H:%M}",
            ", ".join(running),
            "" if psnr is None else f"{psnr:.1f} dB",
        )
    console.print(table)


def print_captures(captures: Iterable[Capture], console: Console) -> None:
    """A table of captures."""
    table = Table("capture", "kind", "size", "created", "file", box=None)
    for capture in captures:
        table.add_row(
            capture.id,
            clean(capture.kind),
            size(capture.bytes),
            f"{capture.created_at.astimezone():%Y-%m-%d %H:%M}",
            clean(capture.filename),
        )
    console.print(table)


def _number(value: Any, form: str, unit: str = "") -> str:
    return "not measured" if value is None else f"{value:{form}}{unit}"


def asset_rows(assets: dict[str, Any] | None) -> list[tuple[str, str]]:
    """(what, value) of the mesh against held-out photos; nothing where that was not measured."""
    mesh = (assets or {}).get("mesh")
    if not mesh:
        return []
    return [
        ("mesh covers", _number(mesh.get("coverage"), ".0%", " of held-out views")),
        ("mesh PSNR", _number(mesh.get("psnr"), ".2f", " dB where it covers")),
    ]


def quality_rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    """(what, value) from a report: images registered, quality, time per stage."""
    poses = report.get("poses", {})
    rows = []
    if poses.get("num_images") is not None:
        ratio = poses.get("registered_ratio")
        share = "" if ratio is None else f" ({ratio:.0%})"
        rows.append(
            ("images registered", f"{poses['num_registered']} of {poses['num_images']}{share}")
        )
    metrics = report.get("metrics", {})
    rows += _draft_rows(report) if metrics is None else _held_out_rows(metrics)
    rows += asset_rows(report.get("assets"))
    timings = report.get("timings", {})
    rows += [
        (f"time {name.removesuffix('_s')}", duration(seconds))
        for name, seconds in timings.items()
        if seconds is not None
    ]
    return rows


def _held_out_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    held = str(metrics.get("num_images") or 0)
    if metrics.get("width"):
        held += f", {metrics['width']} x {metrics['height']} px"
    return [
        ("held-out images", held),
        ("held-out PSNR", _number(metrics.get("psnr"), ".2f", " dB")),
        ("held-out SSIM", _number(metrics.get("ssim"), ".3f")),
    ]


def _draft_rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    """What a job that trained nothing has in place of held-out numbers."""
    faces = report.get("stages", {}).get("draft", {}).get("num_faces")
    return [
        ("draft mesh", _number(faces, ",", " triangles")),
        ("held-out quality", clean(str(report.get("metrics_reason") or "not measured"))),
    ]


def result_rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """(what, value) of what an export says it made: its numbers and words, no lists."""
    return [
        (clean(name.replace("_", " ")), clean(str(value)))
        for name, value in result.items()
        if isinstance(value, str | int | float)
    ]


_VERDICT_STYLES = {"good": "green", "usable": "yellow", "poor": "yellow", "unusable": "red"}


def print_check(check: Check, console: Console | None = None) -> None:
    """How a capture was filmed: the verdict, what it rests on, and what to do next time."""
    console = console or Console()
    verdict = clean(check.verdict or "not judged")
    style = _VERDICT_STYLES.get(check.verdict or "", "default")
    console.print(f"The capture is [bold {style}]{verdict}[/].", highlight=False)
    for reason in check.reasons:
        console.print(f"  {clean(reason)}", highlight=False)
    if check.advice:
        console.print("What to do next time:", highlight=False)
    for advice in check.advice:
        console.print(f"  - {clean(advice)}", highlight=False)


def print_results(
    job: Job, folder: Path, report: dict[str, Any], console: Console | None = None
) -> None:
    """The tables of a finished job: each artifact in `folder`, then the quality.

    Of an export what it says it made takes the place of the quality.
    """
    console = console or Console()
    artifacts = Table(title=f"Job {job.id}", box=None)
    artifacts.add_column("artifact", no_wrap=True)
    artifacts.add_column("path", overflow="fold")
    artifacts.add_column("size", no_wrap=True, justify="right")
    artifacts.add_column("opens with", overflow="fold")
    found: list[Artifact] = [one for one in job.artifacts if (folder / one.name).is_file()]
    for artifact in found:
        artifacts.add_row(
            artifact.name,
            clean(str(folder / artifact.name)),
            size((folder / artifact.name).stat().st_size),
            clean(artifact.opens_with),
        )
    quality = Table("quality" if job.export is None else "result", "", box=None)
    rows = quality_rows(report) if job.export is None else result_rows(job.export.result or {})
    for what, value in rows:
        quality.add_row(what, value)
    console.print(artifacts)
    console.print(quality)
    print_warnings(report.get("warnings", []), console)
