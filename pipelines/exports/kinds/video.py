"""The video: a flight along a path of the catalogue, as H.264 for any browser.

`preview.jpg` is a telling moment of the flight at up to twice the video's size.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipelines.exports.export import Export
from pipelines.exports.options import RenderingOptions
from pipelines.exports.paths.catalogue import PATHS, make_path
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.trained_scene import TrainedScene

_PREVIEW_ENLARGEMENT = 2
_PREVIEW_QUALITY = 93


class VideoOptions(RenderingOptions):
    """The video along a camera path."""

    path: Literal[tuple(PATHS)] = Field(  # type: ignore[valid-type]
        "smooth",
        description="The way of the camera: smooth follows the captured one, orbit circles what "
        "the cameras look at.",
    )
    num_frames: int = Field(240, ge=8, le=20_000, description="Frames rendered.")
    fps: float = Field(24.0, ge=1, le=120, description="Frames per second.")
    long_side_px: int = Field(
        1280, ge=64, le=8192, description="Long side of the video, in pixels."
    )
    crf: int = Field(18, ge=0, le=40, description="x264 quality; lower is better and larger.")


def run(scene: TrainedScene, options: VideoOptions, ctx: StageContext) -> dict[str, Any]:
    """Render the flight. Raises ToolError where ffmpeg fails, ExportError as the path does."""
    # Imported where it runs: the API reads this file too.
    from PIL import Image

    from pipelines.exports.formats.mp4 import VideoWriter
    from pipelines.exports.paths.flight import preview_index, typical_lens
    from pipelines.scene.depth_views import Pinhole

    images = scene.cameras.images
    lens = typical_lens([scene.lens_of(image) for image in images])
    video_lens = Pinhole.of(lens, options.long_side_px, multiple=2)
    path = make_path(options.path, images, options.num_frames)
    started = time.monotonic()
    with VideoWriter(
        ctx.out / "video.mp4", video_lens.width, video_lens.height, options.fps, options.crf
    ) as writer:
        for index, pose in enumerate(path):
            writer.write(scene.picture(video_lens, pose))
            done = index + 1
            eta = (time.monotonic() - started) / done * (len(path) - done)
            ctx.progress(done / (len(path) + 4), f"frame {done}/{len(path)}", eta)
    ctx.progress(len(path) / (len(path) + 4), "preview picture")
    long_side = min(
        _PREVIEW_ENLARGEMENT * options.long_side_px,
        max(lens.width, lens.height, options.long_side_px),
    )
    picture = scene.picture(Pinhole.of(lens, long_side), path[preview_index(path, images)])
    Image.fromarray(picture).save(ctx.out / "preview.jpg", quality=_PREVIEW_QUALITY)
    return {
        "num_frames": len(path),
        "width": video_lens.width,
        "height": video_lens.height,
        "fps": options.fps,
        "duration_s": round(len(path) / options.fps, 3),
        "bytes": (ctx.out / "video.mp4").stat().st_size,
    }


EXPORT = Export(
    kind="video",
    version=2,
    run=run,
    options=VideoOptions,
    artifacts=(
        Artifact("video.mp4", "video.mp4", "video/mp4", "any browser or player"),
        Artifact("preview.jpg", "preview.jpg", "image/jpeg", "any picture viewer"),
    ),
)
