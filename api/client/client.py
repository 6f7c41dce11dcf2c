"""The typed Python client: `from nerfworks import Client`.

    with Client() as client:
        capture = client.upload("walk.mp4")
        job = client.wait(client.create_job(capture.id).id)
        client.download(job.id, "out")

It rides out a service that restarts: calls that may be repeated are, with growing pauses, for up to
`retry_s` seconds. Needs httpx and pydantic, and nothing of the server.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx

from api.client.models import (
    ApiProblem,
    Artifact,
    Capture,
    Check,
    ChecksumMismatch,
    ConnectionFailed,
    Event,
    Export,
    ExportKind,
    FilesInTheWay,
    Job,
    JobError,
    JobFailed,
    JobPlan,
    LogPage,
    NerfworksError,
    Preset,
    Presets,
    Stage,
    WaitTimedOut,
)
from api.client.transfer import Download, MultipartFile, OnProgress, refuse_to_overwrite
from api.client.wire import (
    BUSY,
    Patience,
    Wire,
    checked,
    find_service,
    is_busy,
    once_header,
    poll_pause,
    problem_of,
    segment,
    timeout_until,
)

__all__ = [
    "RETRY_S",
    "ApiProblem",
    "Artifact",
    "Capture",
    "Check",
    "ChecksumMismatch",
    "Client",
    "ConnectionFailed",
    "Event",
    "Export",
    "ExportKind",
    "FilesInTheWay",
    "Job",
    "JobError",
    "JobFailed",
    "JobPlan",
    "NerfworksError",
    "Preset",
    "Presets",
    "Stage",
    "WaitTimedOut",
    "find_service",
]

RETRY_S = 60.0
UPLOAD_TIMEOUT = httpx.Timeout(60.0, connect=5.0, read=600.0)


def _wish(
    preset: str | None, options: dict[str, Any] | None, labels: dict[str, str] | None
) -> dict[str, Any]:
    named = {"preset": preset} if preset else {}
    return {**named, "options": options or {}, "labels": labels or {}}


class Client:
    """A connection to one service. Use it as a context manager, from one thread at a time."""

    def __init__(
        self, url: str | None = None, api_key: str | None = None, *, retry_s: float = RETRY_S
    ) -> None:
        """retry_s: how long calls that may be repeated ride out a service that is away."""
        self.url, key = find_service(url, api_key)
        self._wire = Wire(self.url, key, retry_s)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._wire.http.close()

    # Captures

    def upload(
        self,
        path: str | Path,
        progress: OnProgress | None = None,
        *,
        idempotency_key: str | None = None,
    ) -> Capture:
        """Send a capture. An upload that breaks off is sent again from its start.

        idempotency_key: a text of the caller's own; two uploads of one file under it, also by two
        programs, make one capture. Raises NerfworksError for a file that cannot be read,
        ApiProblem where it is refused.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                once = once_header(idempotency_key)
                body = MultipartFile(file, path.name, os.fstat(file.fileno()).st_size)

                def send() -> httpx.Response:
                    return self._wire.http.post(
                        "/v1/captures",
                        content=body.chunks(progress),
                        headers={**body.headers, **once},
                        timeout=UPLOAD_TIMEOUT,
                    )

                return Capture.model_validate(checked(self._wire.send(send)).json())
        except OSError as error:
            raise NerfworksError(f"{path} cannot be read: {error.strerror}.") from error

    def get_capture(self, capture_id: str) -> Capture:
        """One capture."""
        return Capture.model_validate(self._get(f"/v1/captures/{segment(capture_id)}"))

    def captures(self) -> Iterator[Capture]:
        """All captures, newest first."""
        return (Capture.model_validate(item) for item in self._items("/v1/captures", {}))

    def delete_capture(self, capture_id: str) -> None:
        """Delete a capture and its bytes."""
        self._delete(f"/v1/captures/{segment(capture_id)}")

    def start_check(
        self,
        capture_id: str,
        options: dict[str, Any] | None = None,
        labels: dict[str, str] | None = None,
        *,
        idempotency_key: str | None = None,
    ) -> Job:
        """Start a job that looks how well a capture was filmed, and makes nothing of it."""
        wanted = {"options": options or {}, "labels": labels or {}}
        path, once = f"/v1/captures/{segment(capture_id)}/check", once_header(idempotency_key)
        answer = self._wire.send(lambda: self._wire.http.post(path, json=wanted, headers=once))
        return Job.model_validate(checked(answer).json())

    def check(
        self,
        capture_id: str,
        options: dict[str, Any] | None = None,
        timeout: float | None = None,
        on_update: Callable[[Job], None] | None = None,
    ) -> Check:
        """How well a capture was filmed, and what to do better: within minutes.

        A capture that cannot be used is no error here: its verdict is `unusable`. Raises JobFailed
        where the job ended without a word on the capture, WaitTimedOut after `timeout` seconds.
        """
        job = self.wait(self.start_check(capture_id, options).id, on_update, timeout)
        if job.check is None:
            raise JobFailed(job)
        return job.check

    # Jobs

    def create_job(
        self,
        capture_id: str,
        preset: str | None = None,
        options: dict[str, Any] | None = None,
        labels: dict[str, str] | None = None,
        *,
        idempotency_key: str | None = None,
    ) -> Job:
        """Start a job: one, however often the call had to be sent.

        idempotency_key: a text of the caller's own, so that also a program that was started again
        makes one job.
        """
        wanted = {"capture_id": capture_id, **_wish(preset, options, labels)}
        once = once_header(idempotency_key)
        answer = self._wire.send(
            lambda: self._wire.http.post("/v1/jobs", json=wanted, headers=once)
        )
        return Job.model_validate(checked(answer).json())

    def validate(
        self,
        preset: str | None = None,
        options: dict[str, Any] | None = None,
        labels: dict[str, str] | None = None,
    ) -> JobPlan:
        """Check what a job would be asked for, before its capture is sent. Creates nothing.

        Raises ApiProblem, whose `errors` name what is wrong.
        """
        wanted = _wish(preset, options, labels)
        answer = self._wire.send(lambda: self._wire.http.post("/v1/jobs:validate", json=wanted))
        return JobPlan.model_validate(checked(answer).json())

    def get_job(self, job_id: str) -> Job:
        """One job as it stands."""
        return Job.model_validate(self._get(f"/v1/jobs/{segment(job_id)}"))

    def jobs(self, state: str | None = None, label: str | None = None) -> Iterator[Job]:
        """Jobs, newest first, page by page. label: KEY or KEY=VALUE."""
        wanted = {"state": state, "label": label}
        wanted = {key: value for key, value in wanted.items() if value is not None}
        return (Job.model_validate(item) for item in self._items("/v1/jobs", wanted))

    def wait(
        self,
        job_id: str,
        on_update: Callable[[Job], None] | None = None,
        timeout: float | None = None,
        check: bool = False,
    ) -> Job:
        """Wait until a job is over; restarts of the service are ridden out.

        on_update: called with the job each time it was looked at. check: raise JobFailed where it
        did not succeed. Raises WaitTimedOut after `timeout` seconds, also where no answer came.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        path, job = f"/v1/jobs/{segment(job_id)}", None

        def look() -> httpx.Response:
            return self._wire.http.get(path, timeout=timeout_until(deadline))

        def is_late() -> bool:
            return deadline is not None and time.monotonic() >= deadline

        while True:
            try:
                answer = self._wire.send(look, deadline)
            except ConnectionFailed as error:
                if is_late():
                    raise WaitTimedOut(job_id, job, timeout or 0.0) from error
                raise
            if is_busy(answer) and is_late():
                raise WaitTimedOut(job_id, job, timeout or 0.0)
            job = Job.model_validate(checked(answer).json())
            if on_update is not None:
                on_update(job)
            if job.is_over:
                if check and job.state != "succeeded":
                    raise JobFailed(job)
                return job
            if is_late():
                raise WaitTimedOut(job_id, job, timeout or 0.0)
            pause = poll_pause(answer)
            if deadline is not None:
                pause = min(pause, max(deadline - time.monotonic(), 0.0))
            time.sleep(pause)

    def cancel(self, job_id: str) -> Job:
        """Ask a job to stop."""
        answer = self._wire.send(lambda: self._wire.http.post(f"/v1/jobs/{segment(job_id)}/cancel"))
        return Job.model_validate(checked(answer).json())

    def retry(
        self,
        job_id: str,
        from_stage: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        idempotency_key: str | None = None,
    ) -> Job:
        """Run a job that is over again, once, however often the call had to be sent.

        What still holds is used. options: {stage: {option: value}}.
        """
        wanted: dict[str, Any] = {"options": options or {}}
        wanted |= {"from_stage": from_stage} if from_stage else {}
        path = f"/v1/jobs/{segment(job_id)}/retry"
        once = once_header(idempotency_key)
        answer = self._wire.send(lambda: self._wire.http.post(path, json=wanted, headers=once))
        return Job.model_validate(checked(answer).json())

    def export(
        self,
        job_id: str,
        kind: str,
        options: dict[str, Any] | None = None,
        labels: dict[str, str] | None = None,
        *,
        idempotency_key: str | None = None,
    ) -> Job:
        """Export what a job has trained, whenever, once, however often the call had to be sent.

        kind: one of `export_kinds`. options: {option: value}, laid over the job's own. What comes
        back is a job of its own: wait for it, cancel, retry, download it as any other.
        """
        wanted = {"kind": kind, "options": options or {}, "labels": labels or {}}
        path = f"/v1/jobs/{segment(job_id)}/exports"
        once = once_header(idempotency_key)
        answer = self._wire.send(lambda: self._wire.http.post(path, json=wanted, headers=once))
        return Job.model_validate(checked(answer).json())

    def exports(self, job_id: str) -> Iterator[Job]:
        """The exports that were asked for of a job, newest first."""
        path = f"/v1/jobs/{segment(job_id)}/exports"
        return (Job.model_validate(item) for item in self._items(path, {}))

    def events(self, job_id: str, after: int = 0) -> Iterator[Event]:
        """What happened to a job, oldest first, page by page. after: a `seq` to go on from."""
        following: int | None = after
        while following is not None:
            page = self._get(f"/v1/jobs/{segment(job_id)}/events", {"after": following})
            yield from (Event.model_validate(item) for item in page["items"])
            following = page["next"]

    def delete_job(self, job_id: str) -> None:
        """Delete a job and its bytes."""
        self._delete(f"/v1/jobs/{segment(job_id)}")

    def log_page(self, job_id: str, stage: str | None = None, line: int = 0) -> LogPage:
        """Some lines of a job's log from `line` on; negative: the tail."""
        wanted: dict[str, Any] = {"line": line} | ({"stage": stage} if stage else {})
        return LogPage.model_validate(self._get(f"/v1/jobs/{segment(job_id)}/logs", wanted))

    def logs(self, job_id: str, stage: str | None = None, line: int = 0) -> list[str]:
        """All lines of a job's log from `line` on; negative: the tail."""
        lines: list[str] = []
        while True:
            page = self.log_page(job_id, stage, line)
            lines += page.lines
            line = page.next
            if not page.lines or page.next >= page.total:
                return lines

    # Artifacts

    def artifacts(self, job_id: str) -> list[Artifact]:
        """What a job offers for download."""
        found = self._get(f"/v1/jobs/{segment(job_id)}/artifacts")
        return [Artifact.model_validate(item) for item in found["items"]]

    def download(
        self,
        job_id: str,
        folder: str | Path,
        names: Iterable[str] | None = None,
        progress: Callable[[str, int, int], None] | None = None,
        *,
        overwrite: bool = False,
    ) -> list[Path]:
        """Download artifacts, all or those of these names, into a folder.

        Goes on where an earlier download broke off; what is there already is not fetched again;
        each file is verified and appears whole. progress: called with (name, bytes, of bytes).
        overwrite: replace files of these names that are others, as another job's are; else nothing
        is downloaded where there is one. Raises FilesInTheWay, ChecksumMismatch, ApiProblem,
        ConnectionFailed; NerfworksError for an unknown name.
        """
        folder = Path(folder)
        offered = {artifact.name: artifact for artifact in self.artifacts(job_id)}
        wanted = list(offered) if names is None else list(names)
        for name in wanted:
            if name not in offered:
                raise NerfworksError(
                    f"Job {job_id} has no artifact {name}.", f"It has {', '.join(offered)}."
                )
        folder.mkdir(parents=True, exist_ok=True)
        tell = progress or (lambda name, done, size: None)
        downloads = [Download(offered[name], folder, partial(tell, name)) for name in wanted]
        missing = [download for download in downloads if not download.is_done()]
        if not overwrite:
            refuse_to_overwrite(missing)
        for download in downloads:
            if download in missing:
                self._download(job_id, download)
            else:
                tell(download.artifact.name, download.artifact.bytes, download.artifact.bytes)
        return [download.target for download in downloads]

    def _download(self, job_id: str, download: Download) -> None:
        artifact = download.artifact
        url = f"/v1/jobs/{segment(job_id)}/artifacts/{segment(artifact.name)}"
        patience = Patience(self._wire.retry_s)
        damaged = 0
        while True:
            before = download.bytes_here
            try:
                download.attempt(self._wire.http, url)
                return
            except ChecksumMismatch:
                damaged += 1
                if damaged > 1 or not before:
                    raise
            except (httpx.TransportError, httpx.HTTPStatusError) as error:
                if isinstance(error, httpx.HTTPStatusError):
                    if error.response.status_code not in BUSY:
                        raise problem_of(error.response) from error
                elif download.bytes_here > before:
                    patience = Patience(self._wire.retry_s)
                patience.pause_or_raise(self.url, error)

    # Catalogue

    def presets(self) -> Presets:
        """The presets, and which one a job gets that names none."""
        return Presets.model_validate(self._get("/v1/presets"))

    def options_schema(self) -> dict[str, Any]:
        """JSON Schema of all options."""
        schema: dict[str, Any] = self._get("/v1/options")
        return schema

    def export_kinds(self) -> list[ExportKind]:
        """What can be exported, with JSON Schema of each kind's options."""
        found = self._get("/v1/exports/kinds")
        return [ExportKind.model_validate(item) for item in found["items"]]

    # The wire

    def _get(self, path: str, params: dict[str, Any] | None = None) -> Any:
        return self._wire.get(path, params).json()

    def _items(self, path: str, params: dict[str, Any]) -> Iterator[Any]:
        cursor: str | None = None
        while True:
            page = self._get(path, {**params, **({"cursor": cursor} if cursor else {})})
            yield from page["items"]
            cursor = page["next_cursor"]
            if cursor is None:
                return

    def _delete(self, path: str) -> None:
        tries = 0

        def send() -> httpx.Response:
            nonlocal tries
            tries += 1
            return self._wire.http.delete(path)

        answer = self._wire.send(send)
        if answer.status_code == 404 and tries > 1:
            return  # an earlier try arrived, its answer did not
        checked(answer)
