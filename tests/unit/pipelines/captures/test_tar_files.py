"""Tar archives: taken as zips are, and refused as zips are."""

from __future__ import annotations

import gzip
import io
import os
import random
import struct
import tarfile
import tracemalloc
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import pytest

from pipelines.captures import tar_files
from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.sniff import sniff
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from tests.unit.pipelines.captures.archives import nerfstudio_files, picture, polycam_files

LIMITS = ArchiveLimits()
PHOTOS: dict[str, bytes | str] = {f"{n}.jpg": picture(seed=n) for n in range(4)}


def header(name: str, size: int = 0, kind: bytes = b"0") -> bytes:
    """A header as `tarfile` would not write it."""
    info = tarfile.TarInfo(name)
    info.size, info.type = size, kind
    return info.tobuf(tarfile.GNU_FORMAT)


def padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 512)


def endless(data: bytes) -> bytes:
    """A tar without the zeros at its end, so that more can follow."""
    return padded(data.rstrip(b"\0"))


def tarred(
    files: Mapping[str, bytes | str], form: int = tarfile.PAX_FORMAT, top: str = ""
) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=form) as archive:
        for name, data in files.items():
            content = data.encode() if isinstance(data, str) else data
            info = tarfile.TarInfo(top + name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return stream.getvalue()


def with_member(**fields: object) -> bytes:
    """Photos, and an entry of another kind."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        content = picture()
        photo = tarfile.TarInfo("a.jpg")
        photo.size = len(content)
        archive.addfile(photo, io.BytesIO(content))
        info = tarfile.TarInfo("b.jpg")
        for key, value in fields.items():
            setattr(info, key, value)
        archive.addfile(info)
    return stream.getvalue()


def code_of(path: Path, data: bytes, limits: ArchiveLimits = LIMITS) -> str:
    path.write_bytes(data)
    with pytest.raises(CaptureError) as caught:
        sniff(path, "c.tar", limits)
    assert caught.value.message
    assert caught.value.hint
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    return caught.value.code


@pytest.mark.parametrize("form", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("kind", "files"),
    [("images", PHOTOS), ("nerfstudio", nerfstudio_files()), ("polycam", polycam_files())],
)
@pytest.mark.parametrize("top", ["", "./", "My export/", f"{'long ' * 18}/{'name ' * 12}/"])
def test_captures_in_a_tar_are_those_in_a_zip(
    tmp_path: Path,
    form: int,
    packed: bool,
    kind: str,
    files: Mapping[str, bytes | str],
    top: str,
) -> None:
    data = tarred(files, form, top)
    path = tmp_path / "capture"
    path.write_bytes(gzip.compress(data) if packed else data)
    found = sniff(path, "capture")
    assert found.kind == kind
    assert found.details["num_entries"] == len(files)
    below = "" if top == "./" else top
    with CaptureArchive(path, LIMITS) as archive:
        assert archive.names == {below + name for name in files}
        for name, content in files.items():
            whole = content.encode() if isinstance(content, str) else content
            assert archive.read(below + name) == whole
            archive.extract(below + name, tmp_path / "out")
            assert (tmp_path / "out").read_bytes() == whole
            assert archive.checksum(below + name) == zlib.crc32(whole)
    assert {entry.name for entry in tmp_path.iterdir()} == {"capture", "out"}


def test_folders_and_litter_count_for_nothing(tmp_path: Path) -> None:
    for name in ("shots", "shots/more"):
        (tmp_path / "c" / name).mkdir(parents=True)
    for name, data in PHOTOS.items():
        (tmp_path / "c" / "shots" / name).write_bytes(data if isinstance(data, bytes) else b"")
        (tmp_path / "c" / "shots" / f"._{name}").write_bytes(b"litter")
    with tarfile.open(tmp_path / "c.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "c", ".")
    assert sniff(tmp_path / "c.tar.gz", "c.tar.gz").details["num_images"] == 4
    with CaptureArchive(tmp_path / "c.tar.gz", LIMITS) as opened:
        assert opened.names == {f"shots/{name}" for name in PHOTOS}


def test_several_entries_are_read_side_by_side(tmp_path: Path) -> None:
    (tmp_path / "c").write_bytes(tarred({"a.jpg": picture() + b"a" * 50_000, "b.jpg": picture()}))
    with CaptureArchive(tmp_path / "c", LIMITS) as archive:
        first = archive._archive.open(archive._entries["a.jpg"])
        assert first.read(100) == picture()[:100]
        assert archive.read("b.jpg") == picture()
        assert first.read() == picture()[100:] + b"a" * 50_000


def test_a_packed_tar_in_two_pieces_and_filled_up_is_read(tmp_path: Path) -> None:
    data = tarred(PHOTOS)
    packed = gzip.compress(data[:3000]) + gzip.compress(data[3000:]) + bytes(700)
    (tmp_path / "c").write_bytes(packed)
    assert sniff(tmp_path / "c", "c").details["num_images"] == 4


def member(data: bytes, name: bytes = b"", extra: bytes = b"") -> bytes:
    """A member of a gzipped file, with the fields that its header may have."""
    flags = (4 if extra else 0) | (8 if name else 0)
    fields = (struct.pack("<H", len(extra)) + extra if extra else b"") + name + b"\0" * bool(name)
    return b"\x1f\x8b\x08" + bytes([flags]) + bytes(6) + fields + gzip.compress(data)[10:]


EMPTY = gzip.compress(b"")


@pytest.mark.parametrize(
    "make",
    [
        lambda data: EMPTY + gzip.compress(data),
        lambda data: member(b"", b"of nothing") + gzip.compress(data),
        lambda data: member(data, b"a.tar"),
        lambda data: member(data, extra=random.Random(1).randbytes(65_535)),
        lambda data: gzip.compress(data[:100]) + gzip.compress(data[100:]),
        lambda data: EMPTY.join(  # as bgzip ends its files, one behind another
            member(data[n : n + 700], extra=b"BC\2\0\0\0") for n in range(0, len(data), 700)
        ),
        lambda data: EMPTY * 450 + gzip.compress(data) + EMPTY * 450,
    ],
    ids=["empty first", "empty, named", "named", "extra", "short first", "blocks", "many empty"],
)
def test_a_tar_packed_in_members_is_read(tmp_path: Path, make: Callable[[bytes], bytes]) -> None:
    (tmp_path / "c").write_bytes(make(tarred(PHOTOS)))
    assert sniff(tmp_path / "c", "c").details["num_images"] == 4


@pytest.mark.parametrize("before", [0, 1, 2, 3])
def test_a_member_may_begin_where_a_read_ends(tmp_path: Path, before: int) -> None:
    data = tarred(PHOTOS)
    first, second = gzip.compress(data[:3000]), gzip.compress(data[3000:])
    left = (1 << 20) - before - len(first)
    filling = member(b"", b"a" * (left - len(EMPTY) - 1))
    assert len(first + filling) == (1 << 20) - before
    packed = first + filling + second
    (tmp_path / "c").write_bytes(packed)
    assert sniff(tmp_path / "c", "c").details["num_images"] == 4


def test_members_that_unpack_to_much_are_read_to_their_end(tmp_path: Path) -> None:
    """Their last piece is drained in several turns."""
    rng = random.Random(4)
    rows = (b"%.3f,%d,0,0,0,1.000\n" % (rng.random(), n // 50) for n in range(300_000))
    more = {"poses.csv": b"".join(rows), "film.bin": rng.randbytes(300_000)}
    data = tarred({**more, **PHOTOS})
    for length in (3 << 20, 5 << 20):
        cuts = range(0, len(data), length)
        packed = b"".join(gzip.compress(data[cut : cut + length]) for cut in cuts)
        (tmp_path / "c").write_bytes(packed)
        assert sniff(tmp_path / "c", "c").details["num_images"] == 4
        with CaptureArchive(tmp_path / "c", ArchiveLimits()) as archive:
            assert archive.names == {*more, *PHOTOS}


def test_what_many_members_cost_grows_with_the_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each that ends leaves the rest of what it was fed to be copied."""
    fed = 0

    class Counting:
        def __init__(self, wbits: int) -> None:
            self._stream = zlib.decompressobj(wbits=wbits)

        def decompress(self, data: bytes, most: int) -> bytes:
            nonlocal fed
            fed += len(data)
            return self._stream.decompress(data, most)

        def __getattr__(self, name: str) -> object:
            return getattr(self._stream, name)

    class Zlib:
        error, decompressobj = zlib.error, Counting

    path = tmp_path / "c"
    data = tarred({**PHOTOS, "5.jpg": random.Random(2).randbytes(1 << 20)})
    path.write_bytes(b"".join(gzip.compress(data[n : n + 512]) for n in range(0, len(data), 512)))
    monkeypatch.setattr(tar_files, "zlib", Zlib)
    with CaptureArchive(path, LIMITS) as archive:
        assert len(archive.names) == 5
    assert fed < 4 * path.stat().st_size
    fed = 0
    path.write_bytes(EMPTY * 500_000)
    assert not tar_files.is_tar(path)
    assert fed < 2 << 20


LINKS = (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE)
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    **{
        f"of kind {kind!r}": (
            partial(with_member, type=kind, linkname="/etc/passwd"),
            "archive_unsafe",
        )
        for kind in (*LINKS, tarfile.GNUTYPE_SPARSE, b"V", b"M", b"Z")
    },
    **{
        f"name {name!r}": (partial(with_member, name=name), "archive_unsafe")
        for name in (
            "../evil.jpg",
            "a/../../evil.jpg",
            "./../evil.jpg",
            "/etc/evil.jpg",
            "C:evil.jpg",
            "a\\evil.jpg",
            "x" * 150 + "/../evil.jpg",
        )
    },
    "a link to the folder above, then a file in it": (
        lambda: (
            endless(with_member(name="up", type=tarfile.SYMTYPE, linkname=".."))
            + tarred({"up/evil.jpg": picture()})
        ),
        "archive_unsafe",
    ),
    "a sparse file by POSIX": (
        lambda: with_member(pax_headers={"GNU.sparse.major": "1", "GNU.sparse.size": "1"}),
        "archive_unsafe",
    ),
    "an extended name with NUL": (
        lambda: (
            header("x", 19, b"x")
            + padded(b"19 path=evil.jpg\0x\n")
            + header("a.jpg", 3)
            + padded(b"abc")
        ),
        "archive_unsafe",
    ),
    "two entries of one name": (
        lambda: tarred({"a.jpg": picture(), "./a.jpg": picture(seed=3)}),
        "archive_unsafe",
    ),
    "packed far too small": (
        lambda: gzip.compress(tarred({"a.jpg": picture(), "b.jpg": bytes(30 << 20)})),
        "archive_bomb",
    ),
    "packed twice": (
        lambda: gzip.compress(gzip.compress(tarred(PHOTOS))),
        "unknown_type",
    ),
    "a header of headers of a terabyte": (
        lambda: header("x", 1 << 40, b"x") + bytes(1024),
        "archive_bomb",
    ),
    "a long name of a gigabyte": (
        lambda: header("x", 1 << 30, tarfile.GNUTYPE_LONGNAME) + bytes(1024),
        "archive_bomb",
    ),
    "headers of headers without an end": (
        lambda: header("x", 0, b"x") * 2_100,
        "archive_bomb",
    ),
    "an entry longer than the file": (
        lambda: endless(tarred(PHOTOS)) + header("b.jpg", 1 << 60) + bytes(1024),
        "archive_damaged",
    ),
    "an extended size of many digits": (
        lambda: (
            header("x", 50, b"x") + padded(b"50 size=" + b"9" * 41 + b"\n") + header("a.jpg", 3)
        ),
        "archive_damaged",
    ),
    "an extended header that counts wrong": (
        lambda: header("x", 9, b"x") + padded(b"0 path=a\n") + header("a.jpg", 3) + bytes(512),
        "archive_damaged",
    ),
    "an extended header without a count": (
        lambda: header("x", 600, b"x") + padded(b"a" * 600) + header("a.jpg", 3) + bytes(512),
        "archive_damaged",
    ),
    "a size that is no number": (
        lambda: endless(tarred(PHOTOS)) + resummed(header("b.jpg"), 124, b"12x") + bytes(1024),
        "archive_damaged",
    ),
    "a header of another sum": (
        lambda: endless(tarred(PHOTOS)) + header("b.jpg").replace(b"b.jpg", b"c.jpg"),
        "archive_damaged",
    ),
    "cut off": (lambda: tarred(PHOTOS)[:3000], "archive_damaged"),
    "packed and cut off": (lambda: gzip.compress(tarred(PHOTOS))[:-2000], "archive_damaged"),
    "packed, of another sum": (
        lambda: gzip.compress(tarred(PHOTOS))[:-8] + bytes(8),
        "archive_damaged",
    ),
    "packed, with a name of a megabyte": (
        lambda: b"\x1f\x8b\x08\x08" + bytes(6) + b"a" * (1 << 20),
        "unknown_type",
    ),
    "no pictures": (lambda: tarred({"a.txt": b"words"}), "no_images"),
    "packed, but no tar": (lambda: gzip.compress(picture()), "unknown_type"),
    "empty, packed": (lambda: gzip.compress(b""), "unknown_type"),
    "empty, packed again and again": (lambda: EMPTY * 50_000, "unknown_type"),
    "packed, then nothing, packed again and again": (
        lambda: gzip.compress(tarred(PHOTOS)) + EMPTY * 50_000,
        "archive_bomb",
    ),
    "packed in many pieces of a few bytes": (
        lambda: b"".join(
            gzip.compress(data[n : n + 40])
            for data in [tarred({**PHOTOS, "5.jpg": random.Random(3).randbytes(50_000)})]
            for n in range(0, len(data), 40)
        ),
        "archive_bomb",
    ),
}


def resummed(block: bytes, place: int, value: bytes) -> bytes:
    """A header with other bytes at a place, and the sum that goes with them."""
    changed = bytearray(block)
    changed[place : place + len(value)] = value
    changed[148:156] = b" " * 8
    changed[148:156] = b"%06o\0 " % sum(changed)
    return bytes(changed)


@pytest.mark.parametrize("case", list(HOSTILE))
def test_hostile_and_broken_tars_are_refused_and_leave_nothing(tmp_path: Path, case: str) -> None:
    make, code = HOSTILE[case]
    limits = ArchiveLimits(max_entries=500)
    assert code_of(tmp_path / "c", make(), limits) == code


def test_a_tar_over_the_limits_is_refused(tmp_path: Path) -> None:
    for data in (tarred(PHOTOS), gzip.compress(tarred(PHOTOS))):
        assert code_of(tmp_path / "c", data, ArchiveLimits(max_entries=3)) == "archive_bomb"
        assert code_of(tmp_path / "c", data, ArchiveLimits(max_unpacked_bytes=99)) == "archive_bomb"


def test_the_list_of_entries_is_bounded_before_it_is_in_memory(tmp_path: Path) -> None:
    one = header("x", 1 << 20, b"x") + bytes(1 << 20)
    tracemalloc.start()
    assert code_of(tmp_path / "many", one * 20) == "archive_bomb"
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 60 << 20
    assert code_of(tmp_path / "many", header("a") * 60_000) == "archive_bomb"


@pytest.mark.parametrize("packed", [False, True])
def test_a_closed_tar_holds_no_file(tmp_path: Path, packed: bool) -> None:
    data = tarred(PHOTOS)
    (tmp_path / "c").write_bytes(gzip.compress(data) if packed else data)
    (tmp_path / "cut").write_bytes((tmp_path / "c").read_bytes()[: -2000 if packed else 3000])
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        with CaptureArchive(tmp_path / "c", LIMITS):
            pass
        with pytest.raises(CaptureError):
            CaptureArchive(tmp_path / "cut", LIMITS)
    assert len(os.listdir("/proc/self/fd")) <= before


@pytest.mark.parametrize("packed", [False, True])
def test_tars_damaged_anywhere_are_read_or_refused(tmp_path: Path, packed: bool) -> None:
    data = tarred(nerfstudio_files(4))
    data = gzip.compress(data) if packed else data
    chance = random.Random(6)
    codes = set()
    for _ in range(150):
        changed = bytearray(data)
        for _ in range(chance.choice((1, 1, 20))):
            changed[chance.randrange(0, min(len(changed), 4000))] = chance.randrange(256)
        (tmp_path / "c").write_bytes(changed)
        try:
            codes.add(sniff(tmp_path / "c", "c").kind)
            with CaptureArchive(tmp_path / "c", LIMITS) as archive:
                for name in archive.names:
                    archive.extract(name, tmp_path / "out")
        except CaptureError as error:
            codes.add(error.code)
    assert "archive_damaged" in codes
    assert codes <= {
        *("archive_damaged", "archive_unsafe", "archive_bomb", "unknown_type", "no_images"),
        *("nerfstudio", "images"),
    }
