"""Wakes a Celery consumer that has gone deaf.

Where Redis is away at the moment in which a pool thread acknowledges a message, Celery 5.7 logs
"Couldn't ack", drops the consumer's connection in that thread, and its main loop never learns of
it: the process lives and consumes nothing (the family of celery#10205). A worker that finds a stage
for which the bell rang and no idle slot came therefore asks for a reconnect: an error raised inside
the consumer's own loop, which takes the way of every lost connection. Running tasks go on.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

_log = logging.getLogger("nerfworks.worker")
PAUSE_S = 5.0


class ConsumerLink:
    """The way from housekeeping to the consumer of this process."""

    def __init__(self) -> None:
        self._consumer: Any = None
        self._lock = threading.Lock()
        self._asked_at = -PAUSE_S

    def attach(self, consumer: Any) -> None:
        """Name the consumer: Celery hands it out when it is ready."""
        self._consumer = consumer

    def reconnect(self) -> None:
        """Have the consumer drop its connection and make a new one; not oftener than PAUSE_S."""
        with self._lock:
            if self._consumer is None or time.monotonic() - self._asked_at < PAUSE_S:
                return
            self._asked_at = time.monotonic()
        _log.warning("the bell rang and was not heard: the consumer connects anew")
        self._consumer.call_soon(_break_connection)


def _break_connection() -> None:
    raise ConnectionResetError("asked to connect anew")
