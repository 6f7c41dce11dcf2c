"""Whole services for whole jobs: real processes, real HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from api.client.client import Client
from deploy.embedded import Embedded, free_port
from deploy.supervisor import Supervisor
from tests.samples import sample_clip


@contextmanager
def running(home: Path, cache: Path) -> Iterator[tuple[Client, Embedded, Supervisor]]:
    """The embedded service on a free port, stopped at the end whatever happens."""
    embedded = Embedded.at(home, "127.0.0.1", free_port(), cache)
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
    """Empty at first: the first job compiles its kernels, those after it find them there."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def service(tmp_path: Path, cache: Path) -> Iterator[tuple[Client, Embedded, Supervisor]]:
    """A fresh embedded service."""
    with running(tmp_path / "home", cache) as parts:
        yield parts
