"""Small pictures of a textured room corner from known cameras, for structure from motion."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
from numba import njit
from PIL import Image

WIDTH, HEIGHT, FOCAL = 400, 300, 380.0
_TEXTURE_PER_UNIT = 120.0


def blobs(seed: int) -> np.ndarray:
    """[512, 512, 3] in [0, 255]: blobs of many sizes, which SIFT likes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((512, 512, 3))
    for cells, weight in ((16, 0.5), (40, 1.0), (96, 1.0), (200, 0.6)):
        noise = Image.fromarray(rng.integers(0, 256, (cells, cells, 3)).astype(np.uint8))
        total += weight * np.asarray(noise.resize((512, 512), Image.Resampling.BICUBIC), float)
    low, high = np.percentile(total, [1, 99])
    return np.clip((total - low) / (high - low) * 255, 0, 255)


_TEXTURES = np.stack([blobs(seed) for seed in range(3)])


def pose_looking_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """world_from_camera [3, 4], OpenGL axes, level."""
    z = (center - target) / np.linalg.norm(center - target)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z, center], axis=1)


def rays_of(pose: np.ndarray) -> np.ndarray:
    """[H, W, 3], world axes, through the pixels' centres."""
    rays: np.ndarray = _local_rays() @ pose[:, :3].T
    return rays


@functools.cache
def _local_rays() -> np.ndarray:
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([(u - WIDTH / 2) / FOCAL, -(v - HEIGHT / 2) / FOCAL, -np.ones_like(u)], axis=-1)


def render(pose: np.ndarray) -> Image.Image:
    """The walls x = 0 and y = 0 and the floor z = 0, seen from within x, y, z > 0."""
    picture = np.empty((HEIGHT, WIDTH, 3))
    center = np.ascontiguousarray(pose[:, 3])
    _paint_walls(rays_of(pose).reshape(-1, 3), center, _TEXTURES, picture.reshape(-1, 3))
    return Image.fromarray(picture.round().astype(np.uint8))


def picked(texture: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The texture, repeated by mirroring, at fractional positions."""
    colors = np.empty((len(a), 3))
    # One layout, so one compiled function: processes that save two at once could mix them up.
    _pick(texture, np.ascontiguousarray(a), np.ascontiguousarray(b), colors)
    return colors


@njit(cache=True, error_model="numpy")
def _paint_walls(
    rays: np.ndarray, center: np.ndarray, textures: np.ndarray, colors: np.ndarray
) -> None:
    for n in range(len(rays)):
        wall, nearest = 0, np.inf
        for axis in range(3):
            if rays[n, axis] < 0 and -center[axis] / rays[n, axis] < nearest:
                wall, nearest = axis, -center[axis] / rays[n, axis]
        hit = (center + rays[n] * nearest) * _TEXTURE_PER_UNIT
        a, b = hit[1 if wall == 0 else 0], hit[1 if wall == 2 else 2]
        _pick_one(textures[wall], a, b, colors[n])


@njit(cache=True, error_model="numpy")
def _pick(texture: np.ndarray, a: np.ndarray, b: np.ndarray, colors: np.ndarray) -> None:
    for n in range(len(a)):
        _pick_one(texture, a[n], b[n], colors[n])


@njit(cache=True, error_model="numpy")
def _pick_one(texture: np.ndarray, a: float, b: float, color: np.ndarray) -> None:
    size = len(texture) - 1
    a, b = size - abs(a % (2 * size) - size), size - abs(b % (2 * size) - size)
    i, j = min(int(a), size - 1), min(int(b), size - 1)
    s, t = a - i, b - j
    for c in range(3):
        top = texture[i, j, c] * (1 - t) + texture[i, j + 1, c] * t
        bottom = texture[i + 1, j, c] * (1 - t) + texture[i + 1, j + 1, c] * t
        color[c] = top * (1 - s) + bottom * s


def arc_poses(num: int) -> np.ndarray:
    """[num, 3, 4]: an arc that looks down into the corner."""
    target = np.array([0.6, 0.6, 0.5])
    angles = np.radians(np.linspace(20, 70, num))
    centers = np.stack(
        [2.6 * np.cos(angles), 2.6 * np.sin(angles), 1.6 + 0.3 * np.cos(3 * angles)], axis=1
    )
    return np.stack([pose_looking_at(center, target) for center in centers])


def turning_poses(num: int) -> np.ndarray:
    """[num, 3, 4]: one place, turning on the spot."""
    center = np.array([2.2, 2.2, 1.4])
    angles = np.radians(np.linspace(200, 250, num))
    return np.stack(
        [pose_looking_at(center, center + np.array([np.cos(a), np.sin(a), -0.25])) for a in angles]
    )


def downward_poses(num: int) -> np.ndarray:
    """[num, 3, 4]: side by side in the corner, straight down, none turned against another."""
    down = np.stack([np.eye(3)] * num)
    x, y = 0.5 + 0.25 * (np.arange(num) % 3), 0.5 + 0.25 * (np.arange(num) // 3)
    return np.concatenate([down, np.stack([x, y, np.full(num, 1.6)], axis=1)[:, :, None]], axis=2)


def save_photos(
    root: Path, pictures: list[Image.Image], exif: dict[str, object] | None = None
) -> None:
    """A job's folder as the ingest stage leaves it. exif: what each photo's says."""
    folder = root / "ingest" / "images"
    folder.mkdir(parents=True)
    files = [f"images/{index:02d}.jpg" for index in range(len(pictures))]
    for picture, file in zip(pictures, files, strict=True):
        picture.save(root / "ingest" / file, quality=95)
    images = [{"file": file, "exif": exif or {}} for file in files]
    (root / "ingest" / "capture.json").write_text(json.dumps({"images": images}), "utf-8")


def save_video_frames(root: Path, pictures: list[Image.Image]) -> None:
    """A job's folder as the frames stage leaves it, half a second between frames."""
    folder = root / "frames" / "images"
    folder.mkdir(parents=True)
    frames = []
    for index, picture in enumerate(pictures):
        name = f"frame_{index + 1:05d}.jpg"
        picture.save(folder / name, quality=95)
        frames.append({"file": f"images/{name}", "timestamp_s": 0.5 * index})
    (root / "frames" / "frames.json").write_text(json.dumps({"frames": frames}), "utf-8")
    (root / "frames" / "manifest.json").write_text("{}", "utf-8")
