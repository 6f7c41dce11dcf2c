"""What an importer's reader gives: which files of an archive are pictures, and what is known of
each. Standard library only.

World frame: right-handed, +Z up. Camera frame: OpenGL (+X right, +Y up, looks along -Z).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics

Rows = tuple[tuple[float, ...], ...]
"""A matrix [3, 4]: rotation and position, row-major."""

Up = Literal["known", "assumed", "unknown"]
"""Where a world's up is: +Z; +Z only because files of this format mostly have it so; anywhere, as
structure from motion leaves it."""


@dataclass(frozen=True)
class Photos:
    """Pictures whose poses are to be found. names: in the archive, those that may be photos."""

    names: Sequence[str]


@dataclass(frozen=True)
class SensorDepth:
    """Depth that the phone measured beside a picture, along the camera's axis (z, not the ray).

    name: in the archive, of a format that `depth_files` reads. It shows what the picture shows, at
    a resolution of its own. unit: world units per stored value. lens: where another one than the
    picture's shows it, that lens for a picture of the size it is called with.
    confidence: a picture of the same size, or None; where it is below `least_confidence`, the depth
    counts as unknown.
    """

    name: str
    unit: float
    confidence: str | None = None
    least_confidence: int = 0
    lens: Callable[[int, int], Intrinsics] | None = None

    @property
    def files(self) -> list[str]:
        """Its files in the archive."""
        return [self.name] if self.confidence is None else [self.name, self.confidence]


@dataclass(frozen=True)
class PosedSource:
    """One picture of the archive that has a pose.

    name: in the archive. lens: gives the intrinsics for the picture's real width and height.
    world_from_camera: rows [3, 4] of finite numbers; whether they are a pose is checked later.
    frame: where `name` is a film, the number of its frame, counted from 0.
    mask: a picture in the archive, black where the picture is to be ignored, or None.
    depth: what the phone's sensor measured, in the unit of the poses, or None.
    """

    name: str
    lens: Callable[[int, int], Intrinsics]
    world_from_camera: Rows
    timestamp_s: float | None = None
    mask: str | None = None
    depth: SensorDepth | None = None
    frame: int | None = None

    @property
    def label(self) -> str:
        """What the picture is called where people read it."""
        return self.name if self.frame is None else f"{self.name} frame {self.frame}"

    @property
    def depth_files(self) -> list[str]:
        """The files of its depth in the archive."""
        return [] if self.depth is None else self.depth.files


@dataclass(frozen=True)
class SparsePoints:
    """Points that the program which found the poses has found with them.

    places: P rows of three numbers, in the world of the poses. colors: P rows of red, green, blue,
    0 to 255.
    """

    places: Sequence[Sequence[float]]
    colors: Sequence[Sequence[int]]


@dataclass(frozen=True)
class Reading:
    """One way in which poses that name no picture may belong to the pictures.

    rule: how it pairs them, as the end of "the poses belong to the pictures ...". is_plain: whether
    it is the only one that comes to mind, to be believed also where the pictures cannot tell.
    """

    rule: str
    sources: Sequence[PosedSource]
    is_plain: bool


@dataclass(frozen=True)
class PosedPictures:
    """A capture that brings its poses.

    sources: in the order of the capture. readings: where the files do not say which pose is which
    picture's, the ways in which they may; the pictures then say which of them is right
    (`pipelines.captures.pose_order`), and `sources` is that one's. failures: why frames beside
    those cannot be used, one error for each; few are passed over, many fail the capture.
    num_film_frames: how many frames the film of the sources must have for their numbers to be
    right, or None.
    up: see `Up`. metric: whether the world's unit is the metre. points: in the same world, or None.
    is_dense: whether neighbours are so alike that a long capture may be thinned. notes: about the
    world, for `cameras.json`. details, warnings: for the record.
    """

    sources: Sequence[PosedSource]
    metric: bool
    readings: Sequence[Reading] = ()
    num_film_frames: int | None = None
    failures: Sequence[CaptureError] = ()
    is_dense: bool = False
    up: Up = "known"
    points: SparsePoints | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()


Contents = Photos | PosedPictures
