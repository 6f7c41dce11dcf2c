"""A worker that waits for the object store, and asks it only where it was away."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from deploy.embedded import free_port
from storage.breaker import Breaker
from storage.errors import ObjectMissingError, ObjectStoreError, ObjectStoreFullError
from storage.objects import OnBytes
from storage.objects_local import LocalObjectStore
from tests.integration.engine import Engine
from worker.runtime import WorkerIdentity, WorkerRuntime
from worker.settings import WorkerSettings
from worker.store_watch import StoreWatch

TOYS = "tests.integration.toy_stages"


class Store(LocalObjectStore):
    """A store in a folder that can be away."""

    def __init__(self, root: Path) -> None:
        super().__init__(root, public_url="http://localhost", signing_key=b"key")
        self.away = False
        self.asked = 0

    def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
        if self.away:
            raise ObjectStoreError("gone")
        super().get_file(key, path, on_bytes)

    def ping(self) -> None:
        self.asked += 1
        if self.away:
            raise ObjectStoreError("gone")
        super().ping()


@pytest.fixture
def parts(tmp_path: Path) -> tuple[Store, StoreWatch, Callable[[float], None]]:
    clock = [0.0]

    def later(seconds: float) -> None:
        clock[0] += seconds

    store = Store(tmp_path)
    return store, StoreWatch(store, Breaker(1.0, 4.0, lambda: clock[0])), later


def test_a_store_that_never_failed_is_not_asked(
    parts: tuple[Store, StoreWatch, Callable[[float], None]],
) -> None:
    store, watch, _ = parts
    assert watch.answers()
    assert not watch.is_pausing
    assert store.asked == 0


def test_while_it_is_away_it_is_asked_after_pauses_alone(
    parts: tuple[Store, StoreWatch, Callable[[float], None]],
) -> None:
    store, watch, later = parts
    store.away = True
    assert watch.is_away()
    assert watch.is_pausing
    for _ in range(5):
        assert not watch.answers()
    assert store.asked == 1
    later(1.1)
    assert not watch.is_pausing
    assert not watch.answers()
    assert store.asked == 2
    later(1.1)
    assert not watch.answers(), "the second pause is twice as long"
    assert store.asked == 2
    store.away = False
    later(1.1)
    assert watch.answers()
    assert not watch.is_away()
    assert not watch.is_pausing


def test_a_transfer_that_fails_while_the_store_answers_is_no_outage(
    parts: tuple[Store, StoreWatch, Callable[[float], None]],
) -> None:
    store, watch, _ = parts
    assert not watch.explains(ObjectStoreError("this one alone"))
    assert watch.answers()
    assert store.asked == 1


def test_only_what_an_outage_can_do_is_taken_for_one(
    parts: tuple[Store, StoreWatch, Callable[[float], None]],
) -> None:
    store, watch, _ = parts
    store.away = True
    for other in (ObjectMissingError("x"), ObjectStoreFullError("x"), OSError("x")):
        assert not watch.explains(other)
    assert store.asked == 0
    assert watch.explains(ObjectStoreError("x"))


def test_an_outage_fails_no_job_and_uses_up_no_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = Engine(tmp_path, f"redis://127.0.0.1:{free_port()}/0")
    store = Store(engine.settings.home / "objects")
    monkeypatch.setattr("worker.runtime.open_object_store", lambda settings: store)
    jobs = [engine.submit({}, ring=False) for _ in range(2)]
    settings = WorkerSettings(tick_s=0.1, direct_after_s=0.0, clean_s=600.0, prepare=False)
    identity = WorkerIdentity("w", 1, ("cpu", "light"), False)
    runtime = WorkerRuntime(identity, engine.settings, settings, registry=TOYS)
    store.away = True
    runtime.start()
    try:
        engine.wait(lambda: store.asked >= 3, 60)
        begun = [outcome for job in jobs for outcome in engine.outcomes(job, "ingest")]
        assert begun == ["released"], "it took what it could not run"
        assert engine.stage(jobs[0], "ingest").attempt == 0
        store.away = False
        for job in jobs:
            ended = engine.wait_for(job, "succeeded", "failed", timeout_s=120)
            assert ended.state == "succeeded", ended.error
        assert [row.attempt for row in engine.job(jobs[0]).stages] == [1] * 6
    finally:
        runtime.close()
        engine.close()
