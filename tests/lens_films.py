"""The analytic scene through lenses that the product's own tracer has not: fisheyes, panoramas.

Rays are the tracer's; which way a pixel looks is worked out here, by the lenses' own formulas and
apart from the product's, so that the two can disagree. Axes of directions: OpenCV's (+X right, +Y
down, +Z forward). Poses: world_from_camera [3, 4], OpenGL axes, as everywhere.
"""

from __future__ import annotations

import math
import subprocess
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.sample.film import hand_held_pose
from pipelines.sample.scene import SAMPLE, Floats, Scene, raycast
from pipelines.sample.takes import looking_at
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.tools.ffmpeg import ffmpeg_executable

FRAME_RATE = 10.0
Picture = NDArray[np.uint8]


def panorama_camera(width: int) -> Intrinsics:
    """A whole sphere, `width` x `width` / 2."""
    height = width // 2
    return Intrinsics(
        width, height, width / 2, float(height), width / 2, height / 2, "EQUIRECTANGULAR"
    )


def fisheye_camera(width: int, height: int, degrees: float = 150.0) -> Intrinsics:
    """A fisheye that sees `degrees` across its width, bent a little off the equidistant rule."""
    theta = math.radians(degrees) / 2
    k1, k2 = 0.03, -0.008
    focal = width / 2 / (theta * (1 + k1 * theta**2 + k2 * theta**4))
    return Intrinsics(
        width, height, focal, focal, width / 2, height / 2, "OPENCV_FISHEYE", k1=k1, k2=k2
    )


def directions(camera: Intrinsics, pixels: Floats) -> Floats:
    """Unit directions [N, 3] of pixels [N, 2], OpenCV axes."""
    x = (pixels[:, 0] - camera.cx) / camera.fl_x
    y = (pixels[:, 1] - camera.cy) / camera.fl_y
    if camera.model == "EQUIRECTANGULAR":
        longitude = (pixels[:, 0] / camera.width - 0.5) * 2 * np.pi
        latitude = (0.5 - pixels[:, 1] / camera.height) * np.pi
        level = np.cos(latitude)
        return np.stack(
            [np.sin(longitude) * level, -np.sin(latitude), np.cos(longitude) * level], axis=1
        )
    if camera.model == "OPENCV_FISHEYE":
        angles = np.linspace(0.0, np.pi, 20_001)
        bent = angles * (1 + camera.k1 * angles**2 + camera.k2 * angles**4)
        rising = np.argmax(np.diff(bent) <= 0) or len(bent)
        radius = np.hypot(x, y)
        theta = np.interp(radius, bent[:rising], angles[:rising])
        across = np.sin(theta) / np.maximum(radius, 1e-12)
        return np.stack([x * across, y * across, np.cos(theta)], axis=1)
    assert camera.model == "PINHOLE"
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    unit: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def picture_of(camera: Intrinsics, pose: Floats, scene: Scene = SAMPLE, side: int = 2) -> Picture:
    """What the camera sees, uint8 [H, W, 3]. side: samples along each side of a pixel."""
    total = np.zeros((camera.height * camera.width, 3))
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    shifts = (np.arange(side) + 0.5) / side
    for dx, dy in [(a, b) for a in shifts for b in shifts]:
        pixels = np.stack([x.ravel() + dx, y.ravel() + dy], axis=1)
        rays = (directions(camera, pixels) * [1.0, -1.0, -1.0]) @ pose[:, :3].T
        eyes = np.broadcast_to(pose[:, 3], rays.shape)
        total += raycast(eyes, rays, scene).color
    picture = np.clip(total / side**2 * 255.0 + 0.5, 0, 255).astype(np.uint8)
    return picture.reshape(camera.height, camera.width, 3)


def level_pose(progress: float) -> Floats:
    """The sample's walk with the camera upright, as one on a stick, turning as its bearer does."""
    eye = hand_held_pose(progress)[:, 3]
    turn = 0.6 * math.sin(2 * math.pi * progress) - 1.2
    tilt = 0.05 * math.sin(2 * math.pi * 1.7 * progress)
    return looking_at(eye, eye + np.array([math.cos(turn), math.sin(turn), tilt]), tilt)


def walked(
    camera: Intrinsics, num: int, pose: Callable[[float], Floats], files: Sequence[str] = ()
) -> CamerasFile:
    """The true cameras of `num` pictures along a walk, the first at 0 s."""
    images = tuple(
        PosedImage(
            file=files[index] if files else f"frame_{index:05d}",
            camera=0,
            world_from_camera=tuple(tuple(map(float, row)) for row in pose(index / (num - 1))),
            timestamp_s=index / FRAME_RATE,
        )
        for index in range(num)
    )
    return CamerasFile((camera,), images, metric=True, source="sample")


def pictures(truth: CamerasFile, side: int = 2, scene: Scene = SAMPLE) -> Iterator[Picture]:
    """All pictures of a walk in order; two are worked on at a time."""

    def one(image: PosedImage) -> Picture:
        pose = np.array(image.world_from_camera)
        return picture_of(truth.cameras[image.camera], pose, scene, side)

    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(one, truth.images)


def film(path: Path, truth: CamerasFile, side: int = 2, scene: Scene = SAMPLE) -> Path:
    """An H.264 film of a walk, upright, frame i being image i."""
    camera = truth.cameras[0]
    process = subprocess.Popen(
        [
            ffmpeg_executable(), "-nostdin", "-loglevel", "error", "-y",
            "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{camera.width}x{camera.height}",
            "-r", str(FRAME_RATE), "-i", "pipe:0",
            "-vf", "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd,format=yuv420p",
            "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709",
            "-c:v", "libx264", "-preset", "veryfast", "-crf", "17", str(path),
        ],
        stdin=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None
    for picture in pictures(truth, side, scene):
        process.stdin.write(picture.tobytes())
    process.stdin.close()
    assert process.wait() == 0
    return path
