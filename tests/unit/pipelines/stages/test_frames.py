"""Real clips: the right frames are chosen, upright, with true times, in SDR."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.video_frames import Frame
from pipelines.errors import Cancelled, CaptureError
from pipelines.option_models import StageOptions
from pipelines.options import FramesOptions, IngestOptions
from pipelines.stage import StageContext
from pipelines.stages import frames, ingest
from pipelines.workspace import Workspace
from tests.unit.pipelines.tools.clips import (
    ffmpeg,
    make_clip,
    make_hdr_clip,
    marked_pictures,
    number_in,
    rotated,
    spherical,
)


def context(root: Path, stage: str) -> StageContext:
    workspace = Workspace(root)
    out = workspace.stage(stage)
    out.mkdir(parents=True)
    return StageContext(stage, workspace, out, workspace.checkpoint(stage))


def ingested(tmp_path: Path, clip: Path, options: StageOptions | None = None) -> dict[str, Any]:
    ctx = context(tmp_path / "job", "ingest")
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    clip.rename(ctx.workspace.capture_file)
    return ingest.run(options or IngestOptions(), ctx)  # type: ignore[arg-type]


def chosen(tmp_path: Path, **options: Any) -> tuple[dict[str, Any], list[dict[str, Any]], Path]:
    """The stage's summary, the rows of frames.json, and the stage's folder."""
    ctx = context(tmp_path / "job", "frames")
    summary = frames.run(FramesOptions(**options), ctx)
    rows = json.loads((ctx.out / "frames.json").read_text())["frames"]
    assert len(rows) == summary["num_frames"] == len(list((ctx.out / "images").iterdir()))
    return summary, rows, ctx.out


def test_every_frame_is_used_where_fewer_are_there_than_wanted(tmp_path: Path) -> None:
    ingested(tmp_path, make_clip(tmp_path / "a.mp4"))
    summary, rows, _ = chosen(tmp_path, num_frames=300)
    assert summary["num_frames"] == summary["num_source_frames"] == 60
    assert [row["source_frame_index"] for row in rows] == list(range(60))
    np.testing.assert_allclose([row["timestamp_s"] for row in rows], np.arange(60) / 30, atol=1e-4)


@pytest.mark.parametrize("container", ["mp4", "mkv", "avi"])
def test_sharp_frames_win_and_are_the_ones_they_are_said_to_be(
    tmp_path: Path, container: str
) -> None:
    sharp = {3, 11, 17, 29, 33, 46, 52, 58}  # one in each eighth of 64 frames
    marked_pictures(tmp_path / "p", 64, blurred=set(range(64)) - sharp)
    clip = tmp_path / f"a.{container}"
    ffmpeg("-framerate", "20", "-i", tmp_path / "p" / "%04d.png", "-pix_fmt", "yuv420p", clip)
    ingested(tmp_path, clip)
    _, rows, out = chosen(tmp_path, num_frames=8, candidates_per_frame=60)
    assert [row["source_frame_index"] for row in rows] == sorted(sharp)
    assert [number_in(out / row["file"]) for row in rows] == sorted(sharp)
    times = [row["timestamp_s"] for row in rows]
    np.testing.assert_allclose(times, np.array(sorted(sharp)) / 20, atol=0.5 / 20)


def test_candidates_are_limited_and_even(tmp_path: Path) -> None:
    ingested(tmp_path, make_clip(tmp_path / "a.mp4", "testsrc2=s=320x180:r=60:d=4"))
    summary, rows, _ = chosen(tmp_path, num_frames=10, candidates_per_frame=3, max_step=0)
    assert (summary["num_candidates"], summary["num_source_frames"]) == (30, 240)
    windows = [int(row["timestamp_s"] / 0.4) for row in rows]
    assert windows == list(range(10))


def test_frames_that_a_trim_hides_are_not_counted(tmp_path: Path) -> None:
    """Cut without decoding, the file begins at a key frame, and its edit list later."""
    whole = tmp_path / "whole.mp4"
    ffmpeg(
        "-f", "lavfi", "-i", "testsrc2=s=320x180:r=30:d=8", "-g", "240",
        "-pix_fmt", "yuv420p", whole,
    )  # fmt: skip
    clip = tmp_path / "a.mp4"
    ffmpeg("-ss", "5.5", "-t", "2", "-i", whole, "-c", "copy", clip)
    summary = ingested(tmp_path, clip)
    assert summary["start_s"] == pytest.approx(0.0, abs=0.05)
    # What moves in this pattern would be cut out of the rest, which stands still.
    options = {"max_step": 0, "find_burned_in": False}
    summary, rows, _ = chosen(tmp_path, num_frames=20, **options)
    assert summary["warnings"] == []
    times = np.asarray([row["timestamp_s"] for row in rows])
    assert times.min() >= 0.0
    assert times.max() <= 2.1
    assert np.diff(times).max() < 0.21, "one in each twentieth of it"


def test_variable_frame_rate_is_chosen_by_time(tmp_path: Path) -> None:
    """The first second has 10 frames, the second one 50."""
    marked_pictures(tmp_path / "p", 60, blurred=set())
    times = np.concatenate([np.arange(10) / 10, 1 + np.arange(50) / 50])
    clip = tmp_path / "a.mkv"
    clock = "settb=1/1000,setpts='if(lt(N,10),N*100,1000+(N-10)*20)'"
    ffmpeg(
        "-framerate", "50", "-i", tmp_path / "p" / "%04d.png", "-vf", clock,
        "-fps_mode", "passthrough", "-enc_time_base", "1:1000", "-pix_fmt", "yuv420p", clip,
    )  # fmt: skip
    summary = ingested(tmp_path, clip)
    assert summary["variable_frame_rate"]
    _, rows, out = chosen(tmp_path, num_frames=8)
    length = summary["duration_s"] / 8
    assert [int(row["timestamp_s"] / length) for row in rows] == list(range(8))
    for row in rows:
        number = number_in(out / row["file"])
        assert number == row["source_frame_index"]
        assert row["timestamp_s"] == pytest.approx(times[number], abs=0.01)


@pytest.mark.parametrize("candidates", [3, 60], ids=["some", "all"])
@pytest.mark.parametrize(("first_late", "by_s"), [(30, 600), (58, 900), (58, 3000)])
def test_a_pause_takes_no_frames_from_the_rest(
    tmp_path: Path, first_late: int, by_s: int, candidates: int
) -> None:
    """A recording that stood still for minutes, or a last time stamp far off: 60 frames, 20 wanted
    of them."""
    marked_pictures(tmp_path / "p", 60, blurred=set())
    clip = tmp_path / "a.mkv"
    clock = f"settb=1/1000,setpts='N*50+if(lt(N,{first_late}),0,{by_s}000)'"
    ffmpeg(
        "-framerate", "50", "-i", tmp_path / "p" / "%04d.png", "-vf", clock,
        "-fps_mode", "passthrough", "-enc_time_base", "1:1000", "-pix_fmt", "yuv420p", clip,
    )  # fmt: skip
    told = "\n".join(ingested(tmp_path, clip)["warnings"])
    assert f"a pause of {by_s} s without pictures" in told
    _, rows, out = chosen(tmp_path, num_frames=20, max_step=0.0, candidates_per_frame=candidates)
    assert len(rows) == 20
    numbers = [row["source_frame_index"] for row in rows]
    assert [number // 3 for number in numbers] == pytest.approx(range(20), abs=1)
    for row, number in zip(rows, numbers, strict=True):
        assert number == number_in(out / row["file"])
        late_s = by_s if number >= first_late else 0
        assert row["timestamp_s"] == pytest.approx(number * 0.05 + late_s, abs=0.01)


@pytest.mark.parametrize(("degrees", "corner"), [(90, (0, -1)), (180, (-1, -1)), (270, (-1, 0))])
def test_frames_are_upright(tmp_path: Path, degrees: int, corner: tuple[int, int]) -> None:
    """A white mark in the stored top left corner lies where a player would show it."""
    source = "color=black:s=320x180:r=30:d=0.5,drawbox=0:0:60:60:white:fill"
    clip = rotated(make_clip(tmp_path / "a.mp4", source), tmp_path / "r.mp4", degrees)
    ingested(tmp_path, clip)
    summary, rows, out = chosen(tmp_path, long_side_px=160)
    size = (160, 90) if degrees == 180 else (90, 160)
    assert (summary["width"], summary["height"]) == size
    with PIL.Image.open(out / rows[0]["file"]) as image:
        assert image.size == size
        pixels = np.asarray(image.convert("L"))
    marks = {
        (r, c): int(pixels[5 * r + min(r, 0) * -4, 5 * c + min(c, 0) * -4])
        for r in (0, -1)
        for c in (0, -1)
    }
    assert max(marks, key=lambda where: marks[where]) == corner
    assert sorted(marks.values())[2] < 40


def test_a_clip_turned_by_half_a_right_angle_keeps_its_times(tmp_path: Path) -> None:
    """ffmpeg complains of such an angle in a message without an end of line."""
    clip = make_clip(tmp_path / "a.mp4")
    ingested(tmp_path, rotated(clip, tmp_path / "r.mp4", 45))
    _, rows, _ = chosen(tmp_path, num_frames=20)
    assert len(rows) == 20
    indices = np.array([row["source_frame_index"] for row in rows])
    np.testing.assert_allclose([row["timestamp_s"] for row in rows], indices / 30, atol=1e-4)


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_avi_that_names_no_times_has_those_of_its_order(tmp_path: Path, codec: str) -> None:
    """With frames stored out of order AVI says only how many there are in a second."""
    clip = make_clip(tmp_path / "a.avi", "testsrc2=s=320x180:r=30:d=2", "-c:v", codec, "-bf", "2")
    summary = ingested(tmp_path, clip)
    assert summary["duration_s"] == pytest.approx(2.0, abs=1e-3)
    assert summary["start_s"] == 0.0
    _, rows, _ = chosen(tmp_path, num_frames=10)
    times = np.array([row["timestamp_s"] for row in rows])
    assert len(rows) == 10
    np.testing.assert_allclose(np.diff(times), 0.2, atol=0.2)
    assert (np.diff(times) > 0).all()


@pytest.mark.parametrize("kind", ["hlg", "pq"])
def test_hdr_clips_are_upright_and_need_only_their_transfer_named(
    tmp_path: Path, kind: str
) -> None:
    """Blue of (48, 96, 192) is darker, since what is brighter than white has its room above."""
    colors = []
    for only_transfer in (False, True):
        folder = tmp_path / str(only_transfer)
        folder.mkdir()
        clip = make_hdr_clip(folder / "a.mov", kind, only_transfer=only_transfer)
        clip = rotated(clip, folder / "r.mov", 90)
        assert ingested(folder, clip)["hdr"] == kind
        summary, rows, out = chosen(folder)
        assert (summary["tone_mapped"], summary["width"], summary["height"]) == (True, 180, 320)
        with PIL.Image.open(out / rows[0]["file"]) as image:
            colors.append(np.asarray(image)[160, 90].astype(int))
    assert np.abs(colors[0] - colors[1]).max() <= 1, colors
    assert (np.abs(colors[0] - [48, 96, 192]) < [16, 8, 32]).all(), colors


def test_sdr_colours_are_kept(tmp_path: Path) -> None:
    clip = tmp_path / "a.mp4"
    ffmpeg(
        "-f", "lavfi", "-i", "color=c=0x3060c0:s=320x180:r=30:d=0.5,format=gbrp",
        "-vf", "scale=out_color_matrix=bt709:out_range=limited,format=yuv420p",
        "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709",
        "-color_range", "tv", clip,
    )  # fmt: skip
    ingested(tmp_path, clip)
    _, rows, out = chosen(tmp_path)
    with PIL.Image.open(out / rows[0]["file"]) as image:
        color = np.asarray(image)[90, 160].astype(int)
    assert np.abs(color - [0x30, 0x60, 0xC0]).max() < 5, color


@pytest.mark.parametrize(
    ("size", "matrix"), [("1280x720", "bt709"), ("720x1280", "bt709"), ("640x480", "bt601")]
)
def test_clips_that_name_no_matrix_have_that_of_their_size(
    tmp_path: Path, size: str, matrix: str
) -> None:
    """BT.709 for HD, BT.601 below, as players do; the wrong one turns 255 of red into 233."""
    clip = tmp_path / "a.mp4"
    ffmpeg(
        "-f", "lavfi", "-i", f"color=c=red:s={size}:r=30:d=0.4,format=gbrp",
        "-vf", f"scale=out_color_matrix={matrix}:out_range=limited,format=yuv420p,"
        "setparams=colorspace=unknown:color_primaries=unknown:color_trc=unknown", clip,
    )  # fmt: skip
    ingested(tmp_path, clip)
    record = json.loads((tmp_path / "job" / "ingest" / "capture.json").read_text())
    assert not {"bt709", "smpte170m"} & set(record["video"]["color"].split(", "))
    _, rows, out = chosen(tmp_path)
    with PIL.Image.open(out / rows[0]["file"]) as image:
        color = np.asarray(image)[90, 160].astype(int)
    assert np.abs(color - [255, 0, 0]).max() < 5, color


def test_a_video_that_says_it_is_spherical_gives_panoramas_and_their_views(tmp_path: Path) -> None:
    clip = spherical(make_clip(tmp_path / "a.mp4", "testsrc2=s=640x320:r=30:d=0.5"))
    summary = ingested(tmp_path, clip, IngestOptions(panorama_views=6))
    assert summary["projection"] == "equirectangular"
    ctx = context(tmp_path / "job", "frames")
    summary = frames.run(FramesOptions(num_frames=16, long_side_px=160), ctx)
    assert (summary["num_frames"], summary["width"], summary["height"]) == (8, 320, 160)
    rows = json.loads((ctx.out / "frames.json").read_text())["frames"]
    assert [row["file"] for row in rows[:2]] == [f"panoramas/frame_0000{n}.jpg" for n in (1, 2)]
    assert rows[7]["views"] == [f"images/frame_00008_{n}.jpg" for n in range(1, 7)]
    assert len(list((ctx.out / "images").iterdir())) == 48
    assert len(list((ctx.out / "panoramas").iterdir())) == 8


@pytest.mark.parametrize("size", ["640x640", "640x360"])
def test_what_is_no_whole_sphere_for_one_eye_is_refused(tmp_path: Path, size: str) -> None:
    clip = spherical(make_clip(tmp_path / "a.mp4", f"testsrc2=s={size}:r=30:d=0.5"))
    with pytest.raises(CaptureError, match="twice as wide as high") as caught:
        ingested(tmp_path, clip)
    assert caught.value.code == "projection_unsupported"
    assert "ingest.projection" in caught.value.hint


def test_the_option_overrules_what_a_video_says_of_its_projection(tmp_path: Path) -> None:
    for name, make, wanted, found in (
        ("flat", spherical, "flat", ""),
        ("told", lambda clip: clip, "equirectangular", "equirectangular"),
        ("plain", lambda clip: clip, "auto", ""),
    ):
        folder = tmp_path / name
        folder.mkdir()
        clip = make(make_clip(folder / "a.mp4", "testsrc2=s=640x320:r=30:d=0.5"))
        summary = ingested(folder, clip, IngestOptions.model_validate({"projection": wanted}))
        assert summary["projection"] == found


@pytest.mark.parametrize(("size", "warned"), [("2048x1024", True), ("1920x1080", False)])
def test_a_video_twice_as_wide_as_high_is_warned_of(
    tmp_path: Path, size: str, warned: bool
) -> None:
    clip = make_clip(tmp_path / "a.mp4", f"color=c=gray:s={size}:r=30:d=0.4")
    summary = ingested(tmp_path, clip)
    assert any("360-degree" in warning for warning in summary["warnings"]) is warned


def test_odd_sizes_are_written_whole(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "a.mp4", "testsrc2=s=322x182:r=30:d=0.5")
    ingested(tmp_path, clip)
    summary, rows, out = chosen(tmp_path, long_side_px=161)
    assert (summary["width"], summary["height"]) == (161, 91)
    with PIL.Image.open(out / rows[-1]["file"]) as image:
        assert image.size == (161, 91)


def test_sharpness_falls_with_blur() -> None:
    fine = np.random.default_rng(0).integers(0, 255, (180, 320), np.uint8)
    soft = np.asarray(
        PIL.Image.fromarray(fine).resize((80, 45), PIL.Image.Resampling.BOX).resize((320, 180))
    )
    gray = np.full((90, 160), 128, np.uint8)
    scores = [Frame(0, 0.0, luma, (gray, gray)).sharpness() for luma in (fine, soft, gray)]
    assert scores[0] > 10 * scores[1] > 0
    assert scores[2] == 0.0


def test_progress_rises_and_tells_the_time_left(tmp_path: Path) -> None:
    ingested(tmp_path, make_clip(tmp_path / "a.mp4"))
    ctx = context(tmp_path / "job", "frames")
    seen: list[tuple[float, float | None]] = []
    ctx.on_progress = lambda fraction, message, eta_s: seen.append((fraction, eta_s))
    frames.run(FramesOptions(), ctx)
    assert [fraction for fraction, _ in seen] == sorted(fraction for fraction, _ in seen)
    assert seen[-1][0] == 1.0
    assert any(eta_s is not None for _, eta_s in seen)


def test_cancel_stops_the_decoding(tmp_path: Path) -> None:
    ingested(tmp_path, make_clip(tmp_path / "a.mp4"))
    ctx = context(tmp_path / "job", "frames")
    ctx.is_cancelled = lambda: (ctx.out / "images" / "frame_00005.jpg").exists()
    with pytest.raises(Cancelled):
        frames.run(FramesOptions(), ctx)
    assert not (ctx.out / "images" / "frame_00010.jpg").exists()


@pytest.mark.parametrize(
    ("container", "options"), [("mp4", ["-movflags", "faststart"]), ("mkv", [])]
)
def test_of_a_video_that_is_cut_off_what_is_there_is_used(
    tmp_path: Path, container: str, options: list[str]
) -> None:
    clip = make_clip(tmp_path / f"a.{container}", "testsrc2=s=320x180:r=30:d=4", *options)
    clip.write_bytes(clip.read_bytes()[: clip.stat().st_size * 2 // 3])
    warning = ingested(tmp_path, clip)["warnings"][0]
    assert "The video is cut off: its first 2." in warning
    assert re.search(r" of 4\.0 s \((6|7). %\) are there", warning)
    summary, rows, _ = chosen(tmp_path, num_frames=20)
    assert summary["num_frames"] >= 18
    assert 2.0 < rows[-1]["timestamp_s"] < 3.0


def test_a_video_of_which_next_to_nothing_is_there_is_refused(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "a.mkv", "testsrc2=s=320x180:r=30:d=4")
    clip.write_bytes(clip.read_bytes()[: clip.stat().st_size // 40])
    with pytest.raises(CaptureError, match="cut off") as caught:
        ingested(tmp_path, clip)
    assert caught.value.code == "video_truncated"


def test_video_longer_than_allowed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="2 s long; 1 s") as caught:
        ingested(tmp_path, make_clip(tmp_path / "a.mp4"), IngestOptions(max_duration_s=1.0))
    assert caught.value.code == "video_too_long"


def test_video_whose_pictures_are_garbage_is_undecodable(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "a.mp4")
    data = bytearray(clip.read_bytes())
    start = data.index(b"mdat") + 4
    end = data.index(b"moov") - 4
    data[start:end] = np.random.default_rng(0).bytes(end - start)
    clip.write_bytes(data)
    with pytest.raises(CaptureError) as caught:
        ingested(tmp_path, clip)
    assert caught.value.code == "video_undecodable"


def test_video_of_two_frames_is_too_short(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "a.mp4", "testsrc2=s=320x180:r=30:d=1", "-frames:v", "2")
    with pytest.raises(CaptureError) as caught:
        ingested(tmp_path, clip)
    assert caught.value.code == "too_few_images"


def panned(tmp_path: Path, speeds: Sequence[float]) -> Path:
    """A clip of 30 frames a second that pans over a wall at each second's speed, in long sides."""
    wall = np.random.default_rng(1).integers(40, 220, (45, 1200), np.uint8)
    wide = np.asarray(PIL.Image.fromarray(wall).resize((4800, 180), PIL.Image.Resampling.BICUBIC))
    (tmp_path / "wall").mkdir()
    at = 0.0
    for n in range(30 * len(speeds)):
        PIL.Image.fromarray(wide[:, round(at) :][:, :320]).save(tmp_path / f"wall/{n:04d}.png")
        at += speeds[n // 30] * 320 / 30
    clip = tmp_path / "a.mp4"
    ffmpeg("-framerate", "30", "-i", tmp_path / "wall/%04d.png", "-pix_fmt", "yuv420p", clip)
    return clip


def per_second(rows: list[dict[str, Any]]) -> list[int]:
    return np.bincount([int(row["timestamp_s"]) for row in rows]).tolist()


def test_more_frames_are_taken_where_the_picture_moves_far(tmp_path: Path) -> None:
    """Eight frames a second; at a speed of 1.5 the picture moves by 0.19 from one to the next."""
    ingested(tmp_path, panned(tmp_path, (0.2, 0.2, 1.5, 0.2)))
    _, rows, _ = chosen(tmp_path, num_frames=32)
    assert per_second(rows) == [8, 8, 16, 8]
    times = np.array([row["timestamp_s"] for row in rows])
    assert (np.diff(times) > 0).all()
    fast = times[(times >= 2) & (times < 3)]
    assert np.diff(fast).max() < 0.14, "each half of a window gives one"


def test_twice_as_many_frames_are_taken_at_most(tmp_path: Path) -> None:
    """Slow windows leave something for quick ones, of which each gives three at most."""
    ingested(tmp_path, panned(tmp_path, (3.0, 3.0, 0.2, 3.0)))
    summary, rows, _ = chosen(tmp_path, num_frames=32)
    assert per_second(rows) == pytest.approx([16, 16, 8, 24], abs=1)
    assert summary["num_frames"] == 64


def test_even_times_can_be_had(tmp_path: Path) -> None:
    ingested(tmp_path, panned(tmp_path, (0.2, 3.0)))
    _, rows, _ = chosen(tmp_path, num_frames=16, max_step=0)
    assert per_second(rows) == [8, 8]


def test_a_quick_clip_gives_all_it_has_and_none_twice(tmp_path: Path) -> None:
    ingested(tmp_path, panned(tmp_path, (4.0, 4.0)))
    _, rows, _ = chosen(tmp_path, num_frames=48)
    indices = [row["source_frame_index"] for row in rows]
    assert indices == sorted(set(indices))
    assert len(rows) == 60


def test_a_capture_that_an_earlier_version_took_in_has_its_first_stream(tmp_path: Path) -> None:
    ingested(tmp_path, make_clip(tmp_path / "a.mp4"))
    record = tmp_path / "job" / "ingest" / "capture.json"
    taken = json.loads(record.read_text())
    for clip in taken["clips"]:
        del clip["video"]["stream"], clip["pauses"]
    record.write_text(json.dumps(taken))
    summary, _, _ = chosen(tmp_path)
    assert summary["num_frames"] > 8
