"""Whole services for whole jobs: real processes, real HTTP."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from api.client.client import Client
from deploy.embedded import Embedded, free_port
from deploy.supervisor import Supervisor
from pipelines.nerf.engines.cpu.parts.kernel_cache import CACHE_FOLDER
from tests.samples import sample_clip


@contextmanager
def running(
    home: Path, cache: Path, before: Callable[[Embedded], None] = lambda embedded: None
) -> Iterator[tuple[Client, Embedded, Supervisor]]:
    """The embedded service on a free port, stopped at the end whatever happens.

    before: called with what is prepared, when nothing of it runs yet.
    """
    embedded = Embedded.at(home, "127.0.0.1", free_port(), cache)
    before(embedded)
    supervisor = embedded.supervisor(print)
    supervisor.start()
    try:
        with Client(embedded.url, embedded.secrets.api_key) as client:
            yield client, embedded, supervisor
    finally:
        supervisor.stop()


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The sample capture and its truth (cameras.json), filmed once."""
    return sample_clip(tmp_path_factory.mktemp("sample"))


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all services of a run: the first job compiles its kernels, those after it find them.

    What other tests, or an earlier run, have compiled of the same sources is there already; that a
    contained process compiles from nothing is tested in tests/unit/worker/test_containment.py.
    """
    folder = tmp_path_factory.mktemp("cache")
    known = folder / "numba" / CACHE_FOLDER.name
    if CACHE_FOLDER.is_dir():  # in a fresh clone nothing was compiled yet
        passing = shutil.ignore_patterns("lock", "*.lock", "*.tmp*")
        shutil.copytree(CACHE_FOLDER, known, ignore=passing)
    return folder


@pytest.fixture
def service(tmp_path: Path, cache: Path) -> Iterator[tuple[Client, Embedded, Supervisor]]:
    """A fresh embedded service."""
    with running(tmp_path / "home", cache) as parts:
        yield parts
