"""The broker behind the bell: Celery, which is imported here alone, and when it is first needed.

An API must answer as soon as it can, and its first answers need no broker.
"""

from __future__ import annotations

from celery import Celery
from kombu.exceptions import KombuError
from redis.exceptions import RedisError

from storage.queue import TASK_RUN_STAGE

ONCE = {"max_retries": 1, "interval_start": 0.1}


class BrokerError(OSError):
    """The broker is away, did not answer in time, or refused."""


class Broker:
    """One Redis, by Celery's protocol. Safe to share between threads."""

    def __init__(self, redis_url: str, timeout_s: float) -> None:
        """timeout_s: how long it may take to connect, and to answer."""
        self._timeout_s = timeout_s
        self._celery = Celery("nerfworks-bell", broker=redis_url, set_as_current=False)
        self._celery.conf.update(
            task_serializer="json",
            task_ignore_result=True,
            broker_pool_limit=2,
            broker_connection_timeout=timeout_s,
            broker_transport_options={
                "socket_connect_timeout": timeout_s,
                "socket_timeout": timeout_s,
                "socket_keepalive": True,
                "interval_max": 0.2,
                **ONCE,
            },
        )

    def send(self, stage_id: str, queue: str) -> None:
        """Have one message wait in a queue. Raises BrokerError."""
        try:
            self._celery.send_task(
                TASK_RUN_STAGE,
                args=[stage_id],
                queue=queue,
                ignore_result=True,
                retry=True,  # once: a connection of the pool may be of a broker that is no more
                retry_policy={**ONCE, "interval_step": 0.1},
            )
        except (KombuError, RedisError, OSError) as error:
            raise BrokerError(type(error).__name__) from error  # its text may hold the password

    def ping(self) -> None:
        """Raises BrokerError where it does not answer."""
        try:
            with self._celery.connection_for_write() as connection:
                connection.ensure_connection(**ONCE, timeout=self._timeout_s)
        except (KombuError, RedisError, OSError) as error:
            raise BrokerError(type(error).__name__) from error  # its text may hold the password

    def close(self) -> None:
        """Close its connections."""
        self._celery.close()
