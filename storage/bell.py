"""The bell: Celery messages that tell a worker to look, and nothing more.

A message holds a stage's id. Losing one, or having it twice, does no harm: the claim in the
database decides, and every worker looks for stages that nobody came for. So whoever rings never
waits: one thread sends, from a queue that is bounded; a broker that is away or hangs costs that
thread a few seconds now and then (`storage.breaker`), and what was to be sent meanwhile is dropped.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from typing import TYPE_CHECKING

from sqlalchemy import select, update

from storage.breaker import Breaker
from storage.db import Database, now
from storage.models import StageRow
from storage.queue import queue_for
from storage.records import has_live_gpu

if TYPE_CHECKING:
    from storage.broker import Broker

MAX_PENDING = 10_000
BATCH = 100
TIMEOUT_S = 4.0
CLOSE_S = 1.0

_log = logging.getLogger("nerfworks.storage")


class Bell:
    """Rings workers through one broker. Safe to share between threads; none of them waits."""

    def __init__(self, redis_url: str, database: Database, timeout_s: float = TIMEOUT_S) -> None:
        """timeout_s: how long the broker may take to connect, and to answer."""
        self._database = database
        self._timeout_s = timeout_s
        self._redis_url = redis_url
        self._opened: Broker | None = None
        self._opening = threading.Lock()
        self._preparing: threading.Timer | None = None
        self._breaker = Breaker()
        self._changed = threading.Condition()
        self._pending: dict[str, None] = {}  # in order, each id once
        self._sending = False
        self._closed = False
        self._thread: threading.Thread | None = None

    def ring(self, stage_ids: Iterable[str]) -> None:
        """Have a message sent for each stage, after the commit that made it ready. Never waits."""
        ids = list(stage_ids)
        if not ids or self._breaker.is_open:
            return
        with self._changed:
            if self._closed:
                return
            room = MAX_PENDING - len(self._pending)
            self._pending.update(dict.fromkeys(ids[: max(room, 0)]))
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, daemon=True, name="bell")
                self._thread.start()
            self._changed.notify_all()

    def flush(self, timeout_s: float) -> bool:
        """Wait until all that was rung is sent or given up. Whether it was in time."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._pending and not self._sending, timeout_s
            )

    def _serve(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pending or self._closed)
                if self._closed:
                    return
                batch = [*self._pending][:BATCH]
                for stage_id in batch:
                    del self._pending[stage_id]
                self._sending = True
            try:
                self._send_all(batch)
            except Exception:  # noqa: BLE001 the thread must outlive whatever it meets
                _log.warning("the bell could not ring for %d stages", len(batch), exc_info=True)
            finally:
                with self._changed:
                    self._sending = False
                    if self._breaker.is_open:
                        self._pending.clear()
                    self._changed.notify_all()

    def _send_all(self, stage_ids: list[str]) -> None:
        with self._database.read_scope() as session:
            rows = session.execute(
                select(StageRow.id, StageRow.resource).where(StageRow.id.in_(stage_ids))
            ).all()
            gpu = has_live_gpu(session)
        sent = []
        for row in rows:
            if not self._send(row.id, queue_for(row.resource, gpu)):
                break
            sent.append(row.id)
        if sent:
            with self._database.session_scope() as session:
                # A row that is being claimed is passed over: waiting for it, with others of its job
                # held, could end in a deadlock. One that is not marked is rung for again.
                free = (
                    select(StageRow.id)
                    .where(StageRow.id.in_(sent), StageRow.state == "ready")
                    .with_for_update(skip_locked=True, key_share=True)
                )
                rung = update(StageRow).where(StageRow.id.in_(free))
                session.execute(rung.values(rung_at=now(session)))

    def _send(self, stage_id: str, queue: str) -> bool:
        try:
            self._broker().send(stage_id, queue)
        except OSError as error:
            pause_s = self._breaker.failed()
            _log.warning(
                "the broker took no message (%s): the bell is silent for %.0f s",
                error,
                pause_s,
            )
            return False
        self._breaker.succeeded()
        return True

    def _broker(self) -> Broker:
        """Opened when first asked for, by a thread that may wait: that imports Celery."""
        with self._opening:
            if self._opened is None:
                from storage.broker import Broker

                self._opened = Broker(self._redis_url, self._timeout_s)
            return self._opened

    def prepare(self, delay_s: float) -> None:
        """Open the broker beside what else is done, so late: or the first to ring would have all
        others wait for its import. Never waits.
        """
        self._preparing = threading.Timer(delay_s, self._broker)
        self._preparing.daemon = True
        self._preparing.start()

    def ping(self) -> None:
        """Raises `storage.broker.BrokerError`, an OSError, where the broker does not answer."""
        self._broker().ping()

    def close(self) -> None:
        """Stop ringing: what is not sent by now, workers find by themselves."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(CLOSE_S)
        if self._preparing is not None:
            self._preparing.cancel()
        if self._opened is not None:
            self._opened.close()
