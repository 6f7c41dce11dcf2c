"""Whatever of an archive nobody used is told, by kind, folder and reason."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.leftovers import leftover_warnings, leftovers
from pipelines.captures.sniff import sniff
from pipelines.captures.unpack import CaptureArchive
from tests.unit.pipelines.captures.archives import nerfstudio_files, picture, write_zip
from tests.unit.pipelines.captures.ingesting import Files, ingest, warning_with


def told(tmp_path: Path, files: Files, used: tuple[str, ...] = ()) -> list[str]:
    """What is said of an archive of which only some files are read."""
    path = write_zip(tmp_path / "c.zip", files)
    with CaptureArchive(path, ArchiveLimits()) as archive:
        for name in used:
            archive.read(name)
        return leftover_warnings(leftovers(archive))


def test_files_are_counted_by_kind_and_folder(tmp_path: Path) -> None:
    files: Files = {f"extra/{n}.jpg": picture(seed=n) for n in range(12)}
    files |= {"notes.txt": "x", "a.json": "{}", "read.json": "{}"}
    (sentence,) = told(tmp_path, files, used=("read.json",))
    assert sentence == (
        "12 pictures in extra/, 1 JSON file (a.json) and 1 text file (notes.txt) were not used."
    )


def test_nothing_is_said_where_nothing_is_left(tmp_path: Path) -> None:
    assert told(tmp_path, {"a.txt": "x"}, used=("a.txt",)) == []
    summary, _ = ingest(tmp_path, nerfstudio_files())
    assert (summary["warnings"], "leftovers" in summary) == ([], False)


def test_files_that_are_zips_inside_leave_the_photos_a_capture(tmp_path: Path) -> None:
    """What scanning apps, NumPy and Word write lay beside photos, and the whole was refused."""
    inner = write_zip(tmp_path / "inner.zip", {"scene.usdc": b"x" * 100}).read_bytes()
    files: Files = {f"IMG_{n}.jpg": picture(seed=n) for n in range(8)}
    files |= dict.fromkeys(("scan.usdz", "poses.npz", "notes.docx", "more.zip", "more.cbz"), inner)
    assert sniff(write_zip(tmp_path / "c.zip", files), "c.zip").kind == "images"
    summary, _ = ingest(tmp_path, files)
    assert summary["num_images"] == 8
    told = "\n".join(summary["warnings"])
    for text in ("3D model (scan.usdz)", "array file (poses.npz)", "document (notes.docx)"):
        assert f"1 {text}" in told
    assert "2 archives at the top were not used: archives within an archive are not opened" in told


def test_looking_at_a_file_does_not_use_it(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "c.zip", {"a.txt": "x"})
    with CaptureArchive(path, ArchiveLimits()) as archive:
        archive.peek("a.txt", 10)
        assert archive.unused == {"a.txt": ""}
        archive.set_aside(["a.txt"], "a reason")
        archive.set_aside(["a.txt"], "a later one")
        assert archive.unused == {"a.txt": "a reason"}


@pytest.mark.parametrize(
    ("name", "content", "program"),
    [
        ("sparse/0/cameras.bin", b"", "COLMAP"),
        ("images.txt", b"# Image list", "COLMAP"),
        ("opensfm/reconstruction.json", b"{}", "OpenSfM"),
        ("poses_bounds.npy", b"", "LLFF"),
        ("odometry.csv", b"timestamp, frame", "Stray Scanner"),
        ("a.nvm", b"NVM_V2", "VisualSFM"),
        ("cameras.sfm", b"{}", "Meshroom"),
    ],
)
def test_poses_of_other_programs_beside_photos_are_named(
    tmp_path: Path, name: str, content: bytes, program: str
) -> None:
    files: Files = {f"photos/{n}.jpg": picture(seed=n) for n in range(8)}
    summary, _ = ingest(tmp_path, files | {name: content})
    assert (summary["kind"], summary["num_images"]) == ("images", 8)
    assert name in warning_with(summary, f"camera poses of {program} are not read")


@pytest.mark.parametrize(
    ("name", "content", "program"),
    [
        ("sparse/0/cameras.bin", b"", "COLMAP"),
        ("opensfm/reconstruction.json", b"[]", "OpenSfM"),
        ("turntable.xml", b'<?xml version="1.0"?>\n<document version="1.5.0">', "Metashape"),
        ("export.csv", b"#cameras 12\n#name,x,y,alt", "RealityCapture"),
        ("a.nvm", b"NVM_V3", "VisualSFM"),
    ],
)
def test_further_poses_beside_those_that_are_read_are_named(
    tmp_path: Path, name: str, content: bytes, program: str
) -> None:
    summary, _ = ingest(tmp_path, nerfstudio_files() | {name: content})
    assert summary["kind"] == "nerfstudio"
    assert name in warning_with(summary, f"camera poses of {program} are not read")


def test_videos_and_unreadable_formats_in_an_archive_are_told(tmp_path: Path) -> None:
    files: Files = {
        "clip.mp4": b"\x00\x00\x00\x20ftypisom" + bytes(40),
        "a.gif": b"GIF89a" + bytes(40),
    }
    clip, gif = sorted(told(tmp_path, files), key=lambda text: "GIF" in text)
    assert clip.startswith("1 video (clip.mp4) was not used: videos are read where")
    assert gif.startswith("1 GIF picture (a.gif) was not used: GIF is not read, convert")


def test_record_and_summary_hold_the_counts(tmp_path: Path) -> None:
    files = nerfstudio_files() | {f"more/{n}.jpg": picture(seed=9 + n) for n in range(3)}
    summary, ctx = ingest(tmp_path, files)
    expected = {
        "kind": "picture",
        "folder": "more/",
        "count": 3,
        "why": "not listed in transforms.json",
        "example": "more/0.jpg",
    }
    record = json.loads((ctx.out / "capture.json").read_text())
    assert summary["leftovers"] == record["details"]["leftovers"] == [expected]
    assert "3 pictures in more/ were not used: not listed in transforms.json." in record["warnings"]


def test_many_groups_are_summed_up(tmp_path: Path) -> None:
    files: Files = {f"f{n}/a.txt": "x" for n in range(20)}
    (sentence,) = told(tmp_path, files)
    assert sentence.endswith("and 14 other files were not used.")
