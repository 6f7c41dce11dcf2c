"""Damaged uploads of every kind: each is read, or refused with a code and a hint. Nothing else.

The damage is random bytes from fixed seeds, where it hurts most: the directory of an archive, the
numbers of a JSON file, the headers of pictures and videos.
"""

from __future__ import annotations

import json
import random
import resource
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from pipelines.captures.sniff import sniff
from pipelines.errors import CaptureError, PipelineError, ToolError
from pipelines.options import IngestOptions
from pipelines.scene.cameras_file import CamerasFile
from pipelines.stages.ingest import run
from tests.photo_writers import Dng, Heic, dng, heic
from tests.sfm_writers import (
    colmap_files,
    metashape_xml,
    nvm_text,
    odm_files,
    opensfm_reconstruction,
    pictures_of,
    realitycapture_csv,
    walked,
)
from tests.unit.pipelines.captures.archives import (
    context,
    llff_files,
    nerfstudio_files,
    phone_exif,
    picture,
    polycam_files,
    record3d_files,
    rgbd_files,
    scanner_app_files,
    stray_files,
    write_zip,
)
from tests.unit.pipelines.captures.icc import DISPLAY_P3_XYZ, rgb_profile
from tests.unit.pipelines.captures.importers.test_blender import blender_files
from tests.unit.pipelines.captures.ingesting import Files
from tests.unit.pipelines.tools.clips import make_clip

OPTIONS = IngestOptions(max_pixels=1_000_000, max_unpacked_bytes=50 << 20)


def outcome(folder: Path, data: bytes, sniffed_only: bool = False) -> str:
    """The kind that an upload is read as, or the code that it is refused with."""
    ctx = context(folder)
    path = ctx.workspace.capture_file
    path.parent.mkdir(parents=True)
    path.write_bytes(data)
    try:
        kind = sniff(path, "upload").kind
        return kind if sniffed_only else str(run(OPTIONS, ctx)["kind"])
    except PipelineError as caught:
        error = caught
    assert isinstance(error, CaptureError | ToolError), error
    assert error.code
    assert error.hint
    assert str(folder) not in error.message + error.hint
    return error.code


def mutations(data: bytes, count: int, seed: int, start: int = 0) -> Iterator[bytes]:
    """Copies of the bytes with a few of them changed from `start` on, some also cut off."""
    rng = random.Random(seed)
    for _ in range(count):
        changed = bytearray(data)
        for _ in range(rng.randint(1, 5)):
            place = rng.randrange(start, len(changed))
            changed[place] = rng.choice([0, 0x7F, 0x80, 0xFF, rng.randrange(256)])
        if rng.random() < 0.1:
            del changed[rng.randrange(max(start, 8), len(changed)) :]
        yield bytes(changed)


def zipped(tmp_path: Path, files: Mapping[str, bytes | str], method: int = 8) -> bytes:
    return write_zip(tmp_path / "made.zip", files, method).read_bytes()


@pytest.mark.parametrize("method", [0, 8])
def test_archives_whose_directory_is_damaged(tmp_path: Path, method: int) -> None:
    data = zipped(tmp_path, nerfstudio_files(4), method)
    directory = data.index(b"PK\x01\x02")
    found = Counter(
        outcome(tmp_path / str(n), changed, sniffed_only=True)
        for n, changed in enumerate(mutations(data, 150, method, directory))
    )
    assert found["archive_damaged"] > 50
    assert found["nerfstudio"] > 5


def test_archives_damaged_anywhere(tmp_path: Path) -> None:
    data = zipped(tmp_path, nerfstudio_files(4))
    found = Counter(
        outcome(tmp_path / str(n), changed) for n, changed in enumerate(mutations(data, 60, 3))
    )
    assert found["archive_damaged"] > 10


@pytest.mark.parametrize("field", [16, 20, 24, 42])
@pytest.mark.parametrize("value", [0, 0x7FFFFFFF, 0xFFFFFFFE, 0xFFFFFFFF])
def test_directory_entry_with_an_absurd_number(tmp_path: Path, field: int, value: int) -> None:
    """CRC, packed size, size and offset of the first entry."""
    data = bytearray(zipped(tmp_path, nerfstudio_files(4)))
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + field, value)
    assert outcome(tmp_path / "job", bytes(data)) in (
        "archive_damaged",
        "archive_bomb",
        "nerfstudio",
    )


@pytest.mark.parametrize("field", [8, 10, 12, 16])
@pytest.mark.parametrize("more", [1, 100, 100_000, 0x7FFF0000])
def test_end_record_with_a_wrong_number(tmp_path: Path, field: int, more: int) -> None:
    """Two counts of entries, the directory's size and offset: entries lie before the file then."""
    data = bytearray(zipped(tmp_path, nerfstudio_files(4)))
    place = data.index(b"PK\x05\x06") + field
    form = "<H" if field < 12 else "<I"
    (value,) = struct.unpack_from(form, data, place)
    struct.pack_into(form, data, place, (value + more) % (1 << 8 * struct.calcsize(form)))
    assert outcome(tmp_path / "job", bytes(data)) in (
        "archive_damaged",
        "archive_bomb",
        "nerfstudio",
    )


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (nerfstudio_files, "transforms.json"),
        (lambda: blender_files(train=4), "transforms_train.json"),
        (record3d_files, "EXR_RGBD/metadata.json"),
        (polycam_files, "keyframes/corrected_cameras/1500000.json"),
        (lambda: scanner_app_files(4, 1), "All_Data/frame_00002.json"),
        (lambda: rgbd_files(4), "pose/2.txt"),
        (lambda: stray_files(b"\0\0\0\x18ftypmp42"), "scan/odometry.csv"),
        (lambda: rgbd_files(4), "intrinsic/intrinsic_color.txt"),
        (lambda: rgbd_files(4, "list"), "poses.txt"),
    ],
)
def test_damaged_text(tmp_path: Path, make: Callable[[], Files], name: str) -> None:
    files = make()
    text = str(files[name])
    rng = random.Random(name)
    for n in range(40):
        where = rng.randrange(len(text))
        piece = rng.choice(
            ['"', "[", "]", "{}", "null", "-", "1e999", "NaN", ",", "[[1]]", ":", ""]
        )
        changed = text[:where] + piece + text[where + rng.randint(0, 12) :]
        data = zipped(tmp_path, files | {name: changed}, 0)
        assert outcome(tmp_path / str(n), data)


def test_damaged_films_with_poses(tmp_path: Path) -> None:
    film = make_clip(tmp_path / "a.mp4", "testsrc2=s=320x192:r=12:d=1").read_bytes()
    for n, changed in enumerate(mutations(film, 8, 8, 40)):
        assert outcome(tmp_path / str(n), zipped(tmp_path, stray_files(changed), 0))


def test_damaged_arrays(tmp_path: Path) -> None:
    files = llff_files(4)
    whole = files["poses_bounds.npy"]
    assert isinstance(whole, bytes)
    for n, changed in enumerate(mutations(whole, 40, 7)):
        assert outcome(
            tmp_path / str(n), zipped(tmp_path, files | {"poses_bounds.npy": changed}, 0)
        )


@pytest.mark.parametrize("value", ["null", "[]", "{}", '"x"', "true", "1e400", "[[[1]]]", "-1"])
def test_json_with_every_value_of_another_type(tmp_path: Path, value: str) -> None:
    """Each key of each format in turn."""
    for make, name in (
        (nerfstudio_files, "transforms.json"),
        (record3d_files, "EXR_RGBD/metadata.json"),
        (lambda: scanner_app_files(4, 1), "All_Data/frame_00002.json"),
    ):
        files: Files = make()
        text = str(files[name])
        extra = '"camera_model": 0, "distortion_params": 0, "applied_transform": 0, "k1": 0, '
        text = "{" + extra + text[1:]
        keys = [part.split('"')[-1] for part in text.split('": ')[:-1]]
        for n, key in enumerate(dict.fromkeys(keys)):
            begin = text.index(f'"{key}": ')
            changed = text[:begin] + f'"{key}": {value}, "was_' + text[begin + 1 :]
            data = zipped(tmp_path, files | {name: changed}, 0)
            assert outcome(tmp_path / name.replace("/", "_") / str(n), data)


@pytest.mark.parametrize("kind", ["opensfm", "opendronemap", "metashape", "realitycapture", "nvm"])
def test_damaged_lists_of_photogrammetry_programs(tmp_path: Path, kind: str) -> None:
    """Pieces put in and taken out, as of JSON above, and bytes changed."""
    truth = walked(num=8)
    odm = odm_files(truth)
    name, data = {
        "opensfm": ("reconstruction.json", json.dumps([opensfm_reconstruction(truth)]).encode()),
        "opendronemap": ("odm_report/shots.geojson", odm["odm_report/shots.geojson"]),
        "metashape": ("cameras.xml", metashape_xml(truth, in_component=True).encode()),
        "realitycapture": ("a.csv", realitycapture_csv(truth).encode()),
        "nvm": ("a.nvm", nvm_text(truth).encode()),
    }[kind]
    files = pictures_of(truth) | (odm if kind == "opendronemap" else {})
    rng = random.Random(kind)
    changes = [*mutations(data, 20, 8)]
    for _ in range(25):
        where = rng.randrange(len(data))
        piece = rng.choice(
            [b'"', b"<", b"]", b"</chunk>", b"null", b"-", b"1e999", b"nan", b",", b"\n", b" ", b""]
        )
        changes.append(data[:where] + piece + data[where + rng.randint(0, 30) :])
    for n, changed in enumerate(changes):
        assert outcome(tmp_path / str(n), zipped(tmp_path, files | {name: changed}, 0))


def photo(seed: int, kind: str) -> bytes:
    if kind not in ("HEIC", "DNG"):
        return picture(seed=seed, kind=kind)
    pixels = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), np.uint8)
    if kind == "DNG":
        return dng(pixels)
    return heic(pixels, Heic(1, phone_exif(5.0, 26), icc=rgb_profile(DISPLAY_P3_XYZ, None)))


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "AVIF", "HEIC", "DNG"])
def test_damaged_pictures(tmp_path: Path, kind: str) -> None:
    """One of twelve photos is damaged: it is left out, or shows what is left of it."""
    files: Files = {f"{n}.x": picture(seed=n) for n in range(12)}
    victim = photo(5, kind)
    found = Counter(
        outcome(tmp_path / str(n), zipped(tmp_path, files | {"5.x": changed}, 0))
        for n, changed in enumerate(mutations(victim[:700], 25, 4))
    )
    found += Counter(
        outcome(tmp_path / f"whole{n}", zipped(tmp_path, files | {"5.x": changed}, 0))
        for n, changed in enumerate(mutations(victim, 15, 5))
    )
    assert set(found) == {"images"}


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("HEIC", (16_000, 16_000)),
        ("HEIC", (8, 8)),
        ("HEIC", (0, 1 << 31)),
        ("DNG", (12_000, 12_000)),
        ("DNG", (1 << 16, 1 << 16)),
        ("DNG", (0, 64)),
    ],
)
def test_photos_of_other_sizes_than_they_declare(
    tmp_path: Path, kind: str, size: tuple[int, int]
) -> None:
    """A few bytes that claim gigabytes: refused before any is taken, with what and why."""
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    lie = heic(pixels, Heic(size=size)) if kind == "HEIC" else dng(pixels, Dng(size=size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    data = zipped(tmp_path, {f"{n}.x": lie + bytes([n]) for n in range(9)}, 0)
    assert outcome(tmp_path / "job", data) == "image_undecodable"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10  # KiB


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("what", ["cameras", "images", "points3D"])
def test_damaged_models_of_colmap(tmp_path: Path, form: str, what: str) -> None:
    truth = walked(num=8)
    files = pictures_of(truth) | colmap_files(truth, form=form)
    name = f"sparse/0/{what}.{'bin' if form == 'binary' else 'txt'}"
    found = Counter(
        outcome(tmp_path / str(n), zipped(tmp_path, files | {name: changed}, 0))
        for n, changed in enumerate(mutations(files[name], 25, 7))
    )
    assert set(found) <= {"colmap", "images", "poses_malformed", "poses_missing", "too_few_images"}


@pytest.mark.parametrize("value", [0, 1 << 31, (1 << 64) - 1])
@pytest.mark.parametrize("where", ["cameras", "images", "points3D"])
def test_models_of_colmap_that_count_absurdly(tmp_path: Path, where: str, value: int) -> None:
    truth = walked(num=8)
    files = pictures_of(truth) | colmap_files(truth)
    data = files[f"sparse/0/{where}.bin"]
    files[f"sparse/0/{where}.bin"] = struct.pack("<Q", value) + data[8:]
    assert outcome(tmp_path, zipped(tmp_path, files, 0)) in (
        "colmap",
        "images",
        "poses_malformed",
        "poses_missing",
    )


def test_damaged_videos(tmp_path: Path) -> None:
    data = make_clip(tmp_path / "a.mp4", "testsrc2=s=160x90:r=10:d=2").read_bytes()
    for n, changed in enumerate(mutations(data, 8, 6, data.index(b"moov"))):
        assert outcome(tmp_path / str(n), changed)


def listing_of(kind: str, truth: CamerasFile) -> tuple[str, str]:
    """A list of poses, its name in the archive and its text."""
    odm = odm_files(truth)
    return {
        "colmap": (
            "images.txt",
            colmap_files(truth, form="text", folder="")["images.txt"].decode(),
        ),
        "opensfm": ("reconstruction.json", json.dumps([opensfm_reconstruction(truth)])),
        "opendronemap": ("odm_report/shots.geojson", odm["odm_report/shots.geojson"].decode()),
        "metashape": ("cameras.xml", metashape_xml(truth)),
        "realitycapture": ("a.csv", realitycapture_csv(truth)),
        "visualsfm": ("a.nvm", nvm_text(truth)),
    }[kind]


LISTS = ("colmap", "opensfm", "opendronemap", "metashape", "realitycapture", "visualsfm")


@pytest.mark.parametrize("kind", LISTS)
@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("IMG_", "IMG_", None),
        ("IMG_", "C:\\shots\\IMG_", None),
        ("IMG_", "..\\..\\IMG_", None),
        ("IMG_", "../../../../IMG_", None),
        ("IMG_", "/etc/../IMG_", None),
        ("IMG_", "/etc/passwd/", "poses_missing"),
        ("IMG_", "nothing_", "poses_missing"),
        ("IMG_", "IMG_9.jpg/../nothing_", "poses_missing"),
    ],
)
def test_paths_in_lists_of_poses(
    tmp_path: Path, kind: str, old: str, new: str, expected: str | None
) -> None:
    """Paths of another machine are found by their end; none leads out of the archive.

    A model of COLMAP that names none of the photos is a leftover, and they are photos.
    """
    truth = walked(num=8)
    name, text = listing_of(kind, truth)
    files = pictures_of(truth) | (odm_files(truth) if kind == "opendronemap" else {})
    if kind == "colmap":
        files |= colmap_files(truth, form="text", folder="")
    escaped = new.replace("\\", "\\\\") if name.endswith("json") else new
    data = zipped(tmp_path, files | {name: text.replace(old, escaped)}, 0)
    kind_read = {"opendronemap": "opensfm"}.get(kind, kind)
    refused = "images" if kind == "colmap" else expected
    assert outcome(tmp_path / "job", data) == (kind_read if expected is None else refused)


@pytest.mark.parametrize("kind", LISTS)
@pytest.mark.parametrize("kept", [0, 1, 3])
def test_lists_that_end_early_or_hold_nothing(tmp_path: Path, kind: str, kept: int) -> None:
    """A quarter, none or three quarters of the file: read with what is left, or refused."""
    truth = walked(num=8)
    name, text = listing_of(kind, truth)
    files = pictures_of(truth) | (odm_files(truth) if kind == "opendronemap" else {})
    if kind == "colmap":
        files |= colmap_files(truth, form="text", folder="")
    data = zipped(tmp_path, files | {name: text[: len(text) * kept // 4]}, 0)
    found = outcome(tmp_path / "job", data)
    refused = {"poses_malformed", "poses_missing", "too_few_images"}
    left_alone = {"images"} if kept == 0 else set()
    partly = {"realitycapture", "colmap"} if kept else set()  # their rows stand for themselves
    assert found in refused | left_alone | partly
