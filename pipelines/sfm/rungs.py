"""The rungs of the ladder that `pipelines.sfm.attempts` climbs: one line of `RUNGS` each.

A rung names the matches that it maps (`Matches`: features and pairs, one database, made once
however many rungs use it), how it maps them (`MapperSettings`), and when it is tried at all. To add
one, add a line; nothing else knows their names or their number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipelines.tools.colmap import MapperSettings, Thresholds

MAX_ALL_PAIRS = 300
"""Images beyond which `all_pairs` is not done: it would take hours."""


@dataclass(frozen=True)
class Matches:
    """Features and matches: what a database of the checkpoint holds.

    database: its name, unique among `Matches`. doubled: whether images are doubled before features
    are looked for; False leaves that to `poses.upsample`. all_pairs: of up to MAX_ALL_PAIRS images,
    instead of the pairs that were planned. thorough: COLMAP's own number of trials for a pair.
    """

    database: str
    doubled: bool = False
    all_pairs: bool = False
    thorough: bool = False


@dataclass(frozen=True)
class Standing:
    """How far the climb has come. num_registered: of the best attempt so far, 0 before any.
    is_contradicted: whether matches contradict that one's model."""

    num_images: int
    num_registered: int
    wanted_ratio: float
    is_contradicted: bool = False


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


def too_few_registered(standing: Standing) -> bool:
    """Where no attempt so far has registered the wanted share of images, or not believably."""
    return (
        standing.is_contradicted
        or standing.num_registered < standing.wanted_ratio * standing.num_images
    )


_PLANNED = Matches("colmap")
_ALL = Matches("thorough", doubled=True, all_pairs=True, thorough=True)
_LOW = Thresholds(
    min_num_matches=10,
    init_min_angle_deg=4.0,
    init_min_num_inliers=50,
    pose_min_num_inliers=15,
    pose_min_inlier_ratio=0.15,
)

RUNGS: tuple[Rung, ...] = (
    Rung("quick", always, _PLANNED, MapperSettings()),
    Rung("thorough", too_few_registered, _ALL, MapperSettings(thorough=True)),
    Rung("relaxed", too_few_registered, _ALL, MapperSettings(thorough=True, thresholds=_LOW)),
)
"""In the order of climbing; the first is always tried, and what it matched is looked at for a
camera that only turned."""
