"""The video stage: a smooth flight through the captured poses, as H.264 for any browser.

Reads `train/model.zip`. Writes `video.mp4` and `preview.jpg`, a telling moment of the flight at up
to twice the video's size.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.camera_path import capture_order, nearest_pose_distance, smooth_path
from pipelines.cameras_file import Intrinsics, PosedImage
from pipelines.depth_views import Pinhole
from pipelines.options import VideoOptions, render_config
from pipelines.scene_bounds import camera_focus
from pipelines.stage import StageContext
from pipelines.trained_scene import TrainedScene
from pipelines.video_writer import VideoWriter

_PREVIEW_ENLARGEMENT = 2
_PREVIEW_QUALITY = 93


def run(options: VideoOptions, ctx: StageContext) -> dict[str, Any]:
    """Render the flight. Raises ToolError where ffmpeg fails."""
    scene = TrainedScene.load(ctx.workspace.stage("train") / "model.zip", render_config(options))
    images = scene.cameras.images
    lens = typical_lens([scene.lens_of(image) for image in images])
    video_lens = Pinhole.of(lens, options.long_side_px, multiple=2)
    path = camera_path(images, options.num_frames)
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


def camera_path(images: Sequence[PosedImage], num_frames: int) -> NDArray[np.float64]:
    """[num_frames, 3, 4] world poses along the captured ones, in the order of the walk."""
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    order = capture_order(
        poses, [image.file for image in images], [image.timestamp_s for image in images]
    )
    return smooth_path(poses[order], num_frames, camera_focus(poses))


def preview_index(path: NDArray[np.float64], images: Sequence[PosedImage]) -> int:
    """A telling moment of the path for the picture that stands for the job.

    Of the middle two thirds, the half that is nearest to captured poses; of these the one that
    has what the cameras look at most in its middle, or where there is no such point, the nearest.
    """
    first, last = len(path) // 6, len(path) - len(path) // 6
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    candidates = path[first:last]
    distance = nearest_pose_distance(candidates, poses)
    focus = camera_focus(poses)
    if focus is None:
        return first + int(np.argmin(distance))
    to_focus = focus - candidates[:, :, 3]
    centred = -(candidates[:, :, 2] * to_focus).sum(axis=1) / np.linalg.norm(to_focus, axis=1)
    return first + int(np.argmax(np.where(distance <= np.median(distance), centred, -np.inf)))


def typical_lens(lenses: Sequence[Intrinsics]) -> Intrinsics:
    """The most common size, with the median focal length among its lenses, centred."""
    sizes = [(lens.width, lens.height) for lens in lenses]
    width, height = max(sizes, key=sizes.count)
    same = [lens for lens in lenses if (lens.width, lens.height) == (width, height)]
    return replace(
        same[0],
        fl_x=float(np.median([lens.fl_x for lens in same])),
        fl_y=float(np.median([lens.fl_y for lens in same])),
        cx=width / 2.0,
        cy=height / 2.0,
    )
