"""Options of camera paths. Light: the API reads them.

World units and the world of `cameras.json`, OpenGL cameras. Wrong requests are refused here, with
the range, before anything is rendered.
"""

from __future__ import annotations

import json
import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from pipelines.exports.paths.catalogue import PATHS
from pipelines.exports.wishes import with_its_path
from pipelines.option_models import StageOptions

CameraType = Literal["perspective", "fisheye", "equirectangular"]
"""Named as nerfstudio's files name them."""

_World = Annotated[float, Field(ge=-1e6, le=1e6)]
_Fov = Annotated[float, Field(ge=1.0, le=150.0)]
_Point = tuple[_World, _World, _World]
_Turn = Annotated[float, Field(ge=-1e3, le=1e3)]
_NOT_RIGID = 0.01
_SAME_PLACE = 1e-9
_SHORTEST_S = 1e-3
"""Of a way between two keyframes: less is no frame at any rate, and tiny numbers overflow."""
MAX_FRAMES = 20_000
MAX_SIDE_PX = 8192


class OrbitOptions(StageOptions):
    """A circle around what the cameras look at."""

    height: float | None = Field(
        None,
        ge=-0.98,
        le=0.98,
        description="How far above it the camera is, in units of its distance; null for the median "
        "of the captured cameras.",
    )
    distance: float = Field(
        1.0, ge=0.1, le=10, description="Times the median distance of the captured cameras."
    )
    tilt_deg: float = Field(
        0.0,
        ge=-80,
        le=80,
        description="The camera looks so far above what it circles, or below. Unit: degrees.",
    )
    turns: float = Field(1.0, ge=0.05, le=100, description="Times round; less than 1 is an arc.")


class SpiralOptions(StageOptions):
    """A spiral before what the cameras look at, for captures from one side."""

    radius: float = Field(
        0.1, gt=0, le=2, description="In units of the distance to what is looked at."
    )
    turns: float = Field(2.0, ge=0.05, le=100, description="Times round.")


class Keyframe(StageOptions):
    """A place that the camera passes."""

    position: _Point = Field(description="Where the camera is. Unit: the world's.")
    look_at: _Point | None = Field(None, description="What is in the middle of the picture.")
    rotation: tuple[_Turn, _Turn, _Turn, _Turn] | None = Field(
        None,
        description="In place of look_at: world_from_camera as a quaternion w, x, y, z; a camera "
        "looks along its -Z and +Y is up.",
    )
    fov_deg: _Fov | None = Field(
        None, description="Vertical field of view; null for the capture's. Unit: degrees."
    )
    seconds: float | None = Field(
        None,
        ge=_SHORTEST_S,
        le=3600,
        description="How long it takes to come here from the one before.",
    )
    speed: float | None = Field(
        None,
        ge=1e-6,
        le=1e6,
        description="In place of seconds: how fast. Unit: the world's per second.",
    )

    @model_validator(mode="after")
    def _says_where_it_looks(self) -> Keyframe:
        if (self.look_at is None) == (self.rotation is None):
            raise ValueError("must have one of look_at and rotation")
        if self.rotation is not None and math.hypot(*self.rotation) < 1e-6:
            raise ValueError("rotation must not be 0")
        if self.look_at and math.dist(self.look_at, self.position) <= _SAME_PLACE:
            raise ValueError("look_at must not be the position itself")
        if self.seconds is not None and self.speed is not None:
            raise ValueError("must not have both seconds and speed")
        return self


def _listed(matrix: Any) -> Any:
    """A matrix as a list of numbers, also where it was written as text."""
    if not isinstance(matrix, str):
        return matrix
    try:
        return json.loads(matrix)
    except ValueError as error:
        raise ValueError(f"is no list in JSON: {error}") from error


def _rigid(matrix: list[float]) -> list[float]:
    """The matrix, if it turns and moves and does nothing else."""
    columns = [[matrix[4 * row + column] for row in range(3)] for column in range(3)]
    lengths = [math.hypot(*column) for column in columns]
    slants = [
        sum(a * b for a, b in zip(columns[i], columns[j], strict=True))
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    (a, b, c), (d, e, f), (g, h, i) = columns
    volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    off = max(*(abs(length - 1.0) for length in lengths), *(abs(slant) for slant in slants))
    if off > _NOT_RIGID or volume < 0:
        raise ValueError("must be a 4x4 matrix by rows that turns and moves, without scale")
    return matrix


_Matrix = Annotated[
    list[Annotated[float, Field(allow_inf_nan=False)]],
    BeforeValidator(_listed),
    Field(min_length=16, max_length=16),
    AfterValidator(_rigid),
]


class _Nerfstudio(BaseModel):
    """Of its files what is used; the rest is left alone."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class NerfstudioPose(_Nerfstudio):
    """A frame. camera_to_world: 4x4, row by row."""

    camera_to_world: _Matrix
    fov: _Fov


class NerfstudioKeyframe(_Nerfstudio):
    """A place that its viewer's camera passes. matrix: 4x4, row by row."""

    matrix: _Matrix
    fov: _Fov
    override_transition_enabled: bool = False
    override_transition_sec: float | None = Field(None, ge=_SHORTEST_S, le=3600)


class NerfstudioPath(_Nerfstudio):
    """nerfstudio's camera_path.json, as it is; poses are taken for the world of cameras.json."""

    camera_type: CameraType = "perspective"
    render_height: int = Field(ge=16, le=MAX_SIDE_PX)
    render_width: int = Field(ge=16, le=MAX_SIDE_PX)
    fps: float = Field(ge=1, le=120)
    is_cycle: bool = False
    smoothness_value: float = Field(0.0, ge=0, le=1)
    default_transition_sec: float = Field(2.0, ge=_SHORTEST_S, le=3600)
    camera_path: list[NerfstudioPose] = Field(default_factory=list, max_length=MAX_FRAMES)
    keyframes: list[NerfstudioKeyframe] = Field(default_factory=list, max_length=MAX_FRAMES)

    @model_validator(mode="after")
    def _leads_somewhere(self) -> NerfstudioPath:
        if not self.camera_path and len(self.keyframes) < 2:
            raise ValueError("must have a camera_path, or at least 2 keyframes")
        return self

    def transitions_s(self) -> list[float]:
        """How long each way between its keyframes takes, the one back last."""
        ends = [*self.keyframes[1:], *([self.keyframes[0]] if self.is_cycle else [])]
        return [
            one.override_transition_sec
            if one.override_transition_enabled and one.override_transition_sec
            else self.default_transition_sec
            for one in ends
        ]

    def frames(self) -> int:
        """How many frames it has."""
        return len(self.camera_path) or max(2, round(sum(self.transitions_s()) * self.fps))


class PathOptions(StageOptions):
    """The way of the camera."""

    path: Literal[tuple(PATHS)] = Field(  # type: ignore[valid-type]
        "smooth",
        description="The way of the camera: smooth follows the captured one, orbit circles what "
        "the cameras look at, spiral turns before it, interpolate passes every captured pose, "
        "keyframes passes those below, camera_path is a file of nerfstudio's.",
    )
    orbit: OrbitOptions = Field(
        default_factory=lambda: OrbitOptions(), description="Of the path orbit."
    )
    spiral: SpiralOptions = Field(
        default_factory=lambda: SpiralOptions(), description="Of the path spiral."
    )
    keyframes: tuple[Keyframe, ...] = Field(
        (),
        max_length=1000,
        description="Of the path keyframes, at least 2: {position: [x, y, z], look_at: [x, y, z] "
        "or rotation: [w, x, y, z], fov_deg, seconds or speed}. seconds (or speed) is from the one "
        "before, for all or for none: then the video's length is shared out evenly.",
    )
    tension: float = Field(
        0.0,
        ge=-1,
        le=1,
        description="Of the paths keyframes and interpolate: 0 passes each pose smoothly, 1 stops "
        "there, -1 swings wide.",
    )
    loop: bool = Field(
        False, description="Of the path keyframes: go back to the first one, which has the time."
    )
    camera_path: NerfstudioPath | None = Field(
        None,
        description="Of the path camera_path: nerfstudio's camera_path.json as it is. Its size, "
        "camera type, frames per second and length count instead of those here.",
    )

    @model_validator(mode="after")
    def _has_what_its_path_needs(self) -> PathOptions:
        if self.path == "camera_path" and self.camera_path is None:
            raise ValueError("the path camera_path needs the option camera_path")
        if self.path == "keyframes":
            if len(self.keyframes) < 2:
                raise ValueError(
                    f"the path keyframes needs at least 2 keyframes, not {len(self.keyframes)}"
                )
            angles = [one.fov_deg for one in self.keyframes]
            if any(angles) and not all(angles):
                raise ValueError("fov_deg must be given for every keyframe, or for none")
            timed = [one.seconds or one.speed for one in self.keyframes[0 if self.loop else 1 :]]
            if any(timed) and not all(timed):
                raise ValueError(
                    "seconds or speed must be given for every keyframe but the first, which needs "
                    "it where loop is on, or for none"
                )
        return self

    @classmethod
    def understood(
        cls, base: dict[str, Any], given: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """As in StageOptions: a path's own options tell the path, and two files are not mixed."""
        base, given = super().understood(base, given)
        given = with_its_path(base, given)
        return ({**base, "camera_path": None} if "camera_path" in given else base), given

    def durations_s(self) -> list[float] | None:
        """How long each way between keyframes takes, the one back last; None where nobody says."""
        if self.path != "keyframes":
            return None
        ends = [*self.keyframes[1:], *([self.keyframes[0]] if self.loop else [])]
        found = []
        for begin, end in zip(self.keyframes, ends, strict=False):
            if end.seconds is None and end.speed is None:
                return None
            length = math.dist(begin.position, end.position)
            found.append(end.seconds or max(length, 1e-3) / (end.speed or 1.0))
        return found
