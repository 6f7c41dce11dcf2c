"""The takes by name: what `python -m pipelines.sample --scene` films and benchmarks judge."""

from __future__ import annotations

import types

from pipelines.sample.film import SAMPLE_TAKE
from pipelines.sample.scenes import cafe, exhibit, furniture, monument, room
from pipelines.sample.scenes import object as object_on_stand
from pipelines.sample.takes import Take

TAKES: types.MappingProxyType[str, Take] = types.MappingProxyType(
    {
        take.scene.name: take
        for take in (
            SAMPLE_TAKE,
            room.TAKE,
            object_on_stand.TAKE,
            furniture.TAKE,
            cafe.TAKE,
            monument.TAKE,
            exhibit.TAKE,
        )
    }
)
