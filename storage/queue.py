"""The bell: Celery messages that tell a worker to look, and nothing more.

A message holds a stage's id. Losing one, or having it twice, does no harm: the claim in the
database decides, and every worker looks for stages that nobody came for. So sending is short, and
a broker that does not answer is logged and forgotten.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from typing import Any

from celery import Celery
from kombu.exceptions import KombuError
from redis.exceptions import RedisError
from sqlalchemy import select, update

from storage.db import Database, now
from storage.models import StageRow
from storage.records import has_live_gpu

QUEUE_CPU = "cpu"
QUEUE_GPU = "gpu"
QUEUE_LIGHT = "light"
QUEUES = (QUEUE_CPU, QUEUE_GPU, QUEUE_LIGHT)
TASK_RUN_STAGE = "nerfworks.run_stage"
TASK_SWEEP = "nerfworks.sweep"

_log = logging.getLogger("nerfworks.storage")


def queue_for(needs_gpu: bool, gpu_is_live: bool) -> str:
    """CPU workers serve GPU stages where no GPU worker is."""
    return QUEUE_GPU if needs_gpu and gpu_is_live else QUEUE_CPU


class Bell:
    """Rings workers through one broker. Safe to share between threads."""

    def __init__(self, redis_url: str) -> None:
        self._celery = Celery("nerfworks-bell", broker=redis_url, set_as_current=False)
        self._celery.conf.update(
            task_serializer="json",
            task_ignore_result=True,
            broker_pool_limit=2,
            broker_connection_timeout=2.0,
            broker_transport_options={
                "socket_connect_timeout": 2.0,
                "socket_timeout": 5.0,
                "max_retries": 1,
                "interval_start": 0.1,
                "interval_max": 0.2,
            },
        )
        self._lock = threading.Lock()

    def ring(self, database: Database, stage_ids: Iterable[str]) -> bool:
        """Send a message for each stage, after the commit that made it ready. Whether all went."""
        ids = list(stage_ids)
        if not ids:
            return True
        with database.read_scope() as session:
            rows = session.execute(
                select(StageRow.id, StageRow.needs_gpu).where(StageRow.id.in_(ids))
            ).all()
            gpu = has_live_gpu(session)
        sent = [
            row.id
            for row in rows
            if self._send(TASK_RUN_STAGE, [row.id], queue_for(row.needs_gpu, gpu))
        ]
        if sent:
            with database.session_scope() as session:
                rung = update(StageRow).where(StageRow.id.in_(sent), StageRow.state == "ready")
                session.execute(rung.values(rung_at=now(session)))
        return len(sent) == len(rows)

    def ring_sweep(self) -> bool:
        """Ask any worker for a round of housekeeping now. Whether the message went."""
        return self._send(TASK_SWEEP, [], QUEUE_LIGHT)

    def _send(self, task: str, args: list[Any], queue: str) -> bool:
        with self._lock:
            try:
                self._celery.send_task(
                    task,
                    args=args,
                    queue=queue,
                    ignore_result=True,
                    retry=True,
                    retry_policy={"max_retries": 1, "interval_start": 0.1, "interval_step": 0.1},
                )
            except (KombuError, RedisError, OSError) as error:
                _log.warning("the broker took no message (%s): %s", task, type(error).__name__)
                return False
        return True

    def ping(self) -> None:
        """Raise an error (KombuError, RedisError or OSError) where the broker does not answer."""
        with self._celery.connection_for_write() as connection:
            connection.ensure_connection(max_retries=1, interval_start=0.1, timeout=2.0)

    def close(self) -> None:
        """Close the connections."""
        self._celery.close()
