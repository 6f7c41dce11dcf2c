"""What a stage process loads while nothing is asked of it, so that the first job starts at once.

A stage's module may offer `preload()`: what its first run in a process would otherwise begin with.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator, Sequence

_log = logging.getLogger("nerfworks.worker")


def preload_steps(registry: str, stages: Sequence[str]) -> Iterator[str]:
    """Import the stages' code in order, a module after each `next`; names what was loaded.

    registry: dotted name of the registry's module. A module that cannot be loaded ends it with a
    warning: the stage will say what is missing when it runs.
    """
    try:
        known = importlib.import_module(registry)
        names = dict.fromkeys(known.get_stage(stage).run.partition(":")[0] for stage in stages)
        for name in names:
            module = importlib.import_module(name)
            yield name
            if hasattr(module, "preload"):
                module.preload()
                yield f"{name}.preload"
    except Exception:  # noqa: BLE001 whatever a stage's imports raise, other stages may still run
        _log.warning("not everything could be loaded in advance", exc_info=True)
