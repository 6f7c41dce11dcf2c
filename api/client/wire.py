"""How the client reaches a service: where it is, what is tried again, what errors become."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx

from api.client.models import ApiProblem, ConnectionFailed

POLL_MIN_S, POLL_MAX_S = 0.2, 30.0
PAUSE_FIRST_S, PAUSE_MOST_S = 0.2, 5.0
TIMEOUT_S, CONNECT_TIMEOUT_S = 60.0, 5.0
TIMEOUT = httpx.Timeout(TIMEOUT_S, connect=CONNECT_TIMEOUT_S)
LOOK_S = 1.0
"""What a request has at least, however little time is left."""
BUSY = frozenset({502, 503, 504})
RUNNING = "idempotency_key_running"
_START = "Start one with `make up`, or set NERFWORKS_URL and NERFWORKS_API_KEY."


def find_service(url: str | None = None, api_key: str | None = None) -> tuple[str, str]:
    """(URL, key): as given, else NERFWORKS_URL and NERFWORKS_API_KEY, else the service that runs
    from this folder (service.json in NERFWORKS_HOME or .nerfworks).

    The key of service.json is only sent to the URL of service.json. Raises ConnectionFailed where
    no service is named.
    """
    url = url or os.environ.get("NERFWORKS_URL") or None
    api_key = api_key or os.environ.get("NERFWORKS_API_KEY") or None
    here: dict[str, Any] = {}
    path = Path(os.environ.get("NERFWORKS_HOME", ".nerfworks")) / "service.json"
    with suppress(OSError, json.JSONDecodeError):
        here = json.loads(path.read_text("utf-8"))
    url = url or here.get("url")
    if url is None:
        raise ConnectionFailed("No service runs from this folder.", _START)
    url = url.rstrip("/")
    if api_key is None and url == str(here.get("url", "")).rstrip("/"):
        api_key = here.get("api_key")
    return url, api_key or ""


class Wire:
    """One service's connections."""

    def __init__(self, url: str, api_key: str, retry_s: float) -> None:
        self.url = url
        self.retry_s = retry_s
        headers = {"Authorization": f"Bearer {api_key}"} if api_key else {}
        try:
            if httpx.URL(url).scheme not in ("http", "https") or not httpx.URL(url).host:
                raise ValueError("no http or https address")
            self.http = httpx.Client(base_url=url, headers=headers, timeout=TIMEOUT)
        except (httpx.InvalidURL, ValueError) as error:
            raise ConnectionFailed(f"{url!r} is no usable address.", _START) from error

    def get(self, path: str, params: dict[str, Any] | None = None) -> httpx.Response:
        """A successful GET. Raises ApiProblem, ConnectionFailed."""
        return checked(self.send(lambda: self.http.get(path, params=params)))

    def send(
        self, request: Callable[[], httpx.Response], until: float | None = None
    ) -> httpx.Response:
        """Send until there is an answer. What creates something carries an Idempotency-Key, so that
        sending it again never makes a second one.

        Raises ConnectionFailed where there is none for `retry_s` seconds after the first failure,
        or at the moment `until` of `time.monotonic`.
        """
        patience = Patience(self.retry_s, until)
        while True:
            try:
                answer = request()
            except httpx.TransportError as error:
                patience.pause_or_raise(self.url, error)
                continue
            if not is_busy(answer) or not patience.pause():
                return answer


def is_busy(answer: httpx.Response) -> bool:
    """Whether the same request may have a better answer in a moment."""
    if answer.status_code == 409:
        return problem_of(answer).code == RUNNING
    return answer.status_code in BUSY


def once_header(key: str | None) -> dict[str, str]:
    """The header that names one call, however often it is sent. key: None for a new one."""
    return {"Idempotency-Key": key or secrets.token_hex(16)}


class Patience:
    """Growing pauses between attempts, until the time is up.

    It counts from the first failure: an upload may take much longer than a service is away.
    """

    def __init__(self, seconds: float, until: float | None = None) -> None:
        """until: a moment of `time.monotonic` at which the time is up in any case."""
        self._seconds = seconds
        self._until = until
        self._deadline: float | None = None
        self._pause_s = PAUSE_FIRST_S

    def pause(self) -> bool:
        """An attempt failed: wait a little. False, at once, where the time is up."""
        moment = time.monotonic()
        if self._deadline is None:
            self._deadline = moment + self._seconds
            if self._until is not None:
                self._deadline = min(self._deadline, self._until)
        left_s = self._deadline - moment
        if left_s <= 0.0:
            return False
        time.sleep(min(self._pause_s, left_s))
        self._pause_s = min(self._pause_s * 1.6, PAUSE_MOST_S)
        return True

    def pause_or_raise(self, url: str, error: Exception) -> None:
        """The same; raises ConnectionFailed where the time is up."""
        if not self.pause():
            raise unreachable(url, error) from error


def timeout_until(until: float | None) -> httpx.Timeout:
    """How long a request may wait that should be over at a moment of `time.monotonic`."""
    if until is None:
        return TIMEOUT
    left_s = max(until - time.monotonic(), LOOK_S)
    return httpx.Timeout(min(left_s, TIMEOUT_S), connect=min(left_s, CONNECT_TIMEOUT_S))


def unreachable(url: str, error: Exception) -> ConnectionFailed:
    why = f" ({error})" if str(error) else ""
    return ConnectionFailed(
        f"The service at {url} cannot be reached{why}.", "Check that it runs: `make up` starts one."
    )


def segment(name: str) -> str:
    """One path segment."""
    return quote(name, safe="") or "-"


def poll_pause(answer: httpx.Response) -> float:
    """Seconds until the next look, as the service asks."""
    try:
        wanted = float(answer.headers.get("Retry-After", "1"))
    except ValueError:
        wanted = 1.0
    return min(max(wanted, POLL_MIN_S), POLL_MAX_S)


def problem_of(answer: httpx.Response) -> ApiProblem:
    """An error answer as an exception; also one that is no problem document."""
    found: dict[str, Any] = {}
    with suppress(ValueError):
        loaded = answer.json()
        found = loaded if isinstance(loaded, dict) else {}
    return ApiProblem(
        answer.status_code,
        str(found.get("code", "http_error")),
        str(found.get("detail", f"The service answered {answer.status_code}.")),
        str(found.get("hint", "")),
        tuple((str(item["path"]), str(item["detail"])) for item in found.get("errors", [])),
    )


def checked(answer: httpx.Response) -> httpx.Response:
    """The answer, if it is a success. Raises ApiProblem."""
    if answer.is_success:
        return answer
    raise problem_of(answer)
