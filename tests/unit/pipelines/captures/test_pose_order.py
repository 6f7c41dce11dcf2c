"""Distances from epipolar lines, and the orders in which rows may belong to pictures."""

from __future__ import annotations

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.contents import Reading
from pipelines.captures.importer import Claim
from pipelines.captures.importers import llff
from pipelines.captures.orders import AS_TEXT, COUNTED, FROM_0, FROM_1, frame_number, orders, paired
from pipelines.captures.pose_order import _look, epipolar_distances, proven
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.sample.film import hand_held_pose, phone_camera
from pipelines.scene.cameras_file import Intrinsics
from tests.app_writers import write_llff
from tests.unit.pipelines.captures.archives import context, picture, write_zip

LENS = phone_camera(480)
WIDE = Intrinsics(400, 300, 250.0, 255.0, 190.0, 160.0)


def seen(points: np.ndarray, pose: np.ndarray, lens: Intrinsics) -> np.ndarray:
    local = (points - pose[:, 3]) @ pose[:, :3]
    x = lens.fl_x * local[:, 0] / -local[:, 2] + lens.cx
    y = -lens.fl_y * local[:, 1] / -local[:, 2] + lens.cy
    return np.column_stack([x, y])


def test_points_lie_on_their_lines_and_pixels_beside_them_as_far_as_they_are_moved() -> None:
    poses = hand_held_pose(0.2), hand_held_pose(0.35)
    points = np.random.default_rng(5).uniform(-0.3, 0.3, (50, 3))
    places = seen(points, poses[0], LENS), seen(points, poses[1], WIDE)
    on = epipolar_distances(poses, (LENS, WIDE), places)
    np.testing.assert_allclose(on, 0.0, atol=1e-9)
    # Moved by 2 px in all directions, a place leaves its line by at most that, seldom by little.
    angles = np.linspace(0, np.pi, 50)
    moved = places[1] + 2.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    off = epipolar_distances(poses, (LENS, WIDE), (places[0], moved))
    assert off.max() <= 2.0
    assert off.max() > 1.2
    # The other way round it is the same.
    turned = epipolar_distances(poses[::-1], (WIDE, LENS), (moved, places[0]))
    np.testing.assert_allclose(turned, off, rtol=1e-9)


def test_two_readings_that_fit_alike_are_refused(tmp_path: Path) -> None:
    """Nearly the same poses under both: the pictures cannot tell, and nobody guesses."""
    write_llff(tmp_path / "c.zip", padded=True)
    with CaptureArchive(tmp_path / "c.zip", ArchiveLimits()) as archive:
        capture = llff.read(archive, Claim("kitchen/", ""))
        (true,) = capture.readings
        moved = [
            replace(
                source,
                world_from_camera=tuple(
                    (*row[:3], row[3] + 1e-4 * n) for row in source.world_from_camera
                ),
            )
            for n, source in enumerate(true.sources)
        ]
        both = replace(capture, readings=[true, Reading("another way", moved, False)])
        with pytest.raises(CaptureError, match=r"in several ways: .*another way: 0") as caught:
            proven(archive, both, IngestOptions(), context(tmp_path / "both"))
        assert caught.value.code == "poses_malformed"
        alone = proven(archive, capture, IngestOptions(), context(tmp_path / "alone"))
    assert alone.sources == true.sources
    assert alone.warnings == capture.warnings


def test_cameras_in_one_place_have_no_lines() -> None:
    pose = hand_held_pose(0.4)
    places = np.zeros((3, 2)), np.ones((3, 2))
    assert np.isinf(epipolar_distances((pose, pose), (LENS, LENS), places)).all()


@pytest.mark.parametrize(
    ("names", "num_rows", "found"),
    [
        (["1.jpg", "2.jpg"], 2, {COUNTED: [0, 1]}),
        (["9.jpg", "10.jpg"], 2, {COUNTED: [0, 1], AS_TEXT: [1, 0]}),
        (["0.jpg", "4.jpg"], 9, {FROM_0: [0, 4]}),
        (["4.jpg", "9.jpg"], 9, {FROM_1: [3, 8]}),
        (["a1.jpg", "b1.jpg"], 9, {}),
        (["a.jpg", "b.jpg"], 9, {}),
        (["10.jpg"], 5, {}),
        (["0.jpg", "1.jpg", "2.jpg"], 2, {FROM_0: [0, 1], FROM_1: [0, 1]}),
        ([], 3, {}),
    ],
)
def test_rows_pair_with_names(names: list[str], num_rows: int, found: dict[str, list[int]]) -> None:
    rows = {
        rule: [row for _, row in rows]
        for rule, rows in orders(names, num_rows, by_number=True).items()
    }
    assert rows == found
    assert not orders(names, len(names) + 1, by_number=False)


@pytest.mark.parametrize(
    ("name", "number"),
    [("a/b12/frame-000007.color.png", 7), ("x.png", None), ("3/x.png", None), ("9" * 30, None)],
)
def test_the_last_number_of_a_name_counts(name: str, number: int | None) -> None:
    assert frame_number(name) == number


@pytest.mark.parametrize(
    ("names", "others", "found"),
    [
        (["a/7.jpg", "a/10.jpg"], ["b/0007.txt", "b/0010.txt"], [0, 1]),
        (["frame-01.color.png"], ["frame-02.pose.txt", "frame-01.pose.txt"], [1]),
        (["f7.jpg", "f10.jpg"], ["depth10.png", "depth7.png"], [1, 0]),
        (["0_cam1.png", "1_cam1.png"], ["1_cam1.txt", "0_cam1.txt"], [1, 0]),
        (["1_00.png", "1_01.png"], ["0_00.txt", "0_01.txt", "1_00.txt", "1_01.txt"], [2, 3]),
        (["1_00.png", "1_01.png"], ["0_00.txt", "0_01.txt", "1_00.txt"], [2, None]),
        (["1.jpg", "1.png"], ["1.txt"], [0, None]),
        (["t1305031102175304000.png"], ["t1305031102175304000.txt"], [0]),
        (["a.jpg"], ["b.txt"], [None]),
        (["f0.png", "f1.png"], ["a_0.txt", "b_0.txt"], "a_0"),
        (["a_0.png", "b_0.png"], ["pose0.txt"], "a_0"),
        (["1.png"], ["pose/1.txt", "poses/1.txt"], "pose/1"),
        (["1.png", "01.png"], ["1.txt"], "1"),
    ],
)
def test_files_pair_by_name_and_only_then_by_number(
    names: list[str], others: list[str], found: list[int | None] | str
) -> None:
    """found: the place in `others` of each name's file; or the file that two would do for."""
    if isinstance(found, str):
        with pytest.raises(CaptureError) as caught:
            paired(names, others)
        assert caught.value.code == "poses_malformed"
        assert f'"{found}.' in caught.value.message
    else:
        expected = {
            name: others[at] for name, at in zip(names, found, strict=True) if at is not None
        }
        assert paired(names, others) == expected


def test_pictures_are_looked_at_as_they_stream_by(tmp_path: Path) -> None:
    """24 MiB that follow a picture's end are in no memory, and none counts as used."""
    path = write_zip(tmp_path / "c", {"a.jpg": picture() + os.urandom(24 << 20)}, 0)
    with CaptureArchive(path, ArchiveLimits()) as archive:
        tracemalloc.start()
        looked = _look(archive, ["a.jpg"], tmp_path, IngestOptions())
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert [(item.width, item.height) for item in looked] == [(64, 48)]
        assert list(archive.unused) == ["a.jpg"]
    assert peak < 12 << 20
