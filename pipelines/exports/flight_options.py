"""Options of what is filmed along a path. Light: the API reads them.

Wrong requests are refused here, with the range, before anything is rendered.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import Field, model_validator

from pipelines.exports.options import RenderingOptions
from pipelines.exports.paths.options import MAX_FRAMES, MAX_SIDE_PX, CameraType, PathOptions
from pipelines.exports.wishes import LENGTH, SIZE, chosen


class FlightOptions(RenderingOptions, PathOptions):
    """A flight and its files."""

    camera: CameraType = Field(
        "perspective",
        description="fisheye is a circle of fisheye_fov_deg, the angle growing evenly from its "
        "middle; equirectangular is all round, for 360-degree players, and its MP4 says so.",
    )
    fisheye_fov_deg: float = Field(
        180.0, ge=20, le=220, description="What the fisheye's circle shows. Unit: degrees."
    )
    codec: Literal["h264", "hevc", "av1", "png"] = Field(
        "h264", description="png is a zip of pictures in place of videos."
    )
    num_frames: int | None = Field(
        None,
        ge=8,
        le=MAX_FRAMES,
        description="Frames rendered; null, and without seconds, for as many as turn_deg_per_s "
        "takes.",
    )
    seconds: float | None = Field(
        None, gt=0, le=3600, description="In place of num_frames: how long it is."
    )
    turn_deg_per_s: float = Field(
        45.0,
        ge=1,
        le=3600,
        description="Where neither num_frames nor seconds is given: how fast the view turns, on "
        "average, as far as min_seconds and max_seconds allow. Unit: degrees per second.",
    )
    min_seconds: float = Field(
        10.0, gt=0, le=3600, description="How long it is at least, by turn_deg_per_s."
    )
    max_seconds: float = Field(
        30.0, gt=0, le=3600, description="How long it is at most, by turn_deg_per_s."
    )
    fps: float = Field(24.0, ge=1, le=120, description="Frames per second.")
    long_side_px: int = Field(
        1280, ge=64, le=MAX_SIDE_PX, description="Long side of the video, in pixels."
    )
    width_px: int | None = Field(
        None,
        ge=16,
        le=MAX_SIDE_PX,
        multiple_of=2,
        description="With height_px, in place of long_side_px: the size, whatever the capture's.",
    )
    height_px: int | None = Field(
        None, ge=16, le=MAX_SIDE_PX, multiple_of=2, description="As width_px."
    )
    crf: int = Field(
        18, ge=0, le=40, description="The codec's quality; lower is better and larger."
    )

    @model_validator(mode="after")
    def _is_no_larger_than_it_may_be(self) -> FlightOptions:
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px and height_px belong together")
        if self.min_seconds > self.max_seconds:
            raise ValueError("min_seconds must not be more than max_seconds")
        known = self.frames()
        for count in (
            (self.frames_for(0.0), self.frames_for(math.inf)) if known is None else [known]
        ):
            if not 2 <= count <= MAX_FRAMES:
                raise ValueError(
                    f"the video would have {count} frames; 2 to {MAX_FRAMES} are possible"
                )
        if self.codec != "png" and self.num_side_by_side() * self.size()[0] > 2 * MAX_SIDE_PX:
            raise ValueError(
                f"side by side the video would be wider than {2 * MAX_SIDE_PX} px, which no codec "
                "takes"
            )
        return self

    @model_validator(mode="after")
    def _suits_its_camera(self) -> FlightOptions:
        wide = self.camera_type() != "perspective"
        if wide and self.path == "keyframes" and self.keyframes[0].fov_deg:
            raise ValueError(
                f"fov_deg of keyframes is for perspective cameras; the camera is {self.camera}"
            )
        if self.camera_type() != "equirectangular":
            return self
        if self.num_side_by_side() > 1:
            raise ValueError(
                "an equirectangular video cannot have several outputs side by side: players wrap "
                "the picture round the viewer"
            )
        width, height = self.size()
        if self.path != "camera_path" and width != 2 * height:
            raise ValueError(
                f"an equirectangular picture is twice as wide as it is high, not {width}x{height}"
            )
        return self

    @classmethod
    def understood(
        cls, base: dict[str, Any], given: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """As in StageOptions: the length or the size that is asked for is what counts."""
        base, given = super().understood(base, given)
        return chosen(SIZE, chosen(LENGTH, base, given), given), given

    def num_side_by_side(self) -> int:
        """How many outputs one picture holds."""
        return 1

    def camera_type(self) -> CameraType:
        """The camera: a file's own, where the path is one."""
        if self.path == "camera_path" and self.camera_path is not None:
            return self.camera_path.camera_type
        return self.camera

    def frames(self) -> int | None:
        """How many frames there are; None where that is left to how far the way turns."""
        if self.path == "camera_path" and self.camera_path is not None:
            return self.camera_path.frames()
        durations = self.durations_s()
        seconds = sum(durations) if durations else self.seconds
        return self.num_frames if seconds is None else round(seconds * self.fps)

    def frames_for(self, turned_deg: float) -> int:
        """How many a way has that turns so far, where it is left to that."""
        seconds = max(self.min_seconds, min(turned_deg / self.turn_deg_per_s, self.max_seconds))
        return round(seconds * self.fps)

    def frame_rate(self) -> float:
        """Frames per second."""
        if self.path == "camera_path" and self.camera_path is not None:
            return self.camera_path.fps
        return self.fps

    def has_own_size(self) -> bool:
        """Whether the picture has another shape than the captured ones."""
        return (
            self.path == "camera_path"
            or self.width_px is not None
            or self.camera_type() != "perspective"
        )

    def size(self) -> tuple[int, int]:
        """Width and height that are asked for; of a perspective camera the long side twice."""
        if self.path == "camera_path" and self.camera_path is not None:
            return _even(self.camera_path.render_width), _even(self.camera_path.render_height)
        if self.width_px is not None and self.height_px is not None:
            return self.width_px, self.height_px
        if self.camera == "equirectangular":
            half = _even(self.long_side_px // 2)
            return 2 * half, half
        if self.camera == "fisheye":
            return _even(self.long_side_px), _even(self.long_side_px)
        return self.long_side_px, self.long_side_px


def _even(side: int) -> int:
    return side - side % 2
