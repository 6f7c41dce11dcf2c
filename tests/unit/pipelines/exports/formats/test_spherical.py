"""Videos that say that they are all round: ffmpeg reads it, and every picture is still found."""

from __future__ import annotations

import struct
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from pipelines.exports.formats.mp4 import VideoWriter
from pipelines.exports.formats.spherical import mark_equirectangular
from pipelines.tools.ffmpeg import probe

WIDTH, HEIGHT, FRAMES = 128, 64, 40


def record(path: Path, codec: str, *, marked: bool) -> None:
    noise = np.random.default_rng(0)
    with VideoWriter(path, WIDTH, HEIGHT, 24.0, 10, codec, equirectangular=marked) as writer:
        for _ in range(FRAMES):
            writer.write(noise.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))


def pictures(path: Path) -> np.ndarray:
    reader = imageio_ffmpeg.read_frames(str(path))
    assert next(reader)["size"] == (WIDTH, HEIGHT)
    return np.stack([np.frombuffer(data, np.uint8) for data in reader])


@pytest.mark.parametrize("codec", ["h264", "hevc", "av1"])
def test_ffmpeg_reads_the_projection_and_the_same_pictures(tmp_path: Path, codec: str) -> None:
    plain, marked = tmp_path / "plain.mp4", tmp_path / "marked.mp4"
    record(plain, codec, marked=False)
    record(marked, codec, marked=True)
    assert (probe(plain).projection, probe(marked).projection) == ("", "equirectangular")
    data = marked.read_bytes()
    assert data.index(b"moov") < data.index(b"st3d") < data.index(b"sv3d") < data.index(b"mdat")
    assert data.count(b"<GSpherical:ProjectionType>equirectangular<") == 1
    assert len(pictures(marked)) == FRAMES
    np.testing.assert_array_equal(pictures(marked), pictures(plain))
    assert {file.name for file in tmp_path.iterdir()} == {"plain.mp4", "marked.mp4"}


def test_boxes_are_as_long_as_they_say(tmp_path: Path) -> None:
    """ffmpeg forgives wrong sizes, players may not."""
    path = tmp_path / "video.mp4"
    record(path, "h264", marked=True)
    found = []

    def walk(content: bytes, where: tuple[str, ...]) -> None:
        start = 0
        while start < len(content):
            size, kind = struct.unpack_from(">I4s", content, start)
            assert size >= 8, where
            assert start + size <= len(content), where
            here = (*where, kind.decode())
            found.append("/".join(here))
            held = content[start + 8 : start + size]
            if kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"sv3d", b"proj"):
                walk(held, here)
            elif kind in (b"stsd", b"avc1"):
                walk(held[8 if kind == b"stsd" else 78 :], here)
            start += size
        assert start == len(content), where

    walk(path.read_bytes(), ())
    entry = "moov/trak/mdia/minf/stbl/stsd/avc1"
    for box in ("st3d", "sv3d/svhd", "sv3d/proj/prhd", "sv3d/proj/equi"):
        assert found.count(f"{entry}/{box}") == 1
    assert found.index(f"{entry}/avcC") < found.index(f"{entry}/st3d")
    assert found.index(f"{entry}/st3d") < found.index(f"{entry}/sv3d")
    assert found.count("moov/trak/uuid") == 1


@pytest.mark.parametrize("content", [b"", b"not a video at all", struct.pack(">I4s", 99, b"moov")])
def test_what_is_no_video_is_refused_and_stays_as_it_is(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"video\.mp4|box"):
        mark_equirectangular(path)
    assert path.read_bytes() == content
