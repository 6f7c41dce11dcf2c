"""`make up`: keeps the embedded service running from this folder.

Prints the URL and an API key, writes both to HOME/service.json (readable by its owner alone), and
supervises until Ctrl-C or SIGTERM: what crashes is started again within seconds, on the same port,
with the same key.
"""

from __future__ import annotations

import argparse
import fcntl
import importlib.util
import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import IO

from deploy.embedded import Embedded, default_home, port_is_free, write_private
from deploy.supervisor import StartFailed
from storage.memory_privacy import close_memory


def take_lock(home: Path) -> IO[str] | None:
    """Hold the home for this process, so that two services never share it. None: taken."""
    home.mkdir(parents=True, exist_ok=True)
    lock = (home / "lock").open("w", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock


def missing_parts() -> list[str]:
    """Libraries of the service that this installation lacks: a caller's has the client alone."""
    needed = ("fastapi", "sqlalchemy", "celery", "torch", "pycolmap")
    return [name for name in needed if importlib.util.find_spec(name) is None]


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line; environment variables give the defaults."""
    parser = argparse.ArgumentParser(prog="nerfworks up", description=__doc__)
    parser.add_argument("--host", default=os.environ.get("HOST", "127.0.0.1"))
    parser.add_argument("--port", type=int, default=int(os.environ.get("PORT", "8000")))
    parser.add_argument("--slots", type=int, help="stages at the same time; the worker chooses")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run until asked to stop. Returns the process's exit status."""
    options = parse(arguments)
    if missing := missing_parts():
        print(
            f"The service is not installed here: {', '.join(missing)} is missing. "
            "Install it: pip install 'nerfworks[server,worker]'",
            file=sys.stderr,
        )
        return 1
    home = default_home()
    lock = take_lock(home)
    if lock is None:
        print(f"A service already runs from {home}. See `nerfworks list`.", file=sys.stderr)
        return 1
    if not port_is_free(options.host, options.port):
        print(
            f"Port {options.port} is taken. Choose another: make up PORT={options.port + 1}",
            file=sys.stderr,
        )
        return 1
    close_memory()
    service_file = home / "service.json"
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    embedded = Embedded.at(home, options.host, options.port)
    supervisor = embedded.supervisor(lambda line: print(line, flush=True), options.slots)
    try:
        supervisor.start()
        write_private(
            service_file,
            json.dumps(
                {"url": embedded.url, "api_key": embedded.secrets.api_key, "pid": os.getpid()}
            ),
        )
        print(
            f"nerfworks runs at {embedded.url} (documentation: {embedded.url}/docs)\n"
            f"API key: {embedded.secrets.api_key}\n"
            "Send a capture: .venv/bin/nerfworks submit VIDEO --wait --download out/VIDEO\n"
            "Ctrl-C stops it; jobs go on where they were when it is started again.",
            flush=True,
        )
        while not stop.wait(0.5):
            pass
        print("Stopping", flush=True)
    except StartFailed as error:
        print(f"The service could not start. {error}", file=sys.stderr)
        return 1
    finally:
        service_file.unlink(missing_ok=True)
        supervisor.stop()
        lock.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
