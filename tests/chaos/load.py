"""Callers of both APIs: each job is submitted, and then cancelled, retried or deleted by its plan.

They use the service's own client, and what it cannot ride out they ride out by going to the other
API with the same idempotency key, as a program that wants its job done would.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import httpx

from api.client.client import ApiProblem, Client, ConnectionFailed
from tests.chaos.plans import GOOD_VIEWS, Plan

Result = TypeVar("Result")
CALLERS = 12
RIDE_OUT_S = 4.0
PAUSE_S = 0.5
MAY_PASS = frozenset({408, 409, 429, 499, 502, 503, 504, 507})


class GaveUpError(Exception):
    """Nobody answered a caller before its time was up."""


@dataclass
class Accepted:
    """A job that the service took. wanted: the state in which it must end, "" for none at all."""

    plan: Plan
    job_id: str
    capture_id: str
    wanted: str
    generation: int = 1


@dataclass
class Said:
    """What callers met. broken: answers that no request may ever get."""

    accepted: list[Accepted] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    refused: int = 0
    unreached: int = 0


class Callers:
    """Carries out plans. give_up: set when nothing is to be waited for any more."""

    def __init__(self, urls: list[str], api_key: str, folder: Path) -> None:
        self.said = Said()
        self.give_up = threading.Event()
        self._urls = urls
        self._api_key = api_key
        self._folder = folder
        self._lock = threading.Lock()
        self._local = threading.local()
        self._pool = ThreadPoolExecutor(CALLERS, thread_name_prefix="caller")
        self._plans: list[Future[None]] = []
        folder.mkdir()

    def start(self, plans: list[Plan]) -> None:
        """Have the plans carried out, each at its time."""
        begun = time.monotonic()
        self._plans = [self._pool.submit(self._guarded, plan, begun) for plan in plans]

    def are_done(self) -> bool:
        """Whether every plan was carried out, or given up."""
        return all(plan.done() for plan in self._plans)

    def close(self) -> None:
        """Wait for all; what was given up ends at its next look."""
        self._pool.shutdown(wait=True)

    def call(self, do: Callable[[Client], Result]) -> Result:
        """Ask one API, then the other, until one has an answer. Raises GaveUpError, ApiProblem."""
        while not self.give_up.is_set():
            client = self._next_client()
            try:
                return do(client)
            except ConnectionFailed:
                self._count("unreached")
            except httpx.HTTPError:  # in the middle of an answer
                self._count("unreached")
            except ApiProblem as problem:
                if problem.status == 500:
                    with self._lock:
                        self.said.broken.append(f"500 {problem.code} from {client.url}")
                elif problem.status not in MAY_PASS or problem.code in ("job_finished", "conflict"):
                    raise
                else:
                    self._count("refused")
            self.give_up.wait(PAUSE_S)
        raise GaveUpError

    def _count(self, what: str) -> None:
        with self._lock:
            setattr(self.said, what, getattr(self.said, what) + 1)

    def _next_client(self) -> Client:
        if not hasattr(self._local, "clients"):
            self._local.clients = [
                Client(url, self._api_key, retry_s=RIDE_OUT_S) for url in self._urls
            ]
        clients: list[Client] = self._local.clients
        clients.append(clients.pop(0))
        return clients[0]

    def _guarded(self, plan: Plan, begun: float) -> None:
        try:
            self.give_up.wait(max(begun + plan.at_s - time.monotonic(), 0.0))
            self._carry_out(plan)
        except GaveUpError:
            with self._lock:
                self.said.broken.append(f"{plan.fate} of {plan.name}: nobody answered in time")
        except Exception as error:  # noqa: BLE001 whatever it is belongs into the verdict
            with self._lock:
                self.said.broken.append(f"{plan.fate} of {plan.name}: {error!r}")

    def _carry_out(self, plan: Plan) -> None:
        source = self._folder / f"{plan.name}.zip"
        source.write_bytes(plan.capture())
        key = f"upload-{plan.name}"
        capture = self.call(lambda client: client.upload(source, idempotency_key=key))
        source.unlink()
        job = self.call(
            lambda client: client.create_job(
                capture.id,
                preset=plan.preset,
                options=plan.options(),
                labels={"plan": plan.name},
                idempotency_key=f"job-{plan.name}",
            )
        )
        wanted = {"fail": "failed", "retry": "failed"}.get(plan.fate, "succeeded")
        mine = Accepted(plan, job.id, capture.id, wanted)
        with self._lock:
            self.said.accepted.append(mine)
        if plan.fate == "cancel":
            self.give_up.wait(plan.cancel_after_s)
            self._cancel(mine)
        elif plan.fate == "retry":
            self._wait(mine)
            options = {"draft": {"num_views": GOOD_VIEWS}}
            key = f"retry-{plan.name}"
            self.call(lambda client: client.retry(job.id, options=options, idempotency_key=key))
            mine.wanted, mine.generation = "succeeded", 2
        elif plan.fate == "delete":
            self._wait(mine)
            self._delete(mine)

    def _cancel(self, mine: Accepted) -> None:
        try:
            self.call(lambda client: client.cancel(mine.job_id))
            mine.wanted = "cancelled"
        except ApiProblem as problem:
            if problem.code != "job_finished":
                raise

    def _wait(self, mine: Accepted) -> None:
        while not self.call(lambda client: client.get_job(mine.job_id)).is_over:
            if self.give_up.wait(2.0):
                raise GaveUpError

    def _delete(self, mine: Accepted) -> None:
        def gone(do: Callable[[Client], None]) -> None:
            try:
                self.call(do)
            except ApiProblem as problem:
                if problem.status != 404:  # an earlier try arrived, its answer did not
                    raise

        gone(lambda client: client.delete_job(mine.job_id))
        mine.wanted = ""
        gone(lambda client: client.delete_capture(mine.capture_id))
