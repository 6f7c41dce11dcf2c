"""What the benchmark of poses by two ways compares."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from pipelines.sample.film import walk
from pipelines.sample.scene import pose_matrix
from tests.benchmarks.pose_accuracy import PoseErrors
from tests.benchmarks.poses_both_ways import BothWays, apart, archived, row_of

GIVEN = {f"{n}.jpg": pose_matrix(image) for n, image in enumerate(walk(12).images)}


def test_pictures_are_paired_by_name_and_compared_in_any_frame() -> None:
    found = {}
    for name, pose in reversed(GIVEN.items()):
        found[name] = np.column_stack([pose[:, :3], 3.0 * pose[:, 3] + (1.0, 2.0, 3.0)])
    del found["4.jpg"]
    assert apart(found, GIVEN).center_90_percent < 1e-9
    swapped = {**found, "0.jpg": found["11.jpg"], "11.jpg": found["0.jpg"]}
    assert apart(swapped, GIVEN).center_90_percent > 5.0
    with pytest.raises(ValueError, match="three are needed"):
        apart({"1.jpg": GIVEN["1.jpg"]}, GIVEN)


@pytest.mark.parametrize(
    ("percent", "num_found", "fine"), [(0.4, 50, True), (0.6, 50, False), (0.4, 30, False)]
)
def test_what_is_wanted(percent: float, num_found: int, fine: bool) -> None:
    errors = PoseErrors(num_found, 0.1, 0.2, 0.1, percent, 1.0)
    one = BothWays("fox", 50, num_found, errors, "trusted", "quick 50")
    assert one.is_as_wanted is fine
    assert row_of(one)[-1] == ("yes" if fine else "no")


def test_a_folder_is_packed_once(tmp_path: Path) -> None:
    (tmp_path / "fox" / "images").mkdir(parents=True)
    (tmp_path / "fox" / "images" / "1.jpg").write_bytes(b"1")
    path = archived(tmp_path / "fox", tmp_path / "out")
    assert zipfile.ZipFile(path).namelist() == ["images/1.jpg"]
    written = path.stat().st_mtime_ns
    assert archived(tmp_path / "fox", tmp_path / "out").stat().st_mtime_ns == written
    assert archived(path, tmp_path / "out") == path
