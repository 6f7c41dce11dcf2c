"""Keypoints of a model refined by its pictures: cameras and walls are known exactly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from pipelines.sample.align import similarity
from pipelines.scene.orientation import opengl_from_opencv
from pipelines.sfm import subpixel
from pipelines.sfm.subpixel import Refinement, droppable, read_grey, refine_keypoints, tiles
from pipelines.tools.colmap_tracks import StoredTracks
from tests.unit.pipelines.sfm.synthetic_model import call_at_once
from tests.unit.pipelines.sfm.synthetic_room import FOCAL, HEIGHT, WIDTH, arc_poses, render

NUM, NOISE_PX = 8, 0.5
Scene = tuple[Path, dict[int, Path], tuple[int, int]]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A model of points on the walls, seen half a pixel off; its pictures; and an observation
    (image, feature) that was put somewhere else altogether."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
    root = tmp_path_factory.mktemp("scene")
    random = np.random.default_rng(0)
    points = random.uniform(0.1, 1.3, (500, 3))
    points[np.arange(500), random.integers(0, 3, 500)] = 0.0
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1,
            model="SIMPLE_PINHOLE",
            width=WIDTH,
            height=HEIGHT,
            params=[FOCAL, WIDTH / 2, HEIGHT / 2],
        )
    )
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    pictures, wrong = {}, (0, 0)
    for number, pose in enumerate(arc_poses(NUM), 1):
        pictures[number] = root / f"{number - 1:06d}.png"
        render(pose).save(pictures[number])
        rotation = (pose[:, :3] * (1.0, -1.0, -1.0)).T
        local = (points - pose[:, 3]) @ rotation.T
        pixels = FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        pixels += random.normal(0.0, NOISE_PX, pixels.shape)
        seen = np.flatnonzero(((pixels > 12) & (pixels < (WIDTH - 12, HEIGHT - 12))).all(axis=1))
        for feature, point in enumerate(seen):
            tracks[point].append((number, feature))
        if number == 2:
            wrong = (number, 5)
            pixels[seen[5]] += (9.0, -7.0)
        image = pycolmap.Image(
            name=pictures[number].name, keypoints=pixels[seen], camera_id=1, image_id=number
        )
        world = np.column_stack([rotation, -rotation @ pose[:, 3]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world))
    for point, elements in zip(points, tracks, strict=True):
        if len(elements) > 2:
            track = pycolmap.Track()
            for image_id, feature in elements:
                track.add_element(image_id, feature)
            model.add_point3D(point + random.normal(0.0, 0.002, 3), track)
    folder = root / "model"
    folder.mkdir()
    model.write(folder)
    return folder, pictures, wrong


def opened(scene: Scene) -> StoredTracks:
    return StoredTracks(scene[0], num_threads=1, run=call_at_once)


def refined(
    tracks: StoredTracks, pictures: dict[int, Path], report: Callable[[float], None]
) -> Refinement | None:
    return refine_keypoints(
        tracks,
        pictures,
        report,
        long_side_px=WIDTH,
        num_threads=1,
        refine_principal_point=False,
    )


def errors(model: Any) -> tuple[float, float]:
    """Mean error of the centres, and median distance of points from the walls."""
    ids = sorted(model.reg_image_ids())
    found = opengl_from_opencv(
        np.stack([model.image(i).cam_from_world().inverse().matrix() for i in ids])
    )
    truth = arc_poses(NUM)
    move = similarity(found[:, :, 3], truth[:, :, 3])
    centers = np.linalg.norm(move.apply_to_points(found[:, :, 3]) - truth[:, :, 3], axis=1)
    points = move.apply_to_points(np.array([p.xyz for p in model.points3D.values()]))
    return float(centers.mean()), float(np.median(np.abs(points).min(axis=1)))


def test_poses_and_points_come_nearer_to_the_truth(scene: Scene, tmp_path: Path) -> None:
    folder, pictures, wrong = scene
    plain, tracks = opened(scene), opened(scene)
    plain.adjust(subpixel._ENDS, refine_principal_point=False)
    plain.write(tmp_path / "plain")
    told: list[float] = []
    found = refined(tracks, pictures, told.append)
    assert found is not None
    written = tracks.write(tmp_path / "refined")
    before, after = (
        errors(pycolmap.Reconstruction(tmp_path / name)) for name in ("plain", "refined")
    )
    assert after[0] < 0.6 * before[0]
    assert after[1] < 0.6 * before[1]
    assert found.num_moved > 0.8 * found.num_observations
    assert 0.3 < found.median_move_px < 1.5
    assert found.error_after_px < 0.5 * found.error_before_px
    assert written.error_px == pytest.approx(found.error_after_px, abs=1e-6)
    assert (told, told[-1]) == (sorted(told), 1.0)
    image = pycolmap.Reconstruction(tmp_path / "refined").image(wrong[0])
    assert not image.points2D[wrong[1]].has_point3D()
    assert pycolmap.Reconstruction(folder).image(wrong[0]).points2D[wrong[1]].has_point3D()


def test_an_observation_that_fits_nothing_is_left_out_of_an_adjusted_model(
    scene: Scene, tmp_path: Path
) -> None:
    tracks, wrong = opened(scene), scene[2]
    before = tracks.error_px
    tracks.adjust(subpixel._ENDS_AS_MAPPED, refine_principal_point=False)
    assert tracks.write(tmp_path / "adjusted").error_px == tracks.error_px < before
    model = pycolmap.Reconstruction(tmp_path / "adjusted")
    assert not model.image(wrong[0]).points2D[wrong[1]].has_point3D()
    assert model.compute_num_observations() > 0.98 * (
        pycolmap.Reconstruction(scene[0]).compute_num_observations()
    )


def test_memory_for_few_pictures_gives_the_same(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, pictures, _ = scene
    tracks = opened(scene)
    pairs, sizes = tracks.pairs(), tracks.sizes

    def find() -> Any:
        return subpixel.find_again(
            pairs, pictures, sizes, lambda _share: None, long_side_px=WIDTH, num_threads=1
        )

    whole = find()
    read: list[Path] = []

    def counted(path: Path, size: tuple[int, int]) -> np.ndarray:
        read.append(path)
        return read_grey(path, size)

    monkeypatch.setattr(subpixel, "read_grey", counted)
    monkeypatch.setattr(subpixel, "MEMORY_BYTES", 4 * WIDTH * HEIGHT)
    few = find()
    np.testing.assert_array_equal(few[0], whole[0])
    np.testing.assert_array_equal(few[1], whole[1])
    assert NUM <= len(read) <= 3 * NUM
    assert subpixel.Shelf(pictures, sizes)._arena.grey.nbytes == 4 * WIDTH * HEIGHT


def test_at_half_the_size_places_are_still_of_the_full_picture(scene: Scene) -> None:
    _, pictures, _ = scene
    tracks = opened(scene)
    pairs = tracks.pairs()
    full, half = (
        subpixel.find_again(
            pairs, pictures, tracks.sizes, lambda _: None, long_side_px=side, num_threads=1
        )
        for side in (WIDTH, WIDTH // 2)
    )
    both = (full[1] > 0.9) & (half[1] > 0.9)
    assert both.sum() > 0.4 * len(both)
    gaps = np.linalg.norm(full[0][both] - half[0][both], axis=1)
    assert np.median(gaps) < 0.25


def test_pictures_without_texture_leave_the_model_as_it_is(scene: Scene, tmp_path: Path) -> None:
    _, pictures, _ = scene
    flat = {}
    for image_id in pictures:
        flat[image_id] = tmp_path / f"{image_id}.png"
        Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(flat[image_id])
    tracks = opened(scene)
    before = tracks.write(tmp_path / "before")
    assert refined(tracks, flat, lambda _share: None) is None
    after = tracks.write(tmp_path / "after")
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.world_from_camera, before.world_from_camera)


def test_an_image_in_which_little_is_found_keeps_its_observations() -> None:
    images = np.array([1, 1, 1, 1, 2, 2, 2, 2])
    good = np.array([True, True, True, False, False, False, False, True])
    assert droppable(images, good).tolist() == [False] * 3 + [True] + [False] * 4


def test_tiles_hold_every_row_once_and_no_more_images_than_two_blocks() -> None:
    image_ids = np.random.default_rng(0).integers(0, 50, (400, 2)) * 3
    rows = list(tiles(image_ids, 7))
    assert sorted(np.concatenate(rows).tolist()) == list(range(400))
    assert max(len(np.unique(image_ids[row])) for row in rows) <= 14
    assert all((np.diff(row) > 0).all() for row in rows)
