"""The rungs of the ladder that `pipelines.sfm.attempts` climbs: one line of `RUNGS` each.

A rung names the matches that it maps (`Matches`: features and pairs, one database, made once
however many rungs use it), how it maps them (`MapperSettings`), and when it is tried at all. To add
one, add a line; nothing else knows their names or their number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from pipelines.sfm.key_frames import LONG_FILM
from pipelines.tools.colmap_settings import MapperSettings, Thresholds

MAX_ALL_PAIRS = 300
"""Images beyond which all pairs are not matched: it would take hours."""

FEW_ENOUGH_FOR_ALL = 60
"""Up to here, all pairs are not many more than what the planned ones lead to."""

Reach = Literal["planned", "led", "all"]
"""Which pairs are matched: those that are planned; those alike and planned, and what they lead to;
all of up to MAX_ALL_PAIRS images."""


@dataclass(frozen=True)
class Matches:
    """Features and matches: what a database of the checkpoint holds.

    database: its name; who shares it shares features, too. key_frames: pairs of key frames, and of
    the others with those around them. doubled: whether images are doubled before features
    are looked for; False leaves that to `poses.upsample`. thorough: COLMAP's own number of trials
    for a pair.
    """

    database: str
    key_frames: bool = False
    doubled: bool = False
    reach: Reach = "planned"
    thorough: bool = False


@dataclass(frozen=True)
class Standing:
    """How far the climb has come. num_registered: of the best attempt so far, 0 before any.
    is_contradicted: whether matches contradict that one's model. is_film: whether neighbours in the
    list of images are neighbours in time, and may be chosen freely."""

    num_images: int
    num_registered: int
    wanted_ratio: float
    is_contradicted: bool = False
    is_film: bool = False


@dataclass(frozen=True)
class Rung:
    """One attempt. name: in logs and report.json. when: whether to try it, from where we stand."""

    name: str
    when: Callable[[Standing], bool]
    matches: Matches
    mapper: MapperSettings

    @property
    def is_relaxed(self) -> bool:
        """Whether it demands less than COLMAP does by default."""
        return self.mapper.thresholds != Thresholds()


def always(standing: Standing) -> bool:
    """In any case."""
    del standing
    return True


def long_film(standing: Standing) -> bool:
    """Where there are so many frames that most of them need not be mapped."""
    return standing.is_film and standing.num_images >= LONG_FILM


def not_yet_enough(standing: Standing) -> bool:
    """Where nothing was registered yet, or too little."""
    return standing.num_registered == 0 or too_few_registered(standing)


def too_few_registered(standing: Standing) -> bool:
    """Where no attempt so far has registered the wanted share of images, or not believably."""
    return (
        standing.is_contradicted
        or standing.num_registered < standing.wanted_ratio * standing.num_images
    )


_KEY_FRAMES = Matches("colmap", key_frames=True)
_PLANNED = Matches("colmap")
_LED = Matches("thorough", doubled=True, reach="led", thorough=True)
_ALL = replace(_LED, reach="all")
_LOW = Thresholds(
    min_num_matches=10,
    init_min_angle_deg=4.0,
    init_min_num_inliers=50,
    pose_min_num_inliers=15,
    pose_min_inlier_ratio=0.15,
)

RUNGS: tuple[Rung, ...] = (
    Rung("key frames", long_film, _KEY_FRAMES, MapperSettings()),
    Rung("quick", not_yet_enough, _PLANNED, MapperSettings()),
    Rung("thorough", too_few_registered, _LED, MapperSettings(thorough=True)),
    Rung("relaxed", too_few_registered, _ALL, MapperSettings(thorough=True, thresholds=_LOW)),
)
"""In the order of climbing; what the first that is tried matched is looked at for a camera that
only turned."""
