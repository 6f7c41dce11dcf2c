"""Workers and APIs of a test's own in processes of their own, which die at a named step.

They are forked from a process that has loaded all their code and runs no thread, so that one is up
in a moment.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path

import uvicorn

import api.idempotency
from api.app import create_app
from api.settings import ApiSettings
from storage.idempotency import claim
from storage.settings import StorageSettings
from storage.steps import watch
from tests.faults import kill_at
from worker.runtime import WorkerIdentity, WorkerRuntime
from worker.settings import WorkerSettings

TOYS = "tests.integration.toy_stages"
HOLD_S = 0.5
LIFE_S = 300.0
QUICK = WorkerSettings(
    heartbeat_s=0.3,
    cancel_poll_s=0.2,
    tick_s=0.1,
    clean_s=0.2,
    sweep_s=0.2,
    direct_after_s=0.0,
    prepare=False,
)
"""Leases are as long as ever: a test that wants one to be over says so to the reaper."""

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload([__name__])


def _begin(log: Path) -> None:
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    signal.alarm(int(LIFE_S))  # whatever becomes of the test


def _work(settings: StorageSettings, log: Path, step: str, nth: int, claims: int) -> None:
    _begin(log)
    watch(kill_at(step, nth, claims))
    identity = WorkerIdentity("victim", 1, ("cpu", "light"), False)
    runtime = WorkerRuntime(identity, settings, QUICK, registry=TOYS)
    signal.signal(signal.SIGTERM, lambda *_: runtime.shutdown.set())
    runtime.start()
    while True:
        time.sleep(1.0)


def _serve(settings: ApiSettings, log: Path, port: int, step: str, nth: int) -> None:
    _begin(log)
    watch(kill_at(step, nth))
    vars(api.idempotency)["claim"] = partial(claim, hold_s=HOLD_S)
    uvicorn.run(create_app(settings), host="127.0.0.1", port=port, log_config=None)


def worker_that_dies(
    settings: StorageSettings, log: Path, step: str, nth: int = 1, claims: int = 0
) -> BaseProcess:
    """A worker that takes what it finds, and is killed when it reaches a step so often, not counted
    what comes before the claim of that number."""
    return _started(partial(_work, settings, log, step, nth, claims))


def api_that_dies(
    settings: ApiSettings, log: Path, port: int, step: str, nth: int = 1
) -> BaseProcess:
    """An API, likewise. What it held under an Idempotency-Key is free after `HOLD_S`."""
    return _started(partial(_serve, settings, log, port, step, nth))


def _started(target: Callable[[], None]) -> BaseProcess:
    process = _context.Process(target=target, daemon=True)
    process.start()
    return process


def wait_for_death(process: BaseProcess, log: Path, timeout_s: float = 200.0) -> None:
    """Wait until it is killed at its step. Fails where it is not, or ends otherwise."""
    process.join(timeout_s)
    status = process.exitcode
    if status is None:
        process.kill()
        process.join()
    assert status == -signal.SIGKILL, f"ended as {status}\n{log.read_text()[-5000:]}"
