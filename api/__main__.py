"""`python -m api --host HOST --port PORT`: the API as a process."""

from __future__ import annotations

import argparse
import logging
import sys

import uvicorn

from api.app import create_app
from api.settings import ApiSettings
from storage.memory_privacy import close_memory

GRACE_S = 5
SWITCH_S = 0.001
"""How long a thread that waits for Python's lock lets another go on. A request takes that lock many
times, once after each answer of the database: with the default of 5 ms a short one waits for its
turn far longer than it works."""
KEEP_ALIVE_S = 75
"""A connection that is closed while a caller's next request is on its way costs that request: who
polls every few seconds should never meet that."""


def main(arguments: list[str] | None = None) -> int:
    """Serve until SIGINT or SIGTERM."""
    close_memory()
    sys.setswitchinterval(SWITCH_S)
    settings = ApiSettings()
    parser = argparse.ArgumentParser(prog="python -m api", description=__doc__)
    parser.add_argument("--host", default=settings.host, help="address to listen on")
    parser.add_argument("--port", type=int, default=settings.port, help="port to listen on")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    uvicorn.run(
        create_app(settings),
        host=options.host,
        port=options.port,
        log_config=None,
        access_log=False,  # `api.errors` writes one, with request ids and without signed URLs
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        timeout_keep_alive=KEEP_ALIVE_S,
        h11_max_incomplete_event_size=64 << 10,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
