"""The flight of the video: its way, its lens, its preview."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipelines.exports.paths.catalogue import make_path
from pipelines.exports.paths.flight import preview_index, typical_lens
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.trained_scene import TrainedScene
from pipelines.workspace import Workspace
from tests.unit.pipelines.scene.synthetic_views import look_at, ring


def test_the_path_follows_the_walk(trained_job: Workspace) -> None:
    images = TrainedScene.load(trained_job.stage("train") / "model.zip").cameras.images
    path = make_path("smooth", tuple(reversed(images)), 24)
    first = np.asarray(images[0].world_from_camera)[:, 3]
    last = np.asarray(images[-1].world_from_camera)[:, 3]
    extent = np.linalg.norm(last - first)
    assert np.linalg.norm(path[0][:, 3] - first) < 0.1 * extent
    assert np.linalg.norm(path[-1][:, 3] - last) < 0.1 * extent


def test_the_preview_looks_at_the_subject_from_where_someone_stood() -> None:
    poses = ring(30, np.zeros(3))[::3]
    images = [
        PosedImage(f"{index}.jpg", 0, tuple(tuple(map(float, row)) for row in pose))
        for index, pose in enumerate(poses)
    ]
    path = np.repeat(poses, 2, axis=0)
    aside = look_at(path[9, :, 3], np.array([1.5, 0.0, 0.0]))
    path[:] = aside
    path[9] = poses[4]
    assert preview_index(path, images) == 9


def test_the_typical_lens_is_centred_and_of_the_most_common_size() -> None:
    wide = Intrinsics(640, 480, 500.0, 500.0, 310.0, 250.0)
    longer = dataclasses.replace(wide, fl_x=520.0)
    other = Intrinsics(480, 640, 900.0, 900.0, 240.0, 320.0)
    lens = typical_lens([other, wide, longer])
    assert (lens.width, lens.height, lens.cx, lens.cy) == (640, 480, 320.0, 240.0)
    assert lens.fl_x == 510.0
