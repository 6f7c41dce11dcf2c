"""Which images, in which order, with which lens."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from pipelines.errors import CaptureError
from pipelines.sfm.source import Source, camera_groups, read_source
from pipelines.workspace import Workspace


def photos(folder: Path, sizes: list[tuple[int, int]], **exif: dict[int, str]) -> Source:
    files = []
    for index, size in enumerate(sizes):
        image = Image.new("RGB", size)
        tags = image.getexif()
        if index in exif.get("model", {}):
            tags[272] = exif["model"][index]
        image.save(folder / f"{index}.jpg", exif=tags)
        files.append(f"{index}.jpg")
    return Source(folder, tuple(files), (None,) * len(files), is_video=False)


def test_photos_come_in_the_order_of_the_record(tmp_path: Path) -> None:
    folder = tmp_path / "ingest" / "images"
    folder.mkdir(parents=True)
    names = ["b.jpg", "a b.jpg", "c.jpg"]
    for name in names:
        Image.new("RGB", (8, 8)).save(folder / name)
    images = [{"file": f"images/{name}", "width": 8, "height": 8} for name in names]
    (tmp_path / "ingest" / "capture.json").write_text(json.dumps({"images": images}), "utf-8")
    source = read_source(Workspace(tmp_path))
    assert source.files == tuple(f"images/{name}" for name in names)
    assert source.timestamps_s == (None, None, None)
    assert not source.is_video


def test_a_listed_image_that_is_missing_is_named(tmp_path: Path) -> None:
    (tmp_path / "ingest").mkdir()
    listed = {"images": [{"file": "images/gone.jpg"}]}
    (tmp_path / "ingest" / "capture.json").write_text(json.dumps(listed), "utf-8")
    with pytest.raises(CaptureError) as caught:
        read_source(Workspace(tmp_path))
    assert caught.value.code == "no_images"
    assert caught.value.details["missing"] == ["images/gone.jpg"]


def test_photos_of_one_size_and_camera_share_a_lens(tmp_path: Path) -> None:
    (group,) = camera_groups(photos(tmp_path, [(64, 48)] * 6), "OPENCV")
    assert group.indices == (0, 1, 2, 3, 4, 5)
    assert group.lens == "OPENCV"


def test_sizes_and_cameras_are_kept_apart_and_few_views_get_a_simple_lens(tmp_path: Path) -> None:
    sizes = [(64, 48)] * 6 + [(48, 64), (64, 48)]
    groups = camera_groups(photos(tmp_path, sizes, model={7: "Other phone"}), "OPENCV")
    assert [(group.indices, group.lens) for group in groups] == [
        ((0, 1, 2, 3, 4, 5), "OPENCV"),
        ((6,), "SIMPLE_RADIAL"),
        ((7,), "SIMPLE_RADIAL"),
    ]


def test_frames_of_a_film_are_one_group_without_opening_them(tmp_path: Path) -> None:
    film = Source(tmp_path, ("a.jpg",) * 9, (0.0,) * 9, is_video=True)
    (group,) = camera_groups(film, "OPENCV_FISHEYE")
    assert group.lens == "OPENCV_FISHEYE"


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"not a picture")
    with pytest.raises(CaptureError) as caught:
        camera_groups(Source(tmp_path, ("a.jpg",), (None,), is_video=False), "OPENCV")
    assert caught.value.code == "image_undecodable"
