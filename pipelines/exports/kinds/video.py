"""The video: a flight along a path of the catalogue, as colours, depth, normals or accumulation.

H.264 for any browser, HEVC, AV1, or a zip of PNG files. `preview.jpg` is a telling moment of the
flight at up to twice the video's size.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator, model_validator

from pipelines.exports.export import Export
from pipelines.exports.options import RenderingOptions
from pipelines.exports.paths.options import MAX_FRAMES, MAX_SIDE_PX, PathOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from pipelines.scene.depth_views import Pinhole
    from pipelines.scene.trained_scene import TrainedScene

    Frames = dict[str, NDArray[np.uint8]]

Output = Literal["rgb", "depth", "normals", "accumulation"]

_PREVIEW_ENLARGEMENT = 2
_PREVIEW_QUALITY = 93


class VideoOptions(RenderingOptions, PathOptions):
    """The video along a camera path."""

    outputs: tuple[Output, ...] = Field(
        ("rgb",),
        min_length=1,
        max_length=4,
        description="What is shown: rgb, depth, normals, accumulation.",
    )
    layout: Literal["separate", "side_by_side"] = Field(
        "separate",
        description="separate writes video.mp4 with rgb and video-<output>.mp4 with each other "
        "one; side_by_side all of them into video.mp4.",
    )
    codec: Literal["h264", "hevc", "av1", "png"] = Field(
        "h264", description="png is a zip of pictures in place of videos."
    )
    num_frames: int = Field(240, ge=8, le=MAX_FRAMES, description="Frames rendered.")
    seconds: float | None = Field(
        None, gt=0, le=3600, description="In place of num_frames: how long it is."
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

    @field_validator("outputs")
    @classmethod
    def _each_once(cls, outputs: tuple[Output, ...]) -> tuple[Output, ...]:
        return tuple(dict.fromkeys(outputs))

    @model_validator(mode="after")
    def _is_no_larger_than_it_may_be(self) -> VideoOptions:
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px and height_px belong together")
        if not 2 <= self.frames() <= MAX_FRAMES:
            raise ValueError(
                f"the video would have {self.frames()} frames; 2 to {MAX_FRAMES} are possible"
            )
        shown = len(self.outputs) if self.layout == "side_by_side" else 1
        if self.codec != "png" and shown * self.size()[0] > 2 * MAX_SIDE_PX:
            raise ValueError(
                f"side by side the video would be wider than {2 * MAX_SIDE_PX} px, which no codec "
                "takes"
            )
        return self

    def frames(self) -> int:
        """How many frames there are, as far as they are not listed one by one."""
        if self.path == "camera_path" and self.camera_path is not None:
            return self.camera_path.frames()
        durations = self.durations_s()
        seconds = sum(durations) if durations else self.seconds
        return self.num_frames if seconds is None else round(seconds * self.fps)

    def size(self) -> tuple[int, int]:
        """Width and height that are asked for, or the long side twice."""
        if self.path == "camera_path" and self.camera_path is not None:
            return _even(self.camera_path.render_width), _even(self.camera_path.render_height)
        if self.width_px is not None and self.height_px is not None:
            return self.width_px, self.height_px
        return self.long_side_px, self.long_side_px


def _even(side: int) -> int:
    return side - side % 2


def run(scene: TrainedScene, options: VideoOptions, ctx: StageContext) -> dict[str, Any]:
    """Render the flight. Raises ToolError where ffmpeg fails, ExportError as the path does."""
    # Imported where it runs: the API reads this file too.
    from PIL import Image

    from pipelines.exports.paths.flight import (
        lens_of_size,
        make_path,
        preview_index,
        typical_lens,
    )
    from pipelines.scene.depth_views import Pinhole

    images = scene.cameras.images
    lens = typical_lens([scene.lens_of(image) for image in images])
    own_size = options.path == "camera_path" or options.width_px is not None
    video_lens = (
        lens_of_size(lens, *options.size())
        if own_size
        else Pinhole.of(lens, options.long_side_px, multiple=2)
    )
    file = options.camera_path if options.path == "camera_path" else None
    fps = options.fps if file is None else file.fps
    flight = make_path(options, images, options.frames())
    draw = _drawer(scene, options, ctx)
    started = time.monotonic()
    with _writer(options, ctx, video_lens, fps) as write:
        for index, pose in enumerate(flight.poses):
            write(draw(flight.lens(index, video_lens), pose))
            done = index + 1
            eta = (time.monotonic() - started) / done * (len(flight) - done)
            ctx.progress(done / (len(flight) + 4), f"frame {done}/{len(flight)}", eta)
    ctx.progress(len(flight) / (len(flight) + 4), "preview picture")
    long_side = min(
        _PREVIEW_ENLARGEMENT * max(video_lens.width, video_lens.height),
        max(lens.width, lens.height, video_lens.width, video_lens.height),
    )
    moment = preview_index(flight.poses, images)
    picture = scene.picture(
        flight.lens(moment, Pinhole.of(video_lens.intrinsics(), long_side)), flight.poses[moment]
    )
    Image.fromarray(picture).save(ctx.out / "preview.jpg", quality=_PREVIEW_QUALITY)
    return {
        "path": options.path,
        "codec": options.codec,
        "num_frames": len(flight),
        "width": video_lens.width
        * (len(options.outputs) if options.layout == "side_by_side" else 1),
        "height": video_lens.height,
        "fps": fps,
        "duration_s": round(len(flight) / fps, 3),
        "bytes": sum(path.stat().st_size for path in ctx.out.glob("video*")),
    }


def _drawer(
    scene: TrainedScene, options: VideoOptions, ctx: StageContext
) -> Callable[[Pinhole, NDArray[np.float64]], Frames]:
    """What draws a frame of each output."""
    from pipelines.exports import shades

    between = None
    if "depth" in options.outputs:
        ctx.progress(0.0, "looking for the range of depths")
        between = shades.range_of_views(scene.probe_views(ctx.check_cancelled))

    def draw(lens: Pinhole, pose: NDArray[np.float64]) -> Frames:
        view, accumulation = scene.seen(lens, pose)
        pictures: dict[Output, Callable[[], NDArray[np.uint8]]] = {
            "rgb": lambda: view.rgb,
            "depth": lambda: shades.depth_picture(view.z_depth, between),
            "normals": lambda: shades.normals_picture(shades.normals_of(view)),
            "accumulation": lambda: shades.accumulation_picture(accumulation),
        }
        return {name: pictures[name]() for name in options.outputs}

    return draw


@contextlib.contextmanager
def _writer(
    options: VideoOptions, ctx: StageContext, lens: Pinhole, fps: float
) -> Iterator[Callable[[Frames], None]]:
    """What writes a frame of each output, into files that are whole when the block is left."""
    import numpy as np

    from pipelines.exports.formats.mp4 import VideoWriter
    from pipelines.exports.formats.png_frames import FramesWriter

    together = options.layout == "side_by_side"
    with contextlib.ExitStack() as stack:
        if options.codec == "png":
            frames = stack.enter_context(FramesWriter(ctx.out / "video-frames.zip"))

            def write_pictures(shown: Frames) -> None:
                if together:
                    shown = {"side_by_side": np.concatenate(list(shown.values()), axis=1)}
                for name, picture in shown.items():
                    frames.write(name, picture)

            yield write_pictures
            return
        names: tuple[str, ...] = ("rgb",) if together else options.outputs
        width = lens.width * (len(options.outputs) if together else 1)
        writers = {
            name: stack.enter_context(
                VideoWriter(
                    ctx.out / ("video.mp4" if name == "rgb" else f"video-{name}.mp4"),
                    *(width, lens.height, fps, options.crf, options.codec),
                )
            )
            for name in names
        }

        def write(shown: Frames) -> None:
            if together:
                shown = {"rgb": np.concatenate(list(shown.values()), axis=1)}
            for name, picture in shown.items():
                writers[name].write(picture)

        yield write


_PLAYER = "any browser or player"

EXPORT = Export(
    kind="video",
    version=3,
    run=run,
    options=VideoOptions,
    artifacts=(
        Artifact("video.mp4", "video.mp4", "video/mp4", _PLAYER),
        Artifact("video-depth.mp4", "video-depth.mp4", "video/mp4", _PLAYER, on_request=True),
        Artifact("video-normals.mp4", "video-normals.mp4", "video/mp4", _PLAYER, on_request=True),
        Artifact(
            "video-accumulation.mp4",
            "video-accumulation.mp4",
            "video/mp4",
            _PLAYER,
            on_request=True,
        ),
        Artifact(
            "video-frames.zip",
            "video-frames.zip",
            "application/zip",
            "unpacked: video editors",
            on_request=True,
        ),
        Artifact("preview.jpg", "preview.jpg", "image/jpeg", "any picture viewer"),
    ),
)
