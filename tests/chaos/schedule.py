"""Which fault strikes when, for how long, and whom. It follows from the seed and nothing else."""

from __future__ import annotations

import random
from dataclasses import dataclass

APIS = ("api-1", "api-2")
WORKERS = ("worker-1", "worker-2", "worker-gpu")
SERVERS = ("redis", "postgres", "s3")
PARTIES = (*APIS, *WORKERS)
DISKS = ("machine-a", "machine-b", "apis", "s3")
"""Small disks: of the first two workers, of the one with the GPU, of both APIs, of the store."""
MEAN_GAP_S = 2.0
OUTAGE_S = 40.0


@dataclass(frozen=True)
class Fault:
    """at_s: seconds after the start. seconds: how long it lasts; 0 for a blow.

    target: a process, "stage:WORKER" (what it runs stages in), "PARTY>SERVER" or "*>SERVER" (a way
    that leads there), a disk, or "bell".
    """

    number: int
    at_s: float
    kind: str
    target: str
    seconds: float = 0.0

    def __str__(self) -> str:
        lasts = f" for {self.seconds:.1f} s" if self.seconds else ""
        return f"{self.at_s:6.1f} s  {self.kind} {self.target}{lasts}"


BLOWS = {"kill", "end", "double", "drop", "shuffle", "flush"}
KINDS: dict[str, tuple[int, tuple[str, ...], tuple[float, float]]] = {
    # kind: (how often, targets, shortest and longest seconds)
    "kill": (24, (*PARTIES, *SERVERS, *(f"stage:{one}" for one in WORKERS)), (0, 0)),
    "end": (4, PARTIES, (0, 0)),
    "freeze": (16, (*PARTIES, *SERVERS, *(f"stage:{one}" for one in WORKERS)), (1, 14)),
    "hang": (10, (), (2, 12)),
    "late": (8, (), (4, 12)),
    "lose": (10, (), (1, 6)),
    "refuse": (6, (), (1, 8)),
    "errors": (8, (), (2, 8)),
    "double": (4, ("bell",), (0, 0)),
    "drop": (4, ("bell",), (0, 0)),
    "shuffle": (3, ("bell",), (0, 0)),
    "flush": (3, ("bell",), (0, 0)),
    "fill": (6, DISKS, (2, 8)),
}
"""hang: accepts and never answers. late: answers after the deadline. lose: does what it is asked,
and the answer is lost. refuse: no connection. errors: 500 and 503. end: SIGTERM. fill: no byte is
left on a disk. drop, double, shuffle, flush: messages of the bell."""


def make_schedule(seed: int, seconds: float) -> list[Fault]:
    """Faults over so many seconds. Every kind strikes once before chance decides; in longer runs
    one outage of the store lasts, for all."""
    chance = random.Random(f"faults {seed}")
    first = [*KINDS]
    chance.shuffle(first)
    faults: list[Fault] = []
    moment = 1.0
    while (moment := moment + chance.expovariate(1.0 / MEAN_GAP_S)) < seconds:
        kinds, weights = [*KINDS], [weight for weight, _, _ in KINDS.values()]
        kind = first.pop() if first else chance.choices(kinds, weights)[0]
        _, targets, (shortest, longest) = KINDS[kind]
        target = chance.choice(targets) if targets else _way(chance, kind)
        lasts = 0.0 if kind in BLOWS else round(chance.uniform(shortest, longest), 1)
        faults.append(Fault(len(faults), round(moment, 1), kind, target, lasts))
    if seconds >= 4 * OUTAGE_S:
        at_s = round(chance.uniform(0.2, 0.6) * seconds, 1)
        faults.append(Fault(len(faults), at_s, "refuse", "*>s3", OUTAGE_S))
    return sorted(faults, key=lambda fault: fault.at_s)


def _way(chance: random.Random, kind: str) -> str:
    server = "s3" if kind == "errors" else chance.choice(SERVERS)
    party = chance.choice(PARTIES) if chance.random() < 0.75 else "*"
    return f"{party}>{server}"
