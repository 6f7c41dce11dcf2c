"""What COLMAP is asked for: threads within memory, and features counted without a trace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import read_statistics
from pipelines.tools.colmap_settings import CameraGroup, FeatureSettings, extraction_threads
from tests.unit.pipelines.sfm.synthetic_room import arc_poses, render

COARSE = FeatureSettings(400, 1500, upsample=False, num_threads=1)
FINE = FeatureSettings(400, 1500, upsample=True, num_threads=1)


def three_pictures(folder: Path) -> list[Path]:
    paths = [folder / f"{i}.jpg" for i in range(3)]
    for path, pose in zip(paths, arc_poses(3), strict=True):
        render(pose).save(path, quality=95)
    return paths


def nothing(_done: int) -> None:
    return


def test_threads_shrink_until_their_images_fit_into_memory() -> None:
    wide = FeatureSettings(1600, 8192, upsample=True)
    # 3,200 x 2,400 pixels at 85 bytes are 653 MB a thread.
    assert extraction_threads(wide, 4000, 16) == 6
    assert extraction_threads(wide, 100, 16) == 1
    assert extraction_threads(wide, 100_000, 16) == 16


def test_without_doubling_four_times_as_many_threads_fit() -> None:
    assert extraction_threads(FeatureSettings(1600, 8192, upsample=False), 4000, 99) == 24


def test_no_more_threads_than_were_asked_for() -> None:
    small = FeatureSettings(320, 500, upsample=False, num_threads=3)
    assert extraction_threads(small, 4000, 16) == 3


def test_counting_features_leaves_the_database_alone(tmp_path: Path) -> None:
    reconstructor = Reconstructor(tmp_path / "colmap.db", three_pictures(tmp_path), tmp_path / "s")
    counted = reconstructor.count_features([0, 2], COARSE)
    assert not (tmp_path / "colmap.db").exists()
    reconstructor.extract((CameraGroup((0, 1, 2), "SIMPLE_RADIAL"),), COARSE, nothing)
    found = read_statistics(tmp_path / "colmap.db", 3).num_features
    assert counted == [found[0], found[2]]
    assert min(counted) > 50


def test_no_features_are_found_where_masks_are_black(tmp_path: Path) -> None:
    paths = three_pictures(tmp_path)
    with Image.open(paths[0]) as opened:
        width, height = opened.size
    mask = Image.new("L", (width, height), 255)
    mask.paste(0, (0, 0, width // 2, height))
    mask.save(tmp_path / "mask.png")
    reconstructor = Reconstructor(
        tmp_path / "colmap.db", paths, tmp_path / "s", masks={1: tmp_path / "mask.png"}
    )
    reconstructor.extract((CameraGroup((0, 1, 2), "SIMPLE_RADIAL"),), COARSE, nothing)
    with pycolmap.Database.open(tmp_path / "colmap.db") as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        x = [database.read_keypoints(image.image_id)[:, 0] for image in images]
    assert (x[1] >= width // 2 - 1).all()
    assert len(x[1]) > 20
    assert (x[0] < width // 2 - 1).any()
    assert (x[2] < width // 2 - 1).any()


def test_doubling_finds_more_features(tmp_path: Path) -> None:
    reconstructor = Reconstructor(tmp_path / "colmap.db", three_pictures(tmp_path), tmp_path / "s")
    coarse = reconstructor.count_features([0, 1, 2], COARSE)
    fine = reconstructor.count_features([0, 1, 2], FINE)
    assert (np.array(fine) > np.array(coarse)).all()


def test_features_are_read_evenly_and_no_more_than_wanted(tmp_path: Path) -> None:
    reconstructor = Reconstructor(tmp_path / "colmap.db", three_pictures(tmp_path), tmp_path / "s")
    reconstructor.extract((CameraGroup((0, 1, 2), "SIMPLE_RADIAL"),), COARSE, nothing)
    whole, some = reconstructor.features(100_000), reconstructor.features(20)
    counts = reconstructor.statistics().num_features
    assert [len(part) for part in whole] == counts.tolist()
    assert [part.shape for part in some] == [(20, 128)] * 3
    np.testing.assert_array_equal(some[1][0], whole[1][0])
    np.testing.assert_array_equal(some[1][-1], whole[1][-1])


def test_images_are_numbered_in_their_order(tmp_path: Path) -> None:
    """Not in that in which threads are done with them: the first ones here take longest."""
    paths = [tmp_path / f"{i}.png" for i in range(6)]
    for i, (path, pose) in enumerate(zip(paths, arc_poses(6), strict=True)):
        picture = render(pose)
        if i % 3:
            Image.new("RGB", picture.size, "gray").save(path)
        else:
            picture.save(path)
    reconstructor = Reconstructor(tmp_path / "colmap.db", paths, tmp_path / "s", num_threads=4)
    fine = replace(FINE, num_threads=4)
    reconstructor.extract((CameraGroup(tuple(range(6)), "SIMPLE_RADIAL"),), fine, nothing)
    with pycolmap.Database.open(tmp_path / "colmap.db") as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
    assert [image.name for image in images] == reconstructor.names
    counts = reconstructor.statistics().num_features
    assert (counts[::3] > 100).all()
    assert not counts[1::3].any()


def test_pairs_are_in_the_images_order_whatever_ids_colmap_gave_them(tmp_path: Path) -> None:
    """COLMAP numbers images as their features are found, by several threads."""
    found = {}
    for name, order in (("ordered", (0, 1, 2)), ("turned", (2, 1, 0))):
        (tmp_path / name).mkdir()
        reconstructor = Reconstructor(
            tmp_path / f"{name}.db", three_pictures(tmp_path / name), tmp_path / name / "scratch"
        )
        for index in order:
            reconstructor.extract((CameraGroup((index,), "SIMPLE_RADIAL"),), COARSE, nothing)
        with pycolmap.Database.open(tmp_path / f"{name}.db") as opened:
            first = opened.read_image_with_name(reconstructor.names[0])
            assert first is not None
            assert (first.image_id == 1) == (name == "ordered")
        pairs = [(0, 1), (1, 2)]
        reconstructor.match(pairs, nothing)
        verified = reconstructor.statistics().verified
        assert [(int(i), int(j)) for i, j, _ in verified] == pairs
        matches = reconstructor.verified_of(pairs)
        assert list(map(tuple, sorted(matches))) == pairs
        found[name] = [np.median(matches[pair][1] - matches[pair][0], axis=0) for pair in pairs]
        linked = reconstructor.correspondences()
        for i, j in pairs:
            rows = linked.matches[i, j]
            for side, index in enumerate((i, j)):
                places = linked.places[index][rows[:, side]]
                np.testing.assert_array_equal(places, matches[i, j][side])
    assert np.abs(found["ordered"]).max() > 5.0
    np.testing.assert_allclose(found["ordered"], found["turned"], atol=2.0)


def test_mapping_starts_from_a_focal_length_where_none_is_known(tmp_path: Path) -> None:
    reconstructor = Reconstructor(tmp_path / "colmap.db", three_pictures(tmp_path), tmp_path / "s")
    known = CameraGroup((0,), "PINHOLE", 300.0)
    reconstructor.extract((known, CameraGroup((1, 2), "SIMPLE_RADIAL")), COARSE, nothing)
    reconstructor.match([(0, 1), (1, 2)], nothing)
    before = reconstructor.verified(10, 1000)
    assert reconstructor.start_focal([0, 1, 2], 0.7) == 1
    with pycolmap.Database.open(tmp_path / "colmap.db") as opened:
        lenses = {camera.model.name: camera for camera in opened.read_all_cameras()}
    assert lenses["PINHOLE"].params.tolist() == [300.0, 300.0, 200.0, 150.0]
    assert lenses["SIMPLE_RADIAL"].params.tolist() == [280.0, 200.0, 150.0, 0.0]
    assert lenses["SIMPLE_RADIAL"].has_prior_focal_length
    after = reconstructor.verified(10, 1000)
    assert {pair: len(places[0]) for pair, places in after.items()} == {
        pair: len(places[0]) for pair, places in before.items()
    }
    assert reconstructor.start_focal([0, 1, 2], 0.9) == 0


def test_who_watches_long_calls_hears_of_each_that_ended(tmp_path: Path) -> None:
    """An adjustment holds the interpreter: nobody could ask while it runs."""
    heard: list[int] = []
    run = Reconstructor(tmp_path / "none.db", [], tmp_path).runner(heard.append)
    assert [run("adjusting", lambda _token: "done") for _ in range(2)] == ["done", "done"]
    assert [num for num in heard if num > 0] == [1, 2]

    def stop(_ended: int) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        Reconstructor(tmp_path / "none.db", [], tmp_path).runner(stop)("adjusting", lambda _: None)
