"""Films an analytic scene as a phone would, and keeps the exact cameras.

The phone is held upright: its sensor lies sideways, so the pictures are stored in landscape with a
rotation flag, and players turn them by 90 degrees clockwise. Cameras refer to the **upright**
picture. World frame and units are those of `pipelines.sample.scene`; poses are world_from_camera,
OpenGL axes. The sample's take is filmed where none is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from os import cpu_count
from pathlib import Path
from subprocess import Popen
from typing import IO

import ffmpeg
import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ToolError
from pipelines.nerf.ahead import ahead
from pipelines.sample.scene import SAMPLE, Floats, pose_matrix, render
from pipelines.sample.takes import Take, looking_at, sway
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.tools.ffmpeg import ffmpeg_executable

FRAME_RATE = 30.0
NUM_FRAMES = 120
LONG_SIDE_PX = 960
ARC_DEG = 165.0
"""How far the camera walks around the subject."""

_FOCAL_RATIO = 0.72  # focal length over the long side: a phone's main camera, about 26 mm
_RADIUS_M = 1.75
_HEIGHT_M = 1.15
_TARGET = np.array([0.0, 0.1, 0.32])

Picture = NDArray[np.uint8]
OnFrame = Callable[[int, int], None]
"""Called with the number of finished frames and of all frames."""


def phone_camera(long_side_px: int = LONG_SIDE_PX) -> Intrinsics:
    """The phone's lens for an upright 9:16 picture; both sides are even, as H.264 wants them.

    Raises ValueError below 64 px or for an odd side.
    """
    if long_side_px < 64 or long_side_px % 2:
        raise ValueError(f"the long side must be even and at least 64 px, not {long_side_px}")
    width = 2 * round(long_side_px * 9 / 32)
    focal = _FOCAL_RATIO * long_side_px
    return Intrinsics(
        width=width,
        height=long_side_px,
        fl_x=focal,
        fl_y=focal,
        cx=width / 2,
        cy=long_side_px / 2,
    )


def hand_held_pose(progress: float) -> Floats:
    """world_from_camera [3, 4] at a point of the walk, progress in [0, 1].

    An arc of ARC_DEG around the subject with varying height and distance, looking at about the
    bowl; the hand's unsteadiness moves the camera by a few centimetres and turns it by a few
    degrees. It depends on progress alone, so that fewer frames film the same walk.
    """
    azimuth = math.radians(-90.0 - ARC_DEG / 2 + ARC_DEG * progress)
    radius = _RADIUS_M + 0.16 * math.sin(2 * math.pi * 1.5 * progress + 0.4)
    height = _HEIGHT_M + 0.26 * math.sin(2 * math.pi * 1.15 * progress - 0.9)
    eye = np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), height])
    time = progress * 4.0  # seconds of a walk at its usual pace
    eye += 0.012 * np.array([sway(time, s, 0.9, 0.53, 0.37) for s in (1.0, 2.0, 3.0)])
    target = _TARGET + np.array([0.06 * sway(time, s, 1.7, 0.83, 0.41) for s in (4.0, 5.0, 6.0)])
    roll = math.radians(2.5 * sway(time, 7.0, 1.9, 0.71))
    return looking_at(eye, target, roll)


SAMPLE_TAKE = Take(SAMPLE, hand_held_pose)


def walk(
    num_frames: int = NUM_FRAMES,
    camera: Intrinsics | None = None,
    frame_rate: float = FRAME_RATE,
    take: Take = SAMPLE_TAKE,
) -> CamerasFile:
    """The true cameras of a film of that many frames; image i is at i / frame_rate seconds.

    The notes hold the scene's name and size, the angle around the vertical axis through the origin
    that the camera covers, and each frame's exposure gain.
    Raises ValueError for fewer than 2 frames.
    """
    if num_frames < 2:
        raise ValueError(f"a walk needs at least 2 frames, not {num_frames}")
    images = tuple(
        PosedImage(
            file=f"frame_{index:05d}",
            camera=0,
            world_from_camera=tuple(
                tuple(map(float, row)) for row in take.pose(index / (num_frames - 1))
            ),
            timestamp_s=index / frame_rate,
        )
        for index in range(num_frames)
    )
    arc_deg = arc_degrees(np.array([pose_matrix(image)[:, 3] for image in images]))
    return CamerasFile(
        cameras=(camera or phone_camera(),),
        images=images,
        metric=True,
        source="sample",
        notes={
            "scene": take.scene.name,
            "scene_size_m": take.scene.subject.size,
            "frame_rate": frame_rate,
            "arc_deg": round(arc_deg, 2),
            "gains": [take.gain(index / (num_frames - 1)) for index in range(num_frames)],
        },
    )


def render_all(
    cameras: CamerasFile, num_threads: int | None = None, take: Take = SAMPLE_TAKE
) -> Iterator[Picture]:
    """The pictures of a walk in order, uint8 [H, W, 3], rendered on threads just ahead of use.

    cameras: of `walk` through that take. num_threads: one per processor where not given.
    """
    workers = num_threads or cpu_count() or 1

    def picture(shot: tuple[PosedImage, float]) -> Picture:
        image, gain = shot
        return render(cameras.cameras[image.camera], pose_matrix(image), take.scene, gain)

    return ahead(picture, zip(cameras.images, cameras.notes["gains"], strict=True), workers)


def film_capture(
    path: Path,
    num_frames: int = NUM_FRAMES,
    long_side_px: int = LONG_SIDE_PX,
    *,
    on_frame: OnFrame | None = None,
    num_threads: int | None = None,
    take: Take = SAMPLE_TAKE,
) -> CamerasFile:
    """Film a take into an H.264 MP4 as a phone writes it: sideways, with a rotation flag.

    path: the .mp4 to write. long_side_px: of the upright picture. Returns the true cameras; frame
    i of the file is image i. Raises ToolError where ffmpeg fails.
    """
    truth = walk(num_frames, phone_camera(long_side_px), take=take)
    options: dict[str, str | int] = {
        "c:v": "libx264",
        "preset": "veryfast",
        "crf": 18,
        "profile:v": "high",
        "g": int(FRAME_RATE),
        "vf": "scale=out_color_matrix=bt709:out_range=tv:flags=bicubic+accurate_rnd,"
        "format=yuv420p,"
        "setparams=range=tv:color_primaries=bt709:color_trc=bt709:colorspace=bt709",
    }
    encode_sideways(path, render_all(truth, num_threads, take), truth, options, on_frame)
    return truth


def encode_sideways(
    path: Path,
    pictures: Iterator[Picture],
    truth: CamerasFile,
    options: dict[str, str | int],
    on_frame: OnFrame | None = None,
) -> None:
    """Encode upright pictures as a phone stores them: turned by 90 degrees, with a rotation flag.

    options: ffmpeg's output options, the codec among them; rgb24 comes in. Raises ToolError where
    ffmpeg fails; no file is left then.
    """
    camera = truth.cameras[0]
    stream = ffmpeg.input(
        "pipe:",
        format="rawvideo",
        pix_fmt="rgb24",
        s=f"{camera.height}x{camera.width}",
        framerate=truth.notes["frame_rate"],
        # The flag is passed on instead of being applied: degrees anticlockwise.
        display_rotation=-90,
        noautorotate=None,
    )
    stream = ffmpeg.output(stream, str(path), movflags="+faststart", **options)
    stream = stream.global_args("-hide_banner", "-nostdin", "-loglevel", "error")
    process: Popen[bytes] = ffmpeg.run_async(
        stream, cmd=ffmpeg_executable(), pipe_stdin=True, pipe_stderr=True, overwrite_output=True
    )
    try:
        log = _feed(process, pictures, len(truth.images), on_frame)
    except BaseException:
        process.kill()
        process.wait()
        path.unlink(missing_ok=True)
        raise
    if process.returncode != 0:
        path.unlink(missing_ok=True)
        raise ToolError(
            f"ffmpeg could not encode {path.name}: it ended with code {process.returncode}.",
            hint="Check that the disk has room and that this ffmpeg can encode with "
            f"{options.get('c:v', 'the codec asked for')}.",
            details={"log": log[-2000:]},
        )


def _feed(
    process: Popen[bytes], pictures: Iterator[Picture], num_frames: int, on_frame: OnFrame | None
) -> str:
    """Write all pictures to ffmpeg, wait for its end and return what it logged."""
    pipe, errors = _open_pipe(process.stdin), _open_pipe(process.stderr)
    try:
        for index, picture in enumerate(pictures):
            pipe.write(np.ascontiguousarray(np.rot90(picture)).tobytes())
            if on_frame is not None:
                on_frame(index + 1, num_frames)
        pipe.close()
    except BrokenPipeError:
        pass  # ffmpeg has ended early: its exit code and its log say why
    log = errors.read().decode("utf-8", "replace")
    process.wait()
    return log


def _open_pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    if pipe is None:
        raise ValueError("the process was started without this pipe")
    return pipe


def arc_degrees(centers: Floats | Sequence[Sequence[float]]) -> float:
    """The angle around the subject's vertical axis that camera centres [N, 3] cover, degrees."""
    points = np.asarray(centers, dtype=np.float64)
    azimuth = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
    return float(np.degrees(azimuth.max() - azimuth.min()))
