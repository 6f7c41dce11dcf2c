"""An upload is recognised by its content, and what is dangerous is refused before it is stored."""

from __future__ import annotations

import io
import stat
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from pipelines.captures.archive_rules import ArchiveLimits, open_archive
from pipelines.captures.magic import image_format, video_container
from pipelines.captures.sniff import sniff
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from tests.unit.pipelines.captures.archives import (
    llff_files,
    nerfstudio_files,
    picture,
    polycam_files,
    record3d_files,
    rgbd_files,
    scanner_app_files,
    stray_files,
    write_zip,
)

MP4 = b"\x00\x00\x00\x20ftypisom" + bytes(40)


def code_of(path: Path, filename: str = "x.zip", limits: ArchiveLimits | None = None) -> str:
    with pytest.raises(CaptureError) as caught:
        sniff(path, filename, limits)
    assert caught.value.hint
    assert str(path.parent) not in caught.value.message
    return caught.value.code


def test_video_is_recognised_under_a_false_name(tmp_path: Path) -> None:
    path = tmp_path / "holiday.zip"
    path.write_bytes(MP4)
    assert sniff(path, "holiday.zip").kind == "video"


@pytest.mark.parametrize(
    ("head", "container"),
    [
        (MP4, "mov"),
        (b"\x00\x00\x00\x08wide\x00\x00\x00\x00mdat", "mov"),
        (b"\x1a\x45\xdf\xa3" + bytes(60), "matroska"),
        (b"RIFF\x00\x00\x00\x00AVI LIST", "avi"),
    ],
)
def test_video_containers_are_told_apart(tmp_path: Path, head: bytes, container: str) -> None:
    path = tmp_path / "capture"
    path.write_bytes(head)
    assert sniff(path, "v").details == {"container": container}


def test_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "capture"
    path.touch()
    assert code_of(path) == "empty_file"


@pytest.mark.parametrize(
    "data",
    [
        b"hello, this is text",
        b"The wide, free world of text",
        b"#EXTM3U\nfile:///etc/passwd\n",
        b"Rar!\x1a\x07\x00",
        b"\x00\x00\x00\x18ftypheic" + bytes(40),
    ],
)
def test_other_files_are_of_unknown_type(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "capture"
    path.write_bytes(data)
    assert code_of(path, "clip.mp4") == "unknown_type"


def test_single_photo_is_refused_with_advice_to_send_many(tmp_path: Path) -> None:
    path = tmp_path / "capture"
    path.write_bytes(picture())
    with pytest.raises(CaptureError, match="single picture") as caught:
        sniff(path, "photo.jpg")
    assert caught.value.code == "unknown_type"
    assert ".zip" in caught.value.hint


@pytest.mark.parametrize("top", ["", "My export/"])
@pytest.mark.parametrize(
    ("kind", "files"),
    [
        ("nerfstudio", nerfstudio_files()),
        ("polycam", polycam_files()),
        ("polycam", polycam_files(corrected=False)),
        ("record3d", record3d_files()),
        ("3dscannerapp", scanner_app_files(2)),
        ("stray-scanner", stray_files(b"\0\0\0\x18ftypmp42")),
        ("llff", llff_files()),
        ("rgbd", rgbd_files(layout="beside")),
        ("rgbd", rgbd_files(layout="folder")),
        ("rgbd", rgbd_files(layout="list")),
        ("images", {"b.png": picture(kind="PNG"), "sub/a.data": picture()}),
    ],
)
def test_archives_are_told_apart_with_and_without_a_top_folder(
    tmp_path: Path, kind: str, files: dict[str, bytes | str], top: str
) -> None:
    path = write_zip(tmp_path / "c", {top + name: data for name, data in files.items()})
    assert sniff(path, "capture.bin").kind == kind


@pytest.mark.parametrize(
    "files",
    [
        {"cameras.txt": "# my cameras\n", "images.txt": "list of images\n"},
        {
            "cameras.txt": "# my cameras\n1 OPENCV 64 48 60 60 32 24\n",
            "images.txt": "# best\n1 a\n",
        },
        {"cameras.bin": bytes(8), "images.bin": b"\xff" * 40},
        {"a.xml": '<document version="3.0"><page>'},
        {"doc.xml": '<?xml version="1.0"?>\n<document version="1.2.0">\n  <chunks next_id="1">'},
        {"notes.csv": "#name,size\nIMG_1.jpg,7\n"},
        {"notes.csv": "#name,x,y,label\nIMG_1.jpg,7,8,nose\n"},
        {"reconstruction.json": "[1,2]"},
        {"reconstruction.json": "[]"},
        {"poses.txt": "1 2 3 4\n", **{f"results/{n}.png": picture(kind="PNG") for n in range(3)}},
        {"a/shots.geojson": '{"type": "FeatureCollection"}', "b/cameras.json": "{}"},
    ],
)
def test_photos_beside_files_of_other_things_stay_photos(
    tmp_path: Path, files: dict[str, bytes | str]
) -> None:
    photos = {f"IMG_{n}.jpg": picture(seed=n) for n in range(3)}
    assert sniff(write_zip(tmp_path / "c", photos | files), "c.zip").kind == "images"


PINHOLE = "1 PINHOLE 6 4 5 5 3 2"
POSE = f"1 1 {'0 ' * 6} 1 1.jpg"


@pytest.mark.parametrize(
    ("kind", "files"),
    [
        ("colmap", {"cameras.txt": f"#\n{PINHOLE}", "images.txt": POSE}),
        ("colmap", {"cameras.txt": "# CAMERA_ID", "images.txt": f"# Image list with two\n{POSE}"}),
        ("images", {"cameras.txt": f"#\n{PINHOLE}", "images.txt": POSE.replace("1.jpg", "9.jpg")}),
        ("metashape", {"a.xml": '<document version="2.1.0">\r\n  <chunk label="1">'}),
        ("realitycapture", {"a.csv": "#name,alt,x,y,heading,pitch,roll,f"}),
        ("opensfm", {"reconstruction.json": '[\n    {\n        "cameras"'}),
        ("opensfm", {"p/odm/shots.geojson": '{"type": "FeatureCollection"', "p/cameras.json": ""}),
        ("rgbd", {"poses.txt": "1 2 3", "results/depth1.png": picture(kind="PNG")}),
    ],
)
def test_formats_are_told_by_their_first_lines(
    tmp_path: Path, kind: str, files: dict[str, bytes | str]
) -> None:
    photos = {f"results/{n}.jpg": picture(seed=n) for n in range(3)}
    assert sniff(write_zip(tmp_path / "c", photos | files), "c.zip").kind == kind


def test_r3d_file_is_a_record3d_capture(tmp_path: Path) -> None:
    path = write_zip(
        tmp_path / "c", {"metadata": "{}", "rgbd/0.jpg": picture(), "rgbd/0.depth": ""}
    )
    assert sniff(path, "scan.r3d").kind == "record3d"


def test_litter_of_macos_counts_for_nothing(tmp_path: Path) -> None:
    files = {
        "a.jpg": picture(),
        "__MACOSX/._a.jpg": picture(),
        "._b.jpg": picture(),
        ".DS_Store": b"\x00" * 10,
    }
    assert sniff(write_zip(tmp_path / "c", files), "c.zip").details["num_images"] == 1


def test_zip_without_pictures_is_refused(tmp_path: Path) -> None:
    assert code_of(write_zip(tmp_path / "c", {"a.jpg": "no picture", "b.txt": "x"})) == "no_images"
    assert code_of(write_zip(tmp_path / "d", {})) == "no_images"


@pytest.mark.parametrize(
    ("head", "format_name"),
    [
        (b"GIF89a", "GIF"),
        (b"\xff\x0a", "JPEG XL"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"\0\0\0\x0cjP  \r\n\x87\n", "JPEG 2000"),
    ],
)
def test_zip_of_pictures_that_are_not_read_names_the_format(
    tmp_path: Path, head: bytes, format_name: str
) -> None:
    path = write_zip(tmp_path / "c", {"a.jpg": head + bytes(40)})
    with pytest.raises(CaptureError) as caught:
        sniff(path, "c.zip")
    assert (caught.value.code, format_name in caught.value.hint) == ("no_images", True)


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"\0\0\0\x18ftypheic", "HEIF"),
        (b"\0\0\0\x1cftypmif1\0\0\0\0mif1heicmiaf", "HEIF"),
        (b"\0\0\0\x1cftypmif1\0\0\0\0mif1avifmiaf", "AVIF"),
        (b"\0\0\0\x14ftypmif1\0\0\0\0mif1avif", "HEIF"),  # behind the box is no brand
        (b"\0\0\0\x18ftypavif", "AVIF"),
        (b"\0\0\0\x18ftypcrx ", "RAW"),
        (b"FUJIFILMCCD-RAW 0201", "RAW"),
        (b"IIU\0\x18\0\0\0", "RAW"),
        (b"II*\0\x08\0\0\0", "TIFF"),
        (b"MM\0*\0\0\0\x08", "TIFF"),
        (b"\0\0\0\x18ftypqt  ", None),
        (b"\0\0\0\x18ftypisom", None),
    ],
)
def test_photos_of_phones_and_cameras_are_told_apart_from_films(
    head: bytes, kind: str | None
) -> None:
    assert image_format(head + bytes(40)) == kind
    assert (video_container(head + bytes(40)) == "mov") == (head[4:8] == b"ftyp" and kind is None)


@pytest.mark.parametrize(
    "name",
    [
        *("../evil.jpg", "a/../../evil.jpg", "/etc/evil.jpg", "C:evil.jpg", ".."),
        *(
            "..\\evil.jpg",
            "a\\..\\..\\evil.jpg",
            "a/..\\evil.jpg",
            "\\etc\\evil.jpg",
            "C:\\evil.jpg",
        ),
        *("C:\\evil.jpg", "\\\\server\\evil.jpg", "a\\.."),
    ],
)
def test_unsafe_names_are_refused(tmp_path: Path, name: str) -> None:
    assert code_of(write_zip(tmp_path / "c", {"a.jpg": picture(), name: picture()})) == (
        "archive_unsafe"
    )


def test_folders_as_windows_programs_separate_them_are_read(tmp_path: Path) -> None:
    files: dict[str, bytes | str] = {"shots\\": ""}
    files |= {f"shots\\day 1\\{n}.jpg": picture(seed=n) for n in range(3)}
    path = write_zip(tmp_path / "c", files | {"__MACOSX\\x.jpg": picture(), "d/e\\f.txt": "x"})
    assert sniff(path, "c.zip").details["num_images"] == 3
    with CaptureArchive(path, ArchiveLimits()) as archive:
        assert archive.names == {*(f"shots/day 1/{n}.jpg" for n in range(3)), "d/e/f.txt"}
        archive.extract("shots/day 1/2.jpg", tmp_path / "out.jpg")
    assert (tmp_path / "out.jpg").read_bytes() == files["shots\\day 1\\2.jpg"]
    both = write_zip(tmp_path / "d", {"a/b.jpg": picture(), "a\\b.jpg": picture(seed=1)})
    assert code_of(both) == "archive_unsafe", "which of the two?"


def test_name_with_nul_is_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {"evil.jpgX.txt": picture()})
    path.write_bytes(path.read_bytes().replace(b"evil.jpgX", b"evil.jpg\0"))
    assert code_of(path) == "archive_unsafe"


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFCHR, stat.S_IFIFO])
def test_links_and_devices_are_refused(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "c"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.jpg", picture())
        info = zipfile.ZipInfo("link.jpg")
        info.create_system = 3
        info.external_attr = (kind | 0o777) << 16
        archive.writestr(info, "/etc/passwd")
    assert code_of(path) == "archive_unsafe"


def test_encrypted_archive_is_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {"a.jpg": picture()})
    data = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(mark) + offset] |= 1
    path.write_bytes(data)
    assert code_of(path) == "archive_encrypted"


def test_bomb_is_refused_by_its_ratio(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {"a.jpg": picture(), "b.jpg": bytes(30 << 20)})
    assert path.stat().st_size < 100_000
    assert code_of(path) == "archive_bomb"


def test_bomb_of_many_small_entries_is_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {f"{n}.jpg": bytes(1 << 20) for n in range(8)})
    assert code_of(path) == "archive_bomb"


def test_archive_over_the_limits_is_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {f"{n}.jpg": picture(seed=n) for n in range(5)})
    assert sniff(path, "c.zip").details["num_images"] == 5
    assert code_of(path, limits=ArchiveLimits(max_entries=4)) == "archive_bomb"
    assert code_of(path, limits=ArchiveLimits(max_unpacked_bytes=1000)) == "archive_bomb"


def test_entries_that_share_bytes_are_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {"a.jpg": picture(seed=1), "b.jpg": picture(seed=2)}, 0)
    data = bytearray(path.read_bytes())
    second = data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 1)
    data[second + 42 : second + 46] = struct.pack("<I", 0)
    path.write_bytes(data)
    assert code_of(path) == "archive_bomb"


def test_an_archive_in_an_archive_is_no_picture_and_is_not_opened(tmp_path: Path) -> None:
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w") as archive:
        archive.writestr("b.jpg", picture())
    path = write_zip(tmp_path / "c", {"a.jpg": picture(), "innocent.jpg": inner.getvalue()})
    assert sniff(path, "c.zip").details["num_images"] == 1
    path = write_zip(tmp_path / "d", {"photos.zip": inner.getvalue()})
    with pytest.raises(CaptureError, match="none is a picture") as caught:
        sniff(path, "d.zip")
    assert "other archives, which are not opened" in caught.value.hint


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_entries_of_one_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.jpg", picture())
        archive.writestr("a.jpg", picture(seed=3))
    assert code_of(path) == "archive_unsafe"


def test_cut_off_archive_is_damaged(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c", {f"{n}.jpg": picture(seed=n) for n in range(5)})
    path.write_bytes(path.read_bytes()[:4000])
    assert code_of(path) == "archive_damaged"


def many_entries(path: Path, num: int, name_bytes: int) -> None:
    """A zip of empty entries, written by hand: `zipfile` would take minutes."""
    names = [b"%0*d" % (name_bytes, number) for number in range(num)]
    with path.open("wb") as file:
        file.write(struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 20, 0, 0, 0, 0, 0, 0, 0, 1, 0) + b"a")
        start = file.tell()
        for name in names:
            numbers = (20, 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0, 0, 0, 0, 0, 0)
            file.write(struct.pack("<4sHHHHHHIIIHHHHHII", b"PK\1\2", *numbers) + name)
        size = file.tell() - start
        last = min(num, 0xFFFF)
        file.write(struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, last, last, size, start, 0))


@pytest.mark.parametrize(("num", "name_bytes"), [(300_000, 20), (9_000, 2_000)])
def test_a_list_of_entries_is_bounded_before_it_is_in_memory(
    tmp_path: Path, num: int, name_bytes: int
) -> None:
    many_entries(tmp_path / "many.zip", num, name_bytes)
    tracemalloc.start()
    with pytest.raises(CaptureError) as caught:
        sniff(tmp_path / "many.zip", "many.zip")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert caught.value.code == "archive_bomb"
    assert peak < 40 << 20


def test_a_closed_archive_holds_no_file(tmp_path: Path) -> None:
    many_entries(tmp_path / "few.zip", 3, 20)
    before = len([*Path("/proc/self/fd").iterdir()])
    for _ in range(20):
        with open_archive(tmp_path / "few.zip") as archive:
            assert len(archive.infolist()) == 3
    (tmp_path / "cut.zip").write_bytes((tmp_path / "few.zip").read_bytes()[:-30])
    for _ in range(20):
        with pytest.raises(CaptureError):
            open_archive(tmp_path / "cut.zip")
    assert len([*Path("/proc/self/fd").iterdir()]) <= before


def test_sniffing_loads_no_library_beyond_the_standard_one() -> None:
    program = (
        "import sys; before = set(sys.modules);"  # a distribution's Python has a sitecustomize
        "import pipelines.captures.sniff;"
        "loaded = {m.split('.')[0] for m in set(sys.modules) - before};"
        "print(*sorted(loaded - sys.stdlib_module_names))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    foreign = [name for name in done.stdout.split() if not name.startswith(("_", "pipelines"))]
    assert foreign == []


@pytest.mark.parametrize(
    ("name", "head", "kind"),
    [
        ("cameras.xml", b'<?xml version="1.0"?>\n<document version="1.5.0"><chunk>', "metashape"),
        ("export.csv", b"#name,x,y,alt,heading,pitch,roll,f", "realitycapture"),
        ("model.nvm", b"NVM_V3 \n\n11\n", "visualsfm"),
        ("reconstruction.json", b"[{", "opensfm"),
    ],
)
def test_a_list_of_poses_alone_wants_its_pictures(
    tmp_path: Path, name: str, head: bytes, kind: str
) -> None:
    path = tmp_path / "upload"
    path.write_bytes(head)
    with pytest.raises(CaptureError) as caught:
        sniff(path, name)
    assert caught.value.code == "unknown_type"
    assert kind in caught.value.message
    assert "together with those pictures" in caught.value.hint
