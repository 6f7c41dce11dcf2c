"""`python -m worker`: one worker process, with as many slots as asked for.

SIGTERM (and Ctrl-C) asks the running stages to stop, gives them back without counting an attempt,
and ends within seconds. A worker that starts again under the same --id frees at once what its
former self held.
"""

from __future__ import annotations

import argparse
import logging
import os
import socket
import sys
import threading
from typing import Any

from celery.signals import worker_ready, worker_shutting_down

from storage.memory_privacy import close_memory
from storage.queue import QUEUES
from storage.schema import upgrade
from storage.settings import StorageSettings
from worker.app import make_app
from worker.consumer import ConsumerLink
from worker.cores import num_cores
from worker.gpu import find_gpu
from worker.runtime import WorkerIdentity, WorkerRuntime, set_current_runtime
from worker.settings import WorkerSettings

EXIT_LIMIT_S = 20.0
MANY_CORES = 8
MAX_ID_CHARS = 100


def _queues(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names or not set(names) <= set(QUEUES):
        raise argparse.ArgumentTypeError(f"queues are {', '.join(QUEUES)}")
    return names


def _slots(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 64:
        raise argparse.ArgumentTypeError("slots are a number from 1 to 64")
    return int(text)


def _worker_id(text: str) -> str:
    if not 1 <= len(text) <= MAX_ID_CHARS or not text.isprintable():
        raise argparse.ArgumentTypeError(f"an id has 1 to {MAX_ID_CHARS} characters")
    return text


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m worker", description="Runs stages of jobs.")
    parser.add_argument(
        "--slots",
        type=_slots,
        help=f"stages at once (default 1; 2 with a GPU or {MANY_CORES} processor cores)",
    )
    parser.add_argument(
        "--queues", type=_queues, default=QUEUES, help=f"any of {','.join(QUEUES)} (default all)"
    )
    parser.add_argument(
        "--id",
        type=_worker_id,
        default=f"{socket.gethostname()}-{os.getpid()}",
        help="a name that stays the same when this worker is started again",
    )
    return parser.parse_args(arguments)


def default_slots(has_gpu: bool, cores: int) -> int:
    """Stages at once where nobody says: docs/architecture.md, "Slots", has the measurements."""
    return 2 if has_gpu or cores >= MANY_CORES else 1


def _exit_in_time() -> None:
    timer = threading.Timer(EXIT_LIMIT_S, os._exit, args=(1,))
    timer.daemon = True
    timer.start()


def main(arguments: list[str] | None = None) -> None:
    """Serve until a signal."""
    chosen = parse_arguments(sys.argv[1:] if arguments is None else arguments)
    logging.basicConfig(
        level=logging.INFO,
        stream=sys.stderr,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    close_memory()
    storage = StorageSettings()
    upgrade(storage.resolved_database_url)  # whoever starts first makes the schema
    link = ConsumerLink()
    settings = WorkerSettings()
    has_gpu = find_gpu(storage, settings)
    slots = chosen.slots or default_slots(has_gpu, num_cores())
    identity = WorkerIdentity.of(chosen.id, slots, chosen.queues, has_gpu)
    if not identity.queues:
        sys.exit(
            "This worker serves only the queue gpu, and there is no GPU here that its stages can "
            "use. Start it with --queues cpu,light, or where there is one."
        )
    runtime = WorkerRuntime(
        identity,
        storage,
        settings,
        registry=os.environ.get("NERFWORKS_REGISTRY", "pipelines.registry"),
        on_unheard=link.reconnect,
    )
    set_current_runtime(runtime)

    def on_shutdown(**_: Any) -> None:
        runtime.shutdown.set()
        _exit_in_time()

    def on_ready(sender: Any, **_: Any) -> None:
        link.attach(sender)

    worker_shutting_down.connect(on_shutdown, weak=False)
    worker_ready.connect(on_ready, weak=False)
    runtime.start()
    try:
        # Not `worker_main`: Celery's command line takes half a second of every start to load.
        program = make_app(storage).Worker(
            hostname=f"{chosen.id}@{socket.gethostname()}",
            pool="threads",
            concurrency=slots,
            queues=runtime.identity.queues,
            loglevel="INFO",
            without_gossip=True,
            without_mingle=True,
            without_heartbeat=True,
        )
        program.start()
    finally:
        runtime.close()
    sys.exit(program.exitcode)


if __name__ == "__main__":
    main()
