"""Which images, in which order, with which lens."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.sfm.source import Source, camera_groups, prior_focal_px, read_source
from pipelines.stages import ingest
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_settings import FeatureSettings
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.archives import context, phone_exif, picture, write_zip


def photos(
    folder: Path, sizes: list[tuple[int, int]], exif: dict[int, dict[str, Any]] | None = None
) -> Source:
    """Photos as `ingest` leaves them: no metadata in the files, exif by index in the record."""
    files = tuple(f"{index}.jpg" for index in range(len(sizes)))
    for file, size in zip(files, sizes, strict=True):
        Image.new("RGB", size).save(folder / file)
    tags = tuple((exif or {}).get(index, {}) for index in range(len(sizes)))
    return Source(folder, files, (None,) * len(files), is_video=False, exif=tags)


def ingested(root: Path, files: Mapping[str, bytes]) -> Source:
    """What poses are asked for once a zip of photos went through `ingest`."""
    ctx = context(root)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, files)
    ingest.run(IngestOptions(), ctx)
    ctx.out.rename(ctx.workspace.stage("ingest"))
    return read_source(ctx.workspace)


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
    source = photos(tmp_path, sizes, {7: {"model": "Other phone"}})
    groups = camera_groups(source, "OPENCV")
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


def test_two_lenses_of_one_phone_stay_two_through_ingest(tmp_path: Path) -> None:
    """Twelve photos, alternately with the main lens and the wide one."""
    focals = [(5.7, 26), (1.6, 13)] * 6
    files = {
        f"{n:02d}.jpg": picture(400, 300, seed=n, exif=phone_exif(*focal))
        for n, focal in enumerate(focals)
    }
    source = ingested(tmp_path, files)
    main, wide = camera_groups(source, "OPENCV")
    assert (main.indices, wide.indices) == ((0, 2, 4, 6, 8, 10), (1, 3, 5, 7, 9, 11))
    # 500 px of diagonal against 43.27 mm.
    assert main.focal_px == pytest.approx(26 * 500 / np.hypot(36, 24))
    assert wide.focal_px == pytest.approx(13 * 500 / np.hypot(36, 24))


def test_colmap_starts_from_the_focal_length_of_the_photos(tmp_path: Path) -> None:
    """From the zip to COLMAP's database; a photo without EXIF has no prior."""
    tags = [phone_exif(5.7, 26)] * 6 + [phone_exif(1.6, 13)] * 2 + [None]
    files = {}
    for n, exif in enumerate(tags):
        told: dict[str, Any] = {"exif": exif} if exif else {}
        files[f"{n}.jpg"] = picture(400, 300, seed=n, **told)
    source = ingested(tmp_path, files)
    reconstructor = Reconstructor(tmp_path / "c.db", source.paths, tmp_path / "s", num_threads=1)
    settings = FeatureSettings(400, 500, upsample=False, num_threads=1)
    reconstructor.extract(camera_groups(source, "OPENCV"), settings, lambda _done: None)
    with pycolmap.Database.open(tmp_path / "c.db") as database:
        found = [
            (camera.model.name, camera.has_prior_focal_length, round(camera.mean_focal_length(), 1))
            for camera in database.read_all_cameras()
        ]
    assert found == [
        ("OPENCV", True, 300.5),
        ("SIMPLE_RADIAL", True, 150.2),
        ("SIMPLE_RADIAL", False, 480.0),  # COLMAP's guess: 1.2 long sides
    ]


def test_photos_taken_upright_have_the_same_focal_length(tmp_path: Path) -> None:
    files = {
        f"{n}.jpg": picture(400, 300, seed=n, exif=phone_exif(5.7, 26, orientation))
        for n, orientation in enumerate((1, 6, 8, 1) * 2)
    }
    flat, upright = camera_groups(ingested(tmp_path, files), "OPENCV")
    assert (flat.indices, upright.indices) == ((0, 3, 4, 7), (1, 2, 5, 6))
    assert flat.focal_px == upright.focal_px


@pytest.mark.parametrize(
    ("exif", "focal_px"),
    [
        ({"focal_mm": 50.0, "sensor_mm": 36.0}, 50 / 36 * 3000),
        ({"focal_35mm": 50.0}, 50 / 36 * 3000),
        ({"focal_mm": 50.0}, None),
        ({"focal_35mm": 1.0}, None),  # a tenth of a fisheye's
        ({"focal_mm": 400.0, "sensor_mm": 1.0}, None),
        ({}, None),
    ],
)
def test_focal_length_in_pixels(exif: dict[str, float], focal_px: float | None) -> None:
    assert prior_focal_px(exif, 3000, 2000) == (focal_px and pytest.approx(focal_px))
    assert prior_focal_px(exif, 2000, 3000) == (focal_px and pytest.approx(focal_px))


def test_a_drones_wide_picture_is_a_part_of_its_sensor() -> None:
    """3.61 mm behind a sensor of 6.17 mm, which is called 20 mm."""
    assert prior_focal_px({"focal_35mm": 20.0}, 4000, 2250) == pytest.approx(2340, rel=0.02)
    assert prior_focal_px({"focal_35mm": 20.0}, 4000, 3000) == pytest.approx(2340, rel=0.02)


def test_frames_without_a_time_are_taken_in_their_order(tmp_path: Path) -> None:
    folder = tmp_path / "frames" / "images"
    folder.mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (8, 8)).save(folder / name)
    rows = [{"file": f"images/{name}", "timestamp_s": None} for name in ("a.jpg", "b.jpg")]
    (tmp_path / "frames" / "frames.json").write_text(json.dumps({"frames": rows}), "utf-8")
    (tmp_path / "frames" / "manifest.json").write_text("{}", "utf-8")
    source = read_source(Workspace(tmp_path))
    assert source.timestamps_s == (None, None)
    assert source.is_video


def test_the_frames_of_each_clip_are_a_lens_and_a_sequence_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "frames" / "images"
    folder.mkdir(parents=True)
    rows = []
    for number, clip in enumerate((0, 0, 1, 1, 1)):
        Image.new("RGB", (8, 8)).save(folder / f"{number}.jpg")
        rows.append({"file": f"images/{number}.jpg", "timestamp_s": number / 10, "clip": clip})
    (tmp_path / "frames" / "frames.json").write_text(json.dumps({"frames": rows}), "utf-8")
    (tmp_path / "frames" / "manifest.json").write_text("{}", "utf-8")
    source = read_source(Workspace(tmp_path))
    assert source.stretches == [range(2), range(2, 5)]
    assert [group.indices for group in camera_groups(source, "RADIAL")] == [(0, 1), (2, 3, 4)]


def test_frames_of_a_clip_that_something_lies_over_have_masks(tmp_path: Path) -> None:
    folder = tmp_path / "frames" / "images"
    folder.mkdir(parents=True)
    rows: list[dict[str, Any]] = []
    for number in range(4):
        Image.new("RGB", (8, 8)).save(folder / f"{number}.jpg")
        rows.append({"file": f"images/{number}.jpg", "timestamp_s": number / 10, "clip": 0})
    rows[2]["mask"] = "masks/2.png"
    (tmp_path / "frames" / "frames.json").write_text(json.dumps({"frames": rows}), "utf-8")
    (tmp_path / "frames" / "manifest.json").write_text("{}", "utf-8")
    source = read_source(Workspace(tmp_path))
    assert source.masks == (None, None, "masks/2.png", None)
    assert source.mask_paths == {2: tmp_path / "frames" / "masks/2.png"}


@pytest.mark.captures
@pytest.mark.skipif(
    "NERFWORKS_CAPTURES" not in os.environ,
    reason="real captures are NOT tested: NERFWORKS_CAPTURES does not name their folder",
)
def test_a_compact_cameras_photos_have_the_focal_length_colmap_reads(tmp_path: Path) -> None:
    folder = Path(os.environ["NERFWORKS_CAPTURES"]) / "photos-sceaux-castle" / "images"
    photos = sorted(folder.glob("*.JPG"))
    source = ingested(tmp_path, {path.name: path.read_bytes() for path in photos})
    (group,) = camera_groups(source, "OPENCV")
    assert (source.exif[0]["model"], source.exif[0]["focal_mm"]) == (
        "KODAK Z612 ZOOM DIGITAL CAMERA",
        5.85,
    )
    by_colmap = pycolmap.Bitmap.read(str(photos[0]), False)
    assert by_colmap is not None
    assert group.focal_px == pytest.approx(by_colmap.exif_focal_length(), rel=1e-3)
