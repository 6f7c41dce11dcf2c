"""Captures of the analytic scenes whose poses are known exactly: films, photos, lenses, apps.

A case is written once into a folder, its true cameras beside it. Films and photos are of every
scene; fisheyes and panoramas of those with something all round; apps' exports with given poses that
drift as apps' do, so that the true ones have to be found.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.sample.align import path_extent, similarity
from pipelines.sample.film import (
    NUM_FRAMES,
    SAMPLE_TAKE,
    film_capture,
    hand_held_pose,
    phone_camera,
    render_all,
    walk,
)
from pipelines.sample.scene import pose_matrix
from pipelines.sample.scenes import object as object_on_stand
from pipelines.sample.scenes import room
from pipelines.sample.takes import Take
from pipelines.scene.cameras_file import CamerasFile
from tests import app_writers, capture_writers
from tests.benchmarks.scene_capture import encoded
from tests.lens_films import film, fisheye_camera, level_pose, panorama_camera, walked
from tests.unit.pipelines.tools.clips import spherical

Floats = NDArray[np.float64]

NUM_PHOTOS = 40
LONG_SIDE_PX = 960
NUM_APP_FRAMES = 40
APP_PX = 640
DRIFT, DRIFT_DEG = 0.01, 0.5
"""By how much given poses are off, at most: a share of the path's extent, and degrees."""


@dataclass(frozen=True)
class Case:
    """A capture to be written. suffix: of its file. metric: whether its poses come with a scale.
    is_plain: whether keypoints of its found poses can be refined: no panorama, no given poses.

    write: into that file; returns the true cameras, paired with those found by time where
    `by_time`, else by the picture's name in the archive.
    """

    name: str
    suffix: str
    write: Callable[[Path], CamerasFile]
    by_time: bool = True
    metric: bool = False
    is_plain: bool = True


def drifted(truth: CamerasFile) -> CamerasFile:
    """The same cameras as an app would have them: off by a little, smoothly along the way, but at
    the scale of the true ones as a whole, since nothing in pictures tells a wrong one."""
    return _off(truth, keeps_scale=True)


def shrunk(truth: CamerasFile) -> CamerasFile:
    """The same drift as it comes: it makes this path smaller by more than 1 %."""
    return _off(truth, keeps_scale=False)


def _off(truth: CamerasFile, *, keeps_scale: bool) -> CamerasFile:
    true = np.array([pose_matrix(image) for image in truth.images])
    poses = true.copy()
    along = np.linspace(0.0, 2 * np.pi, len(poses))
    waves = np.stack([np.sin(along), np.cos(1.3 * along + 1.0), np.sin(0.7 * along + 2.0)], 1)
    turns = Rotation.from_rotvec(np.radians(DRIFT_DEG) * waves[:, ::-1]).as_matrix()
    poses[:, :, :3] = turns @ poses[:, :, :3]
    poses[:, :, 3] += DRIFT * path_extent(poses[:, :, 3]) * waves
    middle = poses[:, :, 3].mean(axis=0)
    scale = similarity(poses[:, :, 3], true[:, :, 3]).scale if keeps_scale else 1.0
    poses[:, :, 3] = middle + scale * (poses[:, :, 3] - middle)
    images = tuple(
        replace(image, world_from_camera=tuple(tuple(map(float, row)) for row in pose))
        for image, pose in zip(truth.images, poses, strict=True)
    )
    return replace(truth, images=images)


def _filmed(take: Take) -> Callable[[Path], CamerasFile]:
    def write(path: Path) -> CamerasFile:
        return film_capture(path, NUM_FRAMES, LONG_SIDE_PX, take=take)

    return write


def _photographed(take: Take) -> Callable[[Path], CamerasFile]:
    def write(path: Path) -> CamerasFile:
        truth = walk(NUM_PHOTOS, phone_camera(LONG_SIDE_PX), take=take)
        names = {index: f"IMG_{2041 + index}.JPG" for index in range(NUM_PHOTOS)}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for index, picture in enumerate(render_all(truth, take=take)):
                archive.writestr(names[index], encoded(picture, "JPEG"))
        return capture_writers.named(truth, names)

    return write


def _fisheye(path: Path) -> CamerasFile:
    truth = walked(fisheye_camera(800, 600, 150.0), NUM_APP_FRAMES, hand_held_pose)
    film(path, truth, side=1)
    return truth


def _panorama(path: Path) -> CamerasFile:
    truth = walked(panorama_camera(960), 24, level_pose)
    spherical(film(path, truth, side=1))
    return truth


def _room_panorama(path: Path) -> CamerasFile:
    truth = walked(panorama_camera(960), 24, room.pose)
    spherical(film(path, truth, side=1, scene=room.SCENE))
    return truth


def _polycam(path: Path) -> CamerasFile:
    return capture_writers.write_polycam(
        path, NUM_APP_FRAMES, APP_PX, corrected=False, given=drifted
    )


def _polycam_shrunk(path: Path) -> CamerasFile:
    return capture_writers.write_polycam(
        path, NUM_APP_FRAMES, APP_PX, corrected=False, given=shrunk
    )


def _record3d(path: Path) -> CamerasFile:
    return capture_writers.write_record3d(path, NUM_APP_FRAMES, APP_PX, depth=True, given=drifted)


def _scanner_app(path: Path) -> CamerasFile:
    return app_writers.write_scanner_app(path, NUM_APP_FRAMES, APP_PX, given=drifted)


_CASES = (
    Case("sample", ".mp4", _filmed(SAMPLE_TAKE)),
    Case("room", ".mp4", _filmed(room.TAKE)),
    Case("object", ".mp4", _filmed(object_on_stand.TAKE)),
    Case("sample-photos", ".zip", _photographed(SAMPLE_TAKE), by_time=False),
    Case("room-photos", ".zip", _photographed(room.TAKE), by_time=False),
    Case("object-photos", ".zip", _photographed(object_on_stand.TAKE), by_time=False),
    Case("sample-fisheye", ".mp4", _fisheye),
    Case("sample-360", ".mp4", _panorama, is_plain=False),
    Case("room-360", ".mp4", _room_panorama, is_plain=False),
    Case("polycam", ".zip", _polycam, by_time=False, metric=True, is_plain=False),
    Case("polycam-shrunk", ".zip", _polycam_shrunk, by_time=False, metric=True, is_plain=False),
    Case("record3d", ".zip", _record3d, by_time=False, metric=True, is_plain=False),
    Case("scanner-app", ".zip", _scanner_app, by_time=False, metric=True, is_plain=False),
)
CASES: dict[str, Case] = {case.name: case for case in _CASES}


def written(case: Case, folder: Path) -> tuple[Path, CamerasFile]:
    """The capture's file in `folder` and its true cameras, made unless they are there."""
    path = folder / f"{case.name}{case.suffix}"
    known = folder / f"{case.name}.json"
    if not (path.is_file() and known.is_file()):
        folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f"partial-{path.name}")
        case.write(partial).save(known)
        partial.replace(path)
    return path, CamerasFile.load(known)
