"""What a stage process may touch; light, for the process that reads it (`planning` makes it)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from worker.containment.limits import Limits


@dataclass(frozen=True)
class Plan:
    """For a stage process. mode: see `WorkerSettings.contain`. read, list, write, devices: paths,
    and what is below them. network, unix_sockets: whether such may be opened. names_threads: if it
    may name its own threads."""

    mode: str
    read: tuple[str, ...]
    list: tuple[str, ...]
    write: tuple[str, ...]
    devices: tuple[str, ...]
    limits: Limits
    network: bool
    unix_sockets: bool
    names_threads: bool
    environment: Mapping[str, str]

    def to_json(self) -> str:
        """For the stage process's command line, without what its environment says already."""
        return json.dumps({**asdict(self), "environment": {}})

    @classmethod
    def of_json(cls, text: str) -> Plan:
        """The other way round."""
        found: dict[str, Any] = json.loads(text)
        for name in ("read", "list", "write", "devices"):
            found[name] = tuple(found[name])
        found["limits"] = Limits(**found["limits"])
        return cls(**found)
