"""What all captures have in common: pictures are checked and cleaned; unusable ones say why."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.minimum import MIN_IMAGES, MIN_POSED_IMAGES
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import Cancelled, CaptureError
from pipelines.options import IngestOptions, PosesOptions
from pipelines.stages import train
from pipelines.stages.ingest import run
from tests.unit.pipelines.captures.archives import (
    context,
    exif,
    nerfstudio_files,
    picture,
    red_corner,
    write_zip,
)
from tests.unit.pipelines.captures.ingesting import (
    Files,
    code_of,
    failure,
    ingest,
    sources,
    warning_with,
)


def test_photos_are_turned_upright_and_lose_their_metadata(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n, exif=exif(6)) for n in range(8)}
    summary, ctx = ingest(tmp_path, files)
    assert (summary["kind"], summary["num_images"]) == ("images", 8)
    for path in sorted((ctx.out / "images").iterdir()):
        with PIL.Image.open(path) as image:
            assert image.size == (48, 64)
            assert not image.getexif()
            assert b"Phone" not in path.read_bytes()
        assert red_corner(path) == (True, False)  # top left turned clockwise is top right


def test_photos_without_metadata_keep_their_bytes(tmp_path: Path) -> None:
    data = picture(seed=5)
    files: Files = {f"b{n}.jpg": picture(seed=10 + n) for n in range(8)}
    _, ctx = ingest(tmp_path, files | {"a.jpg": data})
    assert (ctx.out / "images" / "00001.jpg").read_bytes() == data


def test_pictures_appended_behind_a_photo_are_dropped(tmp_path: Path) -> None:
    hidden = picture(seed=9, exif=exif(1))
    _, ctx = ingest(tmp_path, {f"{n}.jpg": picture(seed=n) + hidden for n in range(8)})
    assert b"Phone" not in (ctx.out / "images" / "00001.jpg").read_bytes()


def test_photos_are_ordered_as_people_count(tmp_path: Path) -> None:
    numbers = (10, 2, 1, 20, 3, 4, 5, 30)
    _, ctx = ingest(tmp_path, {f"IMG_{n}.jpg": picture(seed=n) for n in numbers})
    assert sources(ctx) == [f"IMG_{n}.jpg" for n in sorted(numbers)]


def test_transparent_and_deep_pictures_become_plain_rgb(tmp_path: Path) -> None:
    clear, deep = io.BytesIO(), io.BytesIO()
    layer = np.full((48, 64, 4), (255, 0, 0, 0), np.uint8)
    layer[:, 32:] = np.random.default_rng(0).integers(0, 256, (48, 32, 4), np.uint8)
    PIL.Image.fromarray(layer).save(clear, "PNG")
    values = np.random.default_rng(1).integers(0, 65536, (48, 64)).astype(np.uint16)
    values[:10, :10] = 65535
    PIL.Image.fromarray(values).save(deep, "PNG")
    frames = nerfstudio_files(4)
    files: Files = {
        name.replace(".jpg", ".png"): clear.getvalue() for name in frames if "images/" in name
    }
    files["images/3.png"] = deep.getvalue()
    files["transforms.json"] = str(frames["transforms.json"]).replace(".jpg", ".png")
    _, ctx = ingest(tmp_path, files)
    for name in ("00001.png", "00004.png"):
        with PIL.Image.open(ctx.out / "images" / name) as image:
            assert image.mode == "RGB"
            assert image.getpixel((5, 5)) == (255, 255, 255)


def test_one_broken_photo_among_many_is_left_out_with_a_warning(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n) for n in range(12)}
    files["5.jpg"] = picture(seed=5)[:900]
    summary, _ = ingest(tmp_path, files)
    assert summary["num_images"] == 11
    assert any("5.jpg" in warning for warning in summary["warnings"])


def test_photos_that_do_not_decode_fail_the_stage(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n)[:700] for n in range(5)}
    assert code_of(tmp_path, files) == "image_undecodable"


def test_picture_with_too_many_pixels_is_refused_unread(tmp_path: Path) -> None:
    options = IngestOptions(max_pixels=10_000)
    files: Files = {f"{n}.jpg": picture(200, 100, seed=n) for n in range(4)}
    assert code_of(tmp_path, files, options) == "image_undecodable"


def test_fewer_photos_than_poses_can_use_are_refused_at_once(tmp_path: Path) -> None:
    """One number for all stages: what `ingest` lets through, `poses` does not refuse unseen."""
    assert PosesOptions().min_registered == MIN_IMAGES
    files: Files = {f"{n}.jpg": picture(seed=n) for n in range(MIN_IMAGES - 1)}
    assert failure(tmp_path / "a", files).code == "too_few_images"
    summary, _ = ingest(tmp_path / "b", files | {"last.jpg": picture(seed=99)})
    assert summary["num_images"] == MIN_IMAGES


def test_posed_captures_need_what_training_needs(tmp_path: Path) -> None:
    assert vars(train)["MIN_POSED_IMAGES"] == MIN_POSED_IMAGES
    assert code_of(tmp_path / "a", nerfstudio_files(MIN_POSED_IMAGES - 1)) == "too_few_images"
    summary, _ = ingest(tmp_path / "b", nerfstudio_files(MIN_POSED_IMAGES))
    assert summary["num_posed"] == MIN_POSED_IMAGES


def test_pictures_that_are_not_read_are_named_with_what_to_do(tmp_path: Path) -> None:
    files: Files = {f"{n}.gif": b"GIF89a" + bytes(40) for n in range(60)}
    few = failure(tmp_path / "a", files | {f"{n}.jpg": picture(seed=n) for n in range(3)})
    assert few.code == "too_few_images"
    assert "60 GIF pictures at the top were not used: GIF is not read, convert" in few.message
    enough, _ = ingest(tmp_path / "b", files | {f"{n}.jpg": picture(seed=n) for n in range(8)})
    assert warning_with(enough, "60 GIF pictures", "convert")


def test_entry_that_holds_more_than_it_declares_is_stopped(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {f"{n}.jpg": picture(640, 480, seed=n) for n in range(2)})
    target = tmp_path / "target"
    with CaptureArchive(path, ArchiveLimits()) as archive:
        entry = archive._entries["0.jpg"]
        declared = entry.file_size
        entry.file_size = 10
        with pytest.raises(CaptureError) as caught:
            archive.extract("0.jpg", target)
    assert caught.value.code in ("archive_bomb", "archive_damaged")
    assert not target.exists() or target.stat().st_size < declared


def test_damaged_entry_is_noticed_by_its_checksum(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {"0.jpg": picture(640, 480), "1.jpg": picture()}, 0)
    data = bytearray(path.read_bytes())
    data[20_000] ^= 0xFF
    path.write_bytes(data)
    with CaptureArchive(path, ArchiveLimits()) as archive, pytest.raises(CaptureError) as caught:
        archive.extract("0.jpg", tmp_path / "target")
    assert caught.value.code == "archive_damaged"


def test_cancel_stops_between_photos(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, {f"{n}.jpg": picture(seed=n) for n in range(9)})
    ctx.is_cancelled = lambda: (ctx.out / "images" / "00003.jpg").exists()
    with pytest.raises(Cancelled):
        run(IngestOptions(), ctx)
    assert not (ctx.out / "images" / "00004.jpg").exists()


def test_zip_is_sniffed_again_and_never_trusted(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    with zipfile.ZipFile(ctx.workspace.capture_file, "w") as archive:
        archive.writestr("../a.jpg", picture())
    with pytest.raises(CaptureError) as caught:
        run(IngestOptions(), ctx)
    assert caught.value.code == "archive_unsafe"
