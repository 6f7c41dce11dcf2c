"""ffmpeg is found, understood in several releases' words, and kept to the one file it is given."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pipelines.errors import CaptureError, ToolError
from pipelines.tools.ffmpeg import (
    compile_command,
    ffmpeg_executable,
    has_filter,
    parse_probe,
    probe,
    run_ffmpeg,
    untrusted_input,
)
from pipelines.tools.process import run_program
from tests.unit.pipelines.tools.clips import ffmpeg, make_clip, make_hdr_clip, rotated

# What `ffmpeg -i` says of a phone's clip, shortened: releases 5.1, 6.1 and 9.0 differ in the
# stream's id, in the field order and in how they name the display matrix.
# ruff: noqa: E501
PHONE_5 = """\
Input #0, mov,mp4,m4a,3gp,3g2,mj2, from 'x':
  Metadata:
    title           : Duration: 09:00:00.00
  Duration: 00:01:02.50, start: 0.000000, bitrate: 9000 kb/s
  Stream #0:0[0x1](und): Audio: aac (LC) (mp4a / 0x6134706D), 44100 Hz, stereo, fltp (default)
  Stream #0:1[0x2](und): Video: hevc (Main 10) (hvc1 / 0x31637668), yuv420p10le(tv, bt2020nc/bt2020/arib-std-b67), 3840x2160, 8900 kb/s, 29.98 fps, 30 tbr, 600 tbn (default)
    Metadata:
      handler_name    : Core Media Video
    Side data:
      DOVI configuration record: version: 1.0, profile: 8, level: 5, rpu flag: 1, el flag: 0, bl flag: 1, compatibility id: 4
      displaymatrix: rotation of -90.00 degrees
  Stream #0:2[0x3](und): Data: none (mebx / 0x7862656D), 0 kb/s (default)
At least one output file must be specified"""
PHONE_6 = """\
Input #0, matroska,webm, from 'x':
  Duration: N/A, start: 0.000000, bitrate: N/A
  Stream #0:0: Video: vp9 (Profile 0), yuv420p(tv, progressive), 640x480, SAR 4:3 DAR 16:9, 1k fps, 1k tbr, 1k tbn (default)
    Side data:
      displaymatrix: rotation of 180.00 degrees
At least one output file must be specified"""
PHONE_9 = """\
Input #0, mov,mp4,m4a,3gp,3g2,mj2, from 'x':
  Duration: 00:00:02.00, start: 0.000000, bitrate: 188 kb/s
  Stream #0:0[0x1]: Video: mjpeg (Baseline), yuvj420p(pc, bt470bg/unknown/unknown), 100x100, 90k tbr, 90k tbn (attached pic)
  Stream #0:1[0x2](und): Video: hevc (Main 10) (hvc1 / 0x31637668), yuv420p10le(tv, bt2020nc/bt2020/smpte2084, progressive), 320x180 [SAR 1:1 DAR 16:9], 173 kb/s, 30 fps, 30 tbr, 15360 tbn (default)
    Side data:
      Display Matrix: rotation of 90.00 degrees
At least one output file must be specified"""


def test_probe_reads_the_words_of_release_5() -> None:
    info = parse_probe("mov", PHONE_5.splitlines())
    assert (info.codec, info.width, info.height, info.rotation_deg) == ("hevc", 2160, 3840, 90)
    assert (info.fps, info.duration_s, info.hdr, info.pix_fmt) == (
        29.98,
        62.5,
        "hlg",
        "yuv420p10le",
    )


def test_probe_reads_the_words_of_release_6() -> None:
    info = parse_probe("matroska", PHONE_6.splitlines())
    assert (info.width, info.height, info.rotation_deg) == (853, 480, 180)
    assert (info.fps, info.duration_s, info.hdr) == (1000.0, None, "none")


def test_probe_reads_the_words_of_release_9_and_skips_cover_pictures() -> None:
    info = parse_probe("mov", PHONE_9.splitlines())
    assert (info.width, info.height, info.rotation_deg, info.hdr) == (180, 320, 270, "pq")


def test_the_film_is_the_largest_stream_not_a_preview_before_it(tmp_path: Path) -> None:
    small = make_clip(tmp_path / "small.mp4", "testsrc=s=160x90:r=15:d=1")
    film = make_clip(tmp_path / "film.mp4", "testsrc2=s=320x180:r=30:d=2")
    both = tmp_path / "both.mp4"
    ffmpeg("-i", small, "-i", film, "-map", "0:v", "-map", "1:v", "-c", "copy", both)
    info = probe(both)
    assert (info.width, info.height, info.stream) == (320, 180, "0:1")
    ffmpeg("-i", film, "-i", film, "-map", "0:v", "-map", "1:v", "-c", "copy", both)
    assert probe(both).stream == "0:0"  # of several as large the first


def test_a_few_large_stills_beside_a_film_are_not_the_film(tmp_path: Path) -> None:
    """Phones keep such with a moving photo."""
    film = make_clip(tmp_path / "film.mp4", "testsrc2=s=320x180:r=30:d=2")
    stills = make_clip(tmp_path / "stills.mp4", "testsrc=s=640x480:r=3:d=1")
    both = tmp_path / "both.mp4"
    ffmpeg("-i", film, "-i", stills, "-map", "0:v", "-map", "1:v", "-c", "copy", both)
    info = probe(both)
    assert (info.width, info.height, info.stream) == (320, 180, "0:0")


def test_a_larger_cover_picture_is_not_the_film() -> None:
    large = PHONE_9.replace("100x100", "3000x3000")
    info = parse_probe("mov", large.splitlines())
    assert (info.width, info.height, info.stream) == (180, 320, "0:1")


def test_dolby_vision_without_a_base_layer_is_told() -> None:
    plain = PHONE_5.replace("arib-std-b67", "unknown").replace("profile: 8", "profile: 5")
    assert parse_probe("mov", plain.splitlines()).hdr == "dolby"


@pytest.mark.parametrize(
    ("pixels", "size", "matrix"),
    [
        ("yuv420p(progressive)", "1920x1080", "bt709"),
        ("yuv420p(tv, unknown/bt709/bt709, progressive)", "1280x720", "bt709"),
        ("yuv420p", "1280x544", "bt709"),
        ("yuv420p", "480x854", "smpte170m"),
        ("yuv420p(tv, bt709, progressive)", "640x480", None),
        ("yuv420p(tv, smpte170m)", "1920x1080", None),
        ("yuvj420p(pc, bt470bg/unknown/unknown)", "1920x1080", None),
        ("gbrp(pc, gbr/bt709/bt709)", "1920x1080", None),
        ("bgr24", "1920x1080", None),
    ],
)
def test_matrix_is_assumed_where_none_is_named(pixels: str, size: str, matrix: str | None) -> None:
    lines = PHONE_6.replace("yuv420p(tv, progressive), 640x480", f"{pixels}, {size}").splitlines()
    assert parse_probe("matroska", lines).matrix == matrix


@pytest.mark.parametrize(
    ("words", "projection"),
    [
        ("spherical: equirectangular (0.000000/0.000000/0.000000)", "equirectangular"),
        ("Spherical Mapping: half equirectangular (0/0/0)", "half equirectangular"),
        ("spherical: cubemap [pad 0] (0/0/0)", "cubemap"),
        ("Spherical Mapping: rectilinear (0/0/0)", ""),
        ("Stereo 3D: side by side", ""),
    ],
)
def test_projection_is_read_in_the_words_of_all_releases(words: str, projection: str) -> None:
    lines = PHONE_6.replace("displaymatrix: rotation of 180.00 degrees", words).splitlines()
    assert parse_probe("matroska", lines).projection == projection


@pytest.mark.parametrize(
    ("degrees", "size"), [(0, (320, 180)), (90, (180, 320)), (180, (320, 180))]
)
def test_probe_of_a_real_clip_gives_the_upright_size(
    tmp_path: Path, degrees: int, size: tuple[int, int]
) -> None:
    clip = rotated(make_clip(tmp_path / "a.mp4"), tmp_path / "r.mp4", degrees)
    info = probe(clip)
    assert (info.width, info.height) == size
    assert (info.rotation_deg, info.codec, info.container) == (degrees, "h264", "mov")
    assert (info.fps, info.duration_s) == (30.0, pytest.approx(2.0, abs=0.05))


@pytest.mark.parametrize("kind", ["hlg", "pq"])
def test_probe_of_a_real_hdr_clip(tmp_path: Path, kind: str) -> None:
    assert probe(make_hdr_clip(tmp_path / "a.mov", kind)).hdr == kind


def test_file_without_pictures_has_no_video_stream(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    ffmpeg("-f", "lavfi", "-i", "sine=d=1", "-c:a", "aac", path)
    with pytest.raises(CaptureError) as caught:
        probe(path)
    assert caught.value.code == "no_video_stream"


def test_clip_without_its_index_is_cut_off(tmp_path: Path) -> None:
    path = make_clip(tmp_path / "a.mp4")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CaptureError) as caught:
        probe(path)
    assert caught.value.code == "video_truncated"


def test_playlist_is_refused_before_ffmpeg_sees_it(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    path.write_text(
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n"
    )
    with pytest.raises(CaptureError) as caught:
        probe(path)
    assert caught.value.code == "unknown_type"


def test_ffmpeg_itself_refuses_a_playlist_under_our_options(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "a.mp4")
    playlist = tmp_path / "list.m3u8"
    playlist.write_text(
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{clip}\n#EXT-X-ENDLIST\n"
    )
    argv = compile_command(untrusted_input(clip).output("-", f="null"))
    forced = argv.index("-f")
    del argv[forced : forced + 2]  # leaves the white lists alone to stop it
    argv[argv.index("-i") + 1] = str(playlist)
    with pytest.raises(ToolError) as caught:
        run_program(argv)
    assert any("whitelist" in line.lower() for line in caught.value.details["log"])


def test_file_name_cannot_pose_as_an_option_or_an_address(tmp_path: Path) -> None:
    for name in ("-y.mp4", "concat:a|b.mp4", "%03d.mp4"):
        path = make_clip(tmp_path / "clip.mp4").rename(tmp_path / name)
        run_ffmpeg(untrusted_input(path).output("-", f="null"))


def test_environment_names_the_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFWORKS_FFMPEG", sys.executable)
    assert ffmpeg_executable() == sys.executable
    monkeypatch.setenv("NERFWORKS_FFMPEG", "/no/such/ffmpeg")
    with pytest.raises(ToolError) as caught:
        ffmpeg_executable()
    assert caught.value.code == "tool_missing"


def test_filters_of_the_build_are_known() -> None:
    assert has_filter("showinfo")
    assert not has_filter("no_such_filter")
