"""Clouds as LAS, LAZ and text, read back by laspy, numpy and Open3D."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any, Literal

import laspy
import numpy as np
import open3d
import pytest

from pipelines.errors import Cancelled
from pipelines.exports.formats import las, numbers, xyz
from pipelines.exports.frame import Frame

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1.0, 1.0, (5000, 3)) * [2.0, 1.0, 0.5] + [481_000.25, 5_432_100.5, 80.0]
"""[5000, 3], where a map's coordinates are: float32 would be half a metre off."""
COLORS = RNG.integers(0, 256, (5000, 3), np.uint8)
NORMALS = RNG.normal(size=(5000, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)


@pytest.mark.parametrize("up", ["z", "y"])
@pytest.mark.parametrize("ending", ["las", "laz"])
def test_laspy_reads_positions_colors_and_normals(
    tmp_path: Path, ending: str, up: Literal["z", "y"]
) -> None:
    path = tmp_path / f"cloud.{ending}"
    las.write_points(path, POINTS, COLORS, NORMALS, Frame(up, metric=True))
    cloud = laspy.read(path)
    points, normals = POINTS, NORMALS
    if up == "y":
        points, normals = (v[:, [0, 2, 1]] * [1.0, 1.0, -1.0] for v in (POINTS, NORMALS))
    np.testing.assert_allclose(cloud.xyz, points, atol=1e-6)
    found = np.stack([cloud.red, cloud.green, cloud.blue], axis=1)
    np.testing.assert_array_equal(found, COLORS.astype(np.uint16) * 257)
    read = np.stack([cloud[f"Normal{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(read, normals, atol=1e-6)
    assert b"1 unit is 1 metre" in cloud.header.vlrs.get("VLR")[0].record_data
    np.testing.assert_allclose(cloud.header.maxs, points.max(0), atol=1e-5)
    assert cloud.header.are_points_compressed == (ending == "laz")


def test_laz_is_smaller_and_both_are_the_same_bytes_again(tmp_path: Path) -> None:
    for name in ("a.las", "b.las", "a.laz", "b.laz"):
        las.write_points(tmp_path / name, POINTS, COLORS, NORMALS, Frame())
    sizes = {name: (tmp_path / name).read_bytes() for name in ("a.las", "b.las", "a.laz", "b.laz")}
    assert sizes["a.las"] == sizes["b.las"]
    assert sizes["a.laz"] == sizes["b.laz"]
    assert len(sizes["a.laz"]) < 0.9 * len(sizes["a.las"])


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_each_point_is_the_only_return_of_its_pulse(tmp_path: Path, ending: str) -> None:
    las.write_points(tmp_path / f"a.{ending}", POINTS, COLORS, NORMALS, Frame())
    cloud = laspy.read(tmp_path / f"a.{ending}")
    assert set(np.asarray(cloud.return_number)) == {1}
    assert set(np.asarray(cloud.number_of_returns)) == {1}
    assert cloud.header.number_of_points_by_return[:2].tolist() == [len(POINTS), 0]


def test_the_bytes_do_not_depend_on_the_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    for day in (2, 3):
        monkeypatch.setattr(laspy.header, "date", _day(day))
        las.write_points(tmp_path / "a.las", POINTS, COLORS, NORMALS, Frame())
        written.append((tmp_path / "a.las").read_bytes())
    assert written[0] == written[1]


def _day(number: int) -> type[datetime.date]:
    """The calendar on a day of January 2026."""

    class Day(datetime.date):
        @classmethod
        def today(cls) -> Day:
            return cls(2026, 1, number)

    return Day


@pytest.mark.parametrize("points", [POINTS[:1], np.repeat(POINTS[:1], 3, axis=0)])
def test_a_cloud_without_extent_is_written(tmp_path: Path, points: np.ndarray) -> None:
    count = len(points)
    las.write_points(tmp_path / "a.las", points, COLORS[:count], NORMALS[:count], Frame())
    np.testing.assert_allclose(laspy.read(tmp_path / "a.las").xyz, points, atol=1e-5)


@pytest.mark.parametrize("extent", [1e-7, 5e-4, 3e-3, 2.0, 900.0])
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (-7.25, 0.5, 1234.5)])
def test_a_cloud_of_any_extent_is_written_wherever_it_lies(
    tmp_path: Path, extent: float, at: tuple[float, float, float]
) -> None:
    points = np.random.default_rng(1).uniform(0.0, extent, (200, 3)) + at
    las.write_points(tmp_path / "a.las", points, COLORS[:200], NORMALS[:200], Frame())
    cloud = laspy.read(tmp_path / "a.las")
    np.testing.assert_allclose(cloud.xyz, points, rtol=1e-12, atol=1e-6 * extent)
    if extent > 1.0:
        np.testing.assert_array_equal(cloud.header.offsets, np.round(cloud.header.offsets))


def test_text_has_a_line_for_each_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbers, "_ROWS", 700)
    path = tmp_path / "cloud.xyz"
    xyz.write_points(path, POINTS, COLORS, NORMALS, Frame())
    assert path.read_text().startswith("# x y z red green blue nx ny nz; right-handed, +Z up")
    rows = np.loadtxt(path)
    np.testing.assert_allclose(rows[:, :3], POINTS, atol=1e-5)
    np.testing.assert_array_equal(rows[:, 3:6], COLORS)
    np.testing.assert_allclose(rows[:, 6:], NORMALS, atol=1e-5)
    read: Any = open3d.io.read_point_cloud(path)
    assert len(read.points) == len(POINTS)


def test_text_tells_how_far_it_is_and_stops_where_it_is_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numbers, "_ROWS", 1000)
    told: list[float] = []

    def tell(done: float) -> None:
        told.append(done)
        if done >= 0.6:
            raise Cancelled("The job was cancelled.")

    with pytest.raises(Cancelled):
        xyz.write_points(tmp_path / "cloud.xyz", POINTS, COLORS, NORMALS, Frame(), tell)
    assert told == [0.2, 0.4, 0.6]
