"""RealityCapture's tables, written field for field from known cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.captures.sniff import sniff
from pipelines.registry import skipped_stages
from pipelines.scene.cameras_file import Intrinsics
from tests.sfm_writers import pictures_of, realitycapture_csv, walked
from tests.unit.pipelines.captures.archives import write_zip
from tests.unit.pipelines.captures.ingesting import (
    assert_lenses,
    assert_poses,
    cameras,
    failure,
    ingest,
    sources,
    warning_with,
)

LENSES = (
    Intrinsics(64, 48, 61.5, 61.5, 32.75, 23.5, "OPENCV", -0.03, 0.01, 0.002, 1e-3, 1e-3, -2e-3),
    Intrinsics(48, 64, 55.0, 55.0, 24.0, 33.0),
)
TRUTH = walked(*LENSES)
PICTURES = pictures_of(TRUTH)


@pytest.mark.parametrize("count", [True, False])
@pytest.mark.parametrize("name", ["export.csv", "rc/cameras.txt"])
def test_poses_and_lenses_are_those_that_were_written(
    tmp_path: Path, name: str, count: bool
) -> None:
    files = PICTURES | {name: realitycapture_csv(TRUTH, count=count).encode("utf-8-sig")}
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "realitycapture"
    summary, ctx = ingest(tmp_path / "job", files)
    assert skipped_stages("realitycapture") == {"frames"}
    assert (summary["num_posed"], summary["metric"]) == (10, False)
    assert_poses(ctx, TRUTH)
    assert_lenses(ctx, TRUTH, 1e-9)


def test_columns_may_be_named_as_realityscan_does(tmp_path: Path) -> None:
    head, rows = realitycapture_csv(TRUTH, count=False).split("\r\n", 1)
    renamed = head.replace("heading", "yaw").replace(",f,px,py,", ",f_35mm,px_norm,py_norm,")
    assert renamed.split(",")[4:10] == ["yaw", "pitch", "roll", "f_35mm", "px_norm", "py_norm"]
    summary, ctx = ingest(tmp_path, PICTURES | {"scan.csv": f"{renamed}\r\n{rows}".encode()})
    assert summary["num_posed"] == 10
    assert_poses(ctx, TRUTH)
    assert_lenses(ctx, TRUTH, 1e-9)


def test_a_camera_without_angles_looks_down_with_north_above(tmp_path: Path) -> None:
    """What the angles mean, by hand: pitch 90 looks to the horizon, heading 90 to the east,
    roll is about the camera's own upper edge."""
    rows = [
        "#name,x,y,alt,heading,pitch,roll,f",
        "IMG_9.jpg,1,2,3,0,0,0,36",
        "IMG_10.jpg,1,2,3,0,90,0,36",
        "IMG_11.jpg,1,2,3,90,90,0,36",
        "IMG_12.jpg,1,2,3,90,90,90,36",
    ]
    _, ctx = ingest(tmp_path, PICTURES | {"a.csv": "\n".join(rows).encode()})
    order = np.argsort([int(source.rpartition("_")[2][:-4]) for source in sources(ctx)])
    poses = np.array([image.world_from_camera for image in cameras(ctx).images])[order]
    looks, ups = -poses[:, :, 2], poses[:, :, 1]
    np.testing.assert_allclose(looks, [[0, 0, -1], [0, 1, 0], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(ups[:3], [[0, 1, 0], [0, 0, 1], [0, 0, 1]], atol=1e-12)
    assert cameras(ctx).cameras[0].fl_x == 64.0


def test_map_coordinates_are_brought_near(tmp_path: Path) -> None:
    text = realitycapture_csv(TRUTH).split("\r\n")
    moved = [text[0]]
    for line in text[1:-1]:
        name, x, y, *rest = line.split(",")
        moved.append(",".join([name, repr(float(x) + 449_000), repr(float(y) + 5_411_000), *rest]))
    summary, ctx = ingest(tmp_path, PICTURES | {"a.csv": "\n".join(moved).encode()})
    centers = np.array([image.world_from_camera for image in cameras(ctx).images])[:, :, 3]
    assert np.abs(centers).max() < 10.0
    assert warning_with(summary, "units from the world's origin")


def test_pictures_without_a_row_and_rows_without_a_picture_are_told(tmp_path: Path) -> None:
    lines = realitycapture_csv(TRUTH).split("\r\n")
    files = PICTURES | {"a.csv": "\n".join([*lines[:3], *lines[4:]]).encode()}
    del files["images/left/IMG_10.jpg"]
    summary, ctx = ingest(tmp_path, files)
    assert len(cameras(ctx).images) == 8
    assert "IMG_10.jpg" in warning_with(summary, "1 of them are not in the archive")
    assert "IMG_11.jpg" in warning_with(summary, "not listed in a.csv")


def test_without_pictures_it_says_which_it_wants(tmp_path: Path) -> None:
    error = failure(tmp_path, {"a.csv": realitycapture_csv(TRUTH)})
    assert (error.code, "IMG_10.jpg" in error.message) == ("poses_missing", True)


def test_other_tables_are_none(tmp_path: Path) -> None:
    files = PICTURES | {"a.csv": b"name,x,y\n1,2,3\n", "b.csv": b"# a list of names\n"}
    assert sniff(write_zip(tmp_path / "c", files), "c").kind == "images"


def column(name: str, value: str) -> Callable[[str], str]:
    """A change of one column in every row."""

    def change(text: str) -> str:
        head, *rows = text.strip().split("\r\n")
        index = head.lstrip("#").split(",").index(name)
        changed = []
        for row in rows:
            words = row.split(",")
            words[index] = value
            changed.append(",".join(words))
        return "\r\n".join([head, *changed])

    return change


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (lambda text: text.split("\r\n")[0], "poses_missing", "lists no cameras"),
        (lambda text: text.replace("heading", "azimuth"), "poses_missing", "heading"),
        (lambda text: "#name,x,y,z\nIMG_9.jpg,1,2,3", "poses_missing", "alt, heading, pitch"),
        (
            lambda text: text.replace(",", ";").replace("#name;", "#name,", 1),
            "poses_missing",
            "x, y",
        ),
        (lambda text: text.replace(".jpg,", ".jpg,1.0,"), "poses_malformed", "17 columns"),
        (column("x", "nan"), "poses_malformed", "x in line"),
        (column("pitch", "inf"), "poses_malformed", "pitch in line"),
        (column("k3", ""), "poses_malformed", "k3 in line"),
        (column("f", "0"), "poses_malformed", "focal length"),
        (column("px", "7"), "poses_malformed", "principal point"),
        (column("name", ""), "poses_missing", "lists no cameras"),
        (column("name", "../../etc/passwd"), "poses_missing", "none of them is in the archive"),
    ],
)
def test_faults_are_refused_by_name(
    tmp_path: Path, change: Callable[[str], str], code: str, words: str
) -> None:
    error = failure(tmp_path, PICTURES | {"a.csv": change(realitycapture_csv(TRUTH)).encode()})
    assert error.code == code
    assert words in error.message


def test_windows_paths_and_paths_out_of_the_folder_are_only_names(tmp_path: Path) -> None:
    text = realitycapture_csv(TRUTH).replace("IMG_", "C:\\shots\\IMG_")
    _, ctx = ingest(tmp_path / "a", PICTURES | {"a.csv": text.encode()})
    assert_poses(ctx, TRUTH)
    text = realitycapture_csv(TRUTH).replace("IMG_", "../../../IMG_")
    _, ctx = ingest(tmp_path / "b", PICTURES | {"a.csv": text.encode()})
    assert_poses(ctx, TRUTH)


def test_one_bad_row_in_ten_is_left_out_by_name(tmp_path: Path) -> None:
    lines = realitycapture_csv(TRUTH).split("\r\n")
    lines[4] = lines[4].replace(",", ",x", 1)
    summary, ctx = ingest(tmp_path, PICTURES | {"a.csv": "\n".join(lines).encode()})
    assert len(cameras(ctx).images) == 9
    assert "line 5" in warning_with(summary, "Left out")
