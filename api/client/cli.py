"""The `nerfworks` command: a thin layer over the client.

    nerfworks up                      keep the service running from this folder
    nerfworks submit FILE             upload, start a job; --wait and --download go on to the end
    nerfworks submit --capture ID     the same on a capture that is there
    nerfworks check FILE              is it any good? verdict, reasons, what to do better; no more
    nerfworks status | watch | logs | download [JOB]     the newest job where none is named
    nerfworks events [JOB]            what happened to it: when, who, why
    nerfworks retry JOB               once more, from what failed or what --set changes
    nerfworks export JOB KIND         a mesh, a video, ... of what a job has trained, whenever
    nerfworks exports [JOB]           those that were asked for; --kinds: what there is
    nerfworks cancel | delete JOB
    nerfworks list | captures | presets

With --json a command prints one JSON document on the standard output, and all else on the standard
error output.

Exit status: 0 done, 1 the job failed, the call was refused, the capture is unusable, or there is
nothing to download, 2 wrong usage, 3 no service reached.
Ctrl-C while watching leaves the job running.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from rich.console import Console

from api.client.client import (
    RETRY_S,
    ApiProblem,
    Client,
    ConnectionFailed,
    FilesInTheWay,
    Job,
    JobFailed,
    NerfworksError,
)
from api.client.display import (
    clean,
    print_captures,
    print_check,
    print_error,
    print_events,
    print_job,
    print_jobs,
    print_results,
    transfer_bar,
    watch_job,
)
from pipelines.assignments import AssignmentError, parse_assignments

OK, FAILED, USAGE, UNREACHABLE = 0, 1, 2, 3
INTERRUPTED = 130


class UsageError(Exception):
    """The command line is wrong in a way that argparse does not see."""


def _options(assignments: list[str]) -> dict[str, Any]:
    try:
        return parse_assignments(assignments)
    except AssignmentError as error:
        raise UsageError(f"--set: {error}") from error


def _labels(assignments: list[str]) -> dict[str, str]:
    labels = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise UsageError(f"--label {text}: expected key=value")
        labels[key] = value
    return labels


def _job_of(client: Client, args: argparse.Namespace) -> str:
    """The job that was named, else the newest. Raises NerfworksError where there is none."""
    if args.job is not None:
        return str(args.job)
    for job in client.jobs():
        return job.id
    raise NerfworksError("There is no job yet.", "Start one: nerfworks submit FILE")


def _download(
    client: Client, job_id: str, folder: Path, args: argparse.Namespace, console: Console
) -> list[Path]:
    with transfer_bar(console, "download") as report:
        try:
            return client.download(job_id, folder, progress=report, overwrite=args.overwrite)
        except FilesInTheWay as error:
            raise FilesInTheWay(
                str(error), f"nerfworks download {job_id} OTHER_FOLDER, or --overwrite these."
            ) from error


def _finish(client: Client, job: Job, args: argparse.Namespace, console: Console) -> int:
    """After watching: download and show, or say why not."""
    if job.state != "succeeded":
        if job.error is None:
            console.print(f"The job is {job.state}.")
        print_error(job, console)
        return FAILED
    if args.download is None:
        console.print(f"Job {job.id} succeeded. Get its files: nerfworks download {job.id}")
        return OK
    folder = Path(args.download)
    _download(client, job.id, folder, args, console)
    report = folder / "report.json"
    loaded = json.loads(report.read_text("utf-8")) if report.is_file() else {}
    print_results(job, folder, loaded, console)
    return OK


def _watch(client: Client, job_id: str, args: argparse.Namespace, console: Console) -> int:
    try:
        job = watch_job(client, job_id, console)
    except KeyboardInterrupt:
        console.print(f"\nThe job goes on. See it again: nerfworks watch {job_id}")
        return INTERRUPTED
    return _finish(client, job, args, console)


def _print_json(found: BaseModel | list[BaseModel]) -> None:
    """One JSON document on the standard output, and nothing else there."""
    parts = found if isinstance(found, list) else [found]
    shown = [part.model_dump(mode="json") for part in parts]
    print(json.dumps(shown if isinstance(found, list) else shown[0], indent=1))


def _check_source(args: argparse.Namespace) -> None:
    """One capture must be named, and a file must be there."""
    if (args.file is None) == (args.capture is None):
        raise UsageError("Name a FILE, or a capture that is there: --capture ID.")
    if args.file is not None and not Path(args.file).is_file():
        raise UsageError(f"There is no file {args.file}.")


def _sent(client: Client, args: argparse.Namespace, console: Console) -> str:
    """The capture to work on: the one that was named, or the file, uploaded. Returns its id."""
    if args.capture is not None:
        return client.get_capture(args.capture).id
    path = Path(args.file)
    with transfer_bar(console, "upload") as report:
        capture = client.upload(path, lambda done, total: report(path.name, done, total))
    console.print(f"Capture {capture.id}: {clean(capture.kind)}", highlight=False)
    return capture.id


def submit(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Upload a capture, or take one that is there, and start a job."""
    options, labels = _options(args.set), _labels(args.label)
    _check_source(args)
    client.validate(args.preset, options, labels)  # before minutes of upload
    job = client.create_job(_sent(client, args, console), args.preset, options, labels)
    console.print(
        f"Job {job.id}: preset {job.preset} ({clean(job.preset_reason)})", highlight=False
    )
    ended = OK
    if args.wait or args.download is not None:
        ended = _watch(client, job.id, args, console)
    else:
        console.print(f"See it: nerfworks watch {job.id}", highlight=False)
    if args.json:
        _print_json(client.get_job(job.id))
    return ended


def check(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Look how well a capture was filmed, and say what to do better; nothing is made of it."""
    options, labels = _options(args.set), _labels(args.label)
    _check_source(args)
    client.validate("check", options, labels)
    job = client.start_check(_sent(client, args, console), options, labels)
    try:
        job = watch_job(client, job.id, console)
    except KeyboardInterrupt:
        console.print(f"\nThe job goes on. See it again: nerfworks watch {job.id}")
        return INTERRUPTED
    if args.json:
        _print_json(job)
    if job.check is None:
        print_error(job, console)
        return FAILED
    print_check(job.check, console)
    if args.download is not None and job.artifacts:
        for path in _download(client, job.id, Path(args.download), args, console):
            console.print(clean(str(path)), highlight=False, soft_wrap=True)
    elif job.artifacts:
        console.print(f"With pictures: nerfworks download {job.id}", highlight=False)
    return FAILED if job.state != "succeeded" or job.check.verdict == "unusable" else OK


def status(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Show a job as it stands."""
    job = client.get_job(_job_of(client, args))
    if args.json:
        _print_json(job)
    else:
        print_job(job, console)
    return FAILED if job.state == "failed" else OK


def watch(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Show a job until it is over."""
    return _watch(client, _job_of(client, args), args, console)


def logs(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Print a job's log; with --follow until the job is over."""
    job_id, line = _job_of(client, args), args.line

    def show() -> None:
        nonlocal line
        while True:
            page = client.log_page(job_id, args.stage, line)
            for text in page.lines:
                console.print(clean(text), highlight=False, soft_wrap=True)
            line = page.next
            if not page.lines or page.next >= page.total:
                return

    show()
    if args.follow:
        client.wait(job_id, on_update=lambda _: show())
        show()
    return OK


def download(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Download what a job offers."""
    job_id = _job_of(client, args)
    folder = Path("out") / job_id if args.folder is None else Path(args.folder)
    if not client.artifacts(job_id):
        job = client.get_job(job_id)
        do = f"nerfworks {'retry' if job.is_over else 'watch'} {job_id}"
        do = f"Run it again: {do}" if job.is_over else f"See it: {do}"
        raise NerfworksError(f"Job {job_id} is {job.state}: there is nothing to download.", do)
    for path in _download(client, job_id, folder, args, console):
        console.print(clean(str(path)), highlight=False, soft_wrap=True)
    return OK


def cancel(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Ask a job to stop."""
    console.print(f"The job is {client.cancel(args.job).state}.")
    return OK


def retry(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Run a job that is over again, from what failed or what changes."""
    job = client.retry(args.job, args.from_stage, _options(args.set))
    again = [stage.name for stage in job.stages if stage.state in ("ready", "blocked")]
    console.print(f"Job {job.id} runs again: {', '.join(again)}", highlight=False)
    if args.wait or args.download is not None:
        return _watch(client, job.id, args, console)
    console.print(f"See it: nerfworks watch {job.id}", highlight=False)
    return OK


def export(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Export what a job has trained: a mesh, a cloud, a video, ..."""
    own = f"{args.kind}."  # as docs/options.md names them, and short
    named = [text if text.startswith(own) else own + text for text in args.set]
    options = _options(named).get(args.kind, {})
    made = client.export(args.job, args.kind, options, _labels(args.label))
    console.print(f"Export {made.id}: {args.kind} of job {args.job}", highlight=False)
    ended = OK
    if args.wait or args.download is not None:
        ended = _watch(client, made.id, args, console)
    else:
        console.print(f"See it: nerfworks watch {made.id}", highlight=False)
    if args.json:
        _print_json(client.get_job(made.id))
    return ended


def exports(client: Client, args: argparse.Namespace, console: Console) -> int:
    """A table of a job's exports, newest first; --kinds: what can be exported"""
    if args.kinds:
        kinds = client.export_kinds()
        if args.json:
            _print_json([*kinds])
        for kind in [] if args.json else kinds:
            console.print(f"{kind.kind:<11} {clean(kind.summary)}", highlight=False)
        return OK
    found = [*client.exports(_job_of(client, args))]
    if args.json:
        _print_json([*found])
    else:
        print_jobs(found, console)
    return OK


def events(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Print what happened to a job: when, what, who, why."""
    print_events(client.events(_job_of(client, args)), console)
    return OK


def delete(client: Client, args: argparse.Namespace, console: Console) -> int:
    """Delete a job and its bytes."""
    client.delete_job(args.job)
    console.print("Deleted.")
    return OK


def list_jobs(client: Client, args: argparse.Namespace, console: Console) -> int:
    """A table of jobs, newest first."""
    found = [*islice(client.jobs(state=args.state, label=args.label), args.limit)]
    if args.json:
        _print_json([*found])
    else:
        print_jobs(found, console)
    return OK


def captures(client: Client, args: argparse.Namespace, console: Console) -> int:
    """A table of captures, newest first; --delete removes one and its bytes."""
    if args.delete is not None:
        client.delete_capture(args.delete)
        console.print("Deleted.")
        return OK
    found = [*islice(client.captures(), args.limit)]
    if args.json:
        _print_json([*found])
    else:
        print_captures(found, console)
    return OK


def presets(client: Client, args: argparse.Namespace, console: Console) -> int:
    """The presets of the service."""
    found = client.presets()
    if args.json:
        _print_json(found)
        return OK
    for preset in found.items:
        mark = f" (the default: {found.default_reason})" if preset.name == found.default else ""
        console.print(f"{preset.name:<10} {clean(preset.summary + mark)}", highlight=False)
    return OK


def _count(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError("a number from 1 on")
    return int(text)


def _parser(with_up: bool) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nerfworks", description="A phone capture in; a mesh, a point cloud and a video out."
    )
    parser.add_argument("--url", help="the service; else NERFWORKS_URL, else this folder's")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def overwrites(one: argparse.ArgumentParser) -> None:
        one.add_argument("--overwrite", action="store_true", help="other files in DIR, too")

    def command(name: str, run: Callable[..., int], job: str = "") -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=(run.__doc__ or "").strip().rstrip("."))
        added.set_defaults(run=run, download=None, overwrite=False)
        if job == "newest":
            added.add_argument("job", nargs="?", metavar="JOB", help="left out: the newest")
        elif job == "named":
            added.add_argument("job", metavar="JOB")
        return added

    if with_up:
        commands.add_parser("up", help="Keep the service running from this folder", add_help=False)
    one = command("submit", submit)
    one.add_argument(
        "file", nargs="?", metavar="FILE", help="a video, or a .zip of photos or an app export"
    )
    one.add_argument("--capture", metavar="ID", help="a capture that was uploaded before")
    one.add_argument("--preset", help="`nerfworks presets` lists them; else the service chooses")
    one.add_argument("--set", action="append", default=[], metavar="STAGE.OPTION=VALUE")
    one.add_argument("--label", action="append", default=[], metavar="KEY=VALUE")
    one.add_argument("--wait", action="store_true", help="show the job until it is over")
    one.add_argument("--download", metavar="DIR", help="wait, then download the results there")
    overwrites(one)
    as_json = [one, command("status", status, "newest")]
    one = command("check", check)
    one.add_argument(
        "file", nargs="?", metavar="FILE", help="a video, or a .zip of photos or an app export"
    )
    one.add_argument("--capture", metavar="ID", help="a capture that was uploaded before")
    one.add_argument("--set", action="append", default=[], metavar="STAGE.OPTION=VALUE")
    one.add_argument("--label", action="append", default=[], metavar="KEY=VALUE")
    one.add_argument("--download", metavar="DIR", help="download the reports there")
    overwrites(one)
    as_json.append(one)
    command("watch", watch, "newest")
    one = command("logs", logs, "newest")
    one.add_argument("--stage", help="only this stage")
    one.add_argument("--line", type=int, default=0, help="from this line on; negative: the tail")
    one.add_argument("--follow", action="store_true", help="go on until the job is over")
    one = command("download", download, "newest")
    one.add_argument("folder", nargs="?", metavar="DIR", help="left out: out/JOB")
    overwrites(one)
    command("cancel", cancel, "named")
    one = command("retry", retry, "named")
    one.add_argument("--from", dest="from_stage", metavar="STAGE", help="begin with this stage")
    one.add_argument("--set", action="append", default=[], metavar="STAGE.OPTION=VALUE")
    one.add_argument("--wait", action="store_true", help="show the job until it is over")
    one.add_argument("--download", metavar="DIR", help="wait, then download the results there")
    overwrites(one)
    one = command("export", export, "named")
    one.add_argument("kind", metavar="KIND", help="`nerfworks exports --kinds` lists them")
    one.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    one.add_argument("--label", action="append", default=[], metavar="KEY=VALUE")
    one.add_argument("--wait", action="store_true", help="show the export until it is over")
    one.add_argument("--download", metavar="DIR", help="wait, then download the files there")
    overwrites(one)
    as_json.append(one)
    one = command("exports", exports, "newest")
    one.add_argument("--kinds", action="store_true", help="what can be exported")
    as_json.append(one)
    command("events", events, "newest")
    command("delete", delete, "named")
    one = command("list", list_jobs)
    one.add_argument("--state", help="only jobs in this state")
    one.add_argument("--label", metavar="KEY[=VALUE]", help="only jobs with this label")
    one.add_argument("--limit", type=_count, default=50, help="at most so many")
    as_json.append(one)
    one = command("captures", captures)
    one.add_argument("--limit", type=_count, default=50, help="at most so many")
    one.add_argument("--delete", metavar="ID", help="delete this one")
    as_json += [one, command("presets", presets)]
    for one in as_json:
        one.add_argument("--json", action="store_true", help="print JSON, for programs")
    return parser


def _say(errors: Console, error: NerfworksError) -> None:
    errors.print(f"[red]{clean(error.message)}[/red]", highlight=False, soft_wrap=True)
    if isinstance(error, ApiProblem):
        for path, detail in error.errors:
            errors.print(f"  {clean(path)}: {clean(detail)}", highlight=False, soft_wrap=True)
    if error.hint:
        errors.print(clean(error.hint), highlight=False, soft_wrap=True)


def main(arguments: list[str] | None = None, up: Callable[[list[str]], int] | None = None) -> int:
    """Run the command. Returns the process's exit status.

    up: what starts the service, which is no part of the client.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["up"] and up is not None:
        return up(given[1:])
    args = _parser(with_up=up is not None).parse_args(given)
    errors = Console(stderr=True)
    console = errors if getattr(args, "json", False) else Console()
    try:
        with Client(args.url, retry_s=RETRY_S) as client:
            status_code: int = args.run(client, args, console)
            return status_code
    except UsageError as error:
        errors.print(clean(str(error)), highlight=False, soft_wrap=True)
        return USAGE
    except ConnectionFailed as error:
        _say(errors, error)
        return UNREACHABLE
    except (ApiProblem, JobFailed, NerfworksError) as error:
        _say(errors, error)
        return FAILED
    except OSError as error:
        errors.print(clean(f"{error.filename or 'A file'}: {error.strerror}"), highlight=False)
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED
