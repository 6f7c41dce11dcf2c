"""Carries a schedule out on a cluster, each fault for its time, and heals all in the end."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import random
import signal
import time
from collections.abc import Callable

import redis

from storage.queue import QUEUES
from tests.chaos.schedule import Fault
from tests.chaos.servers import LATE_S, Cluster, signal_all


class Faults:
    """One at a time or several at once, from one thread."""

    def __init__(self, cluster: Cluster, say: Callable[[str], None]) -> None:
        self._cluster = cluster
        self._say = say
        self.struck: dict[str, int] = {}

    def carry_out(self, schedule: list[Fault]) -> None:
        """Strike and heal at the times of the schedule; returns when the last is healed."""
        begun = time.monotonic()
        numbers = itertools.count()
        due: list[tuple[float, int, Callable[[], None]]] = []

        def at(moment: float, do: Callable[[], None]) -> None:
            heapq.heappush(due, (moment, next(numbers), do))

        def strike(fault: Fault) -> None:
            self._say(str(fault))
            undo = self._strike(fault)
            if undo is not None:
                at(fault.at_s + fault.seconds, undo)

        for fault in schedule:
            at(fault.at_s, lambda fault=fault: strike(fault))  # type: ignore[misc]
        try:
            while due:
                moment, _, do = heapq.heappop(due)
                time.sleep(max(begun + moment - time.monotonic(), 0.0))
                do()
        finally:
            for _, _, do in due:
                do()

    def _strike(self, fault: Fault) -> Callable[[], None] | None:
        """Returns what undoes it, where it lasts."""
        cluster, target = self._cluster, fault.target
        self.struck[fault.kind] = self.struck.get(fault.kind, 0) + 1
        if fault.kind in ("kill", "end"):
            number = signal.SIGKILL if fault.kind == "kill" else signal.SIGTERM
            signal_all(cluster.processes(target), number)
            return None
        if fault.kind == "freeze":
            pids = cluster.processes(target)
            signal_all(pids, signal.SIGSTOP)
            return lambda: signal_all(pids, signal.SIGCONT)
        if fault.kind == "fill":
            disk = cluster.disks[target]
            if not disk.is_small:
                self._say(f"         {target} is no disk of its own: not filled")
                return None
            filler = disk.fill()
            return lambda: filler.unlink(missing_ok=True)
        if target == "bell":
            with contextlib.suppress(redis.RedisError):
                self._garble(fault)
            return None
        begun = [(door, door.begin(fault.kind, LATE_S)) for door in cluster.doors_of(target)]

        def heal() -> None:
            for door, number in begun:
                door.end(number)

        return heal

    def _garble(self, fault: Fault) -> None:
        """Do something to the messages that wait."""
        chance = random.Random(f"bell {fault.number}")
        with self._cluster.message_queues() as connection:
            if fault.kind == "flush":
                connection.flushall()
                return
            for queue in QUEUES:
                held = list(connection.lrange(queue, 0, -1))
                if fault.kind == "double":
                    held += held
                elif fault.kind == "drop":
                    held = [one for one in held if chance.random() < 0.5]
                chance.shuffle(held)
                with connection.pipeline() as pipeline:
                    pipeline.delete(queue)
                    if held:
                        pipeline.rpush(queue, *held)
                    pipeline.execute()
