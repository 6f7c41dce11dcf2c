"""Several clips in one capture: each is checked, gives its share, and keeps its own times."""

from __future__ import annotations

import json
import zipfile
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.clips import Clip
from pipelines.captures.sniff import sniff
from pipelines.errors import CaptureError
from pipelines.options import FramesOptions, IngestOptions
from pipelines.stage import StageContext
from pipelines.stages import frames, ingest
from pipelines.stages.frames import shared_frames
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.archives import picture
from tests.unit.pipelines.tools.clips import ffmpeg, make_clip, marked_pictures, number_in, rotated


def context(root: Path, stage: str) -> StageContext:
    workspace = Workspace(root)
    out = workspace.stage(stage)
    out.mkdir(parents=True)
    return StageContext(stage, workspace, out, workspace.checkpoint(stage))


def ingested(
    root: Path, files: dict[str, Path | bytes], options: IngestOptions | None = None
) -> dict[str, Any]:
    """The summary of an archive that holds these files."""
    ctx = context(root, "ingest")
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    with zipfile.ZipFile(ctx.workspace.capture_file, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content.read_bytes() if isinstance(content, Path) else content)
    return ingest.run(options or IngestOptions(), ctx)


def chosen(root: Path, **options: Any) -> tuple[dict[str, Any], dict[str, Any], Path]:
    """The summary, frames.json, and the stage's folder."""
    ctx = context(root, "frames")
    summary = frames.run(FramesOptions(**options), ctx)
    assert sorted(path.name for path in ctx.out.iterdir()) == ["frames.json", "images"]
    return summary, json.loads((ctx.out / "frames.json").read_text()), ctx.out


def numbered_clip(folder: Path, name: str, first: int, count: int, rate: int) -> Path:
    """A clip whose frames show the numbers from `first` on."""
    marked_pictures(folder / f"{name}-p", first + count, blurred=set())
    clip = folder / f"{name}.mp4"
    ffmpeg(
        "-framerate", str(rate), "-start_number", str(first),
        "-i", folder / f"{name}-p" / "%04d.png", "-pix_fmt", "yuv420p", clip,
    )  # fmt: skip
    return clip


def test_each_clip_gives_frames_by_its_length_with_times_that_run_on(tmp_path: Path) -> None:
    first = numbered_clip(tmp_path, "first", 0, 60, 20)  # 3 s
    second = numbered_clip(tmp_path, "second", 100, 60, 10)  # 6 s
    summary = ingested(tmp_path / "job", {"b/clip 10.mp4": second, "b/clip 2.mp4": first})
    assert (summary["kind"], summary["num_clips"]) == ("videos", 2)
    assert summary["duration_s"] == pytest.approx(9.0, abs=0.2)
    assert [clip["name"] for clip in summary["clips"]] == ["b/clip 2.mp4", "b/clip 10.mp4"]
    _, listed, out = chosen(tmp_path / "job", num_frames=30)
    rows, clips = listed["frames"], listed["clips"]
    assert [clip["num_frames"] for clip in clips] == [10, 20]
    assert [row["clip"] for row in rows] == [0] * 10 + [1] * 20
    assert (np.diff([row["timestamp_s"] for row in rows]) > 0).all()
    for row in rows:
        clip = clips[row["clip"]]
        number = number_in(out / row["file"])
        assert number == row["source_frame_index"] + (0, 100)[row["clip"]]
        own_s = row["timestamp_s"] - clip["offset_s"]
        assert own_s == pytest.approx(row["source_frame_index"] / (20, 10)[row["clip"]], abs=1e-3)


def test_clips_may_lie_any_way_and_be_of_any_size(tmp_path: Path) -> None:
    wide = make_clip(tmp_path / "a.mp4", "testsrc2=s=320x180:r=30:d=1")
    upright = rotated(make_clip(tmp_path / "b.mp4"), tmp_path / "c.mov", 90)
    ingested(tmp_path / "job", {"1.mp4": wide, "2.mov": upright})
    # What moves in this pattern would be cut out of the rest, which stands still.
    options = {"long_side_px": 160, "find_burned_in": False}
    _, listed, out = chosen(tmp_path / "job", num_frames=24, **options)
    assert [(c["width"], c["height"]) for c in listed["clips"]] == [(160, 90), (90, 160)]
    for row in listed["frames"]:
        with PIL.Image.open(out / row["file"]) as image:
            assert image.size == ((160, 90), (90, 160))[row["clip"]]


def test_a_clip_that_is_damaged_or_there_twice_is_left_out_by_name(tmp_path: Path) -> None:
    good = make_clip(tmp_path / "a.mp4")
    bad = make_clip(tmp_path / "b.mp4").read_bytes()
    files: dict[str, Path | bytes] = {"a.mp4": good, "b.mp4": bad[: len(bad) // 3]}
    summary = ingested(tmp_path / "job", {**files, "copy of a.mp4": good, "poster.jpg": picture()})
    assert summary["num_clips"] == 1
    told = "\n".join(summary["warnings"])
    assert 'Left out: "b.mp4". The video is cut off' in told
    assert "1 video (copy of a.mp4) was not used: the same video is there twice" in told
    assert "1 picture (poster.jpg) was not used" in told
    with pytest.raises(CaptureError) as caught:
        ingested(tmp_path / "other", {"b.mp4": files["b.mp4"]})
    assert caught.value.code == "video_truncated"


def test_clips_are_as_long_together_as_one_may_be(tmp_path: Path) -> None:
    clips: dict[str, Path | bytes] = {
        name: make_clip(tmp_path / name, f"{source}=s=320x180:r=30:d=2")
        for name, source in (("a.mp4", "testsrc2"), ("b.mp4", "testsrc"))
    }
    with pytest.raises(CaptureError, match="together 4 s long; 3 s") as caught:
        ingested(tmp_path / "job", clips, IngestOptions(max_duration_s=3.0))
    assert caught.value.code == "video_too_long"


def test_photos_beside_their_short_films_are_photos(tmp_path: Path) -> None:
    """Phones store a film of a second or two with each photo."""
    film = b"\x00\x00\x00\x14ftypqt  " + bytes(40)
    files = {f"IMG_{n}.jpg": picture(seed=n) for n in range(8)}
    path = tmp_path / "c.zip"
    for num_photos, kind in ((8, "images"), (7, "videos")):
        with zipfile.ZipFile(path, "w") as archive:
            for name in list(files)[:num_photos]:
                archive.writestr(name, files[name])
                archive.writestr(name.replace("jpg", "mov"), film)
        assert sniff(path, "c.zip").kind == kind


@pytest.mark.parametrize(
    ("clips", "wanted", "shares"),
    [
        ([(10.0, 300), (30.0, 900)], 40, [10, 30]),
        ([(1.0, 30), (99.0, 3000)], 100, [8, 92]),
        ([(50.0, 5), (50.0, 3000)], 100, [5, 95]),
        ([(10.0, 20), (10.0, 20)], 300, [20, 20]),
        ([(10.0, 300)] * 3, 100, [33, 34, 33]),
        ([(1.0, 30)] * 4, 8, [8, 8, 8, 8]),
        ([(1.0, 30)], 8, [8]),
    ],
)
def test_frames_are_shared_among_clips(
    clips: list[tuple[float, int]], wanted: int, shares: list[int]
) -> None:
    given = [Clip("", 0.0, {"duration_s": s, "num_frames": n}) for s, n in clips]
    assert shared_frames(given, wanted) == shares


def proxy(film: Path, path: Path, *options: str) -> Path:
    """A film again, as a camera or a messenger makes it smaller."""
    ffmpeg("-i", film, "-an", *options, "-f", "mp4", path)
    return path


@pytest.mark.parametrize("fps", ["30", "15"])
def test_the_small_proxy_of_a_film_is_no_second_clip(tmp_path: Path, fps: str) -> None:
    """GoPro's .LRV and DJI's .LRF hold the film beside them reduced, perhaps at half its rate."""
    film = make_clip(tmp_path / "GX010001.MP4", "testsrc2=s=640x360:r=30:d=3")
    small = proxy(film, tmp_path / "GL010001.LRV", "-vf", f"scale=160:90,fps={fps}", "-crf", "30")
    files: dict[str, Path | bytes] = {"DCIM/GL010001.LRV": small, "DCIM/GX010001.MP4": film}
    summary = ingested(tmp_path / "job", files)
    assert [clip["name"] for clip in summary["clips"]] == ["DCIM/GX010001.MP4"]
    told = "\n".join(summary["warnings"])
    assert "1 video (DCIM/GL010001.LRV) was not used: a smaller copy of DCIM/GX010001.MP4." in told


def test_a_film_beside_its_reencoded_copy_is_one(tmp_path: Path) -> None:
    film = make_clip(tmp_path / "a.mp4", "testsrc2=s=320x180:r=30:d=3", "-crf", "12")
    again = proxy(film, tmp_path / "b.mp4", "-vf", "eq=brightness=.05:contrast=1.1", "-crf", "35")
    summary = ingested(tmp_path / "job", {"1 sent.mp4": again, "2 filmed.mp4": film})
    assert [clip["name"] for clip in summary["clips"]] == ["2 filmed.mp4"]
    assert any("a copy of 2 filmed.mp4" in warning for warning in summary["warnings"])


def test_films_of_one_length_that_show_other_things_are_several(tmp_path: Path) -> None:
    """Also two rounds of a turntable before one ground: the same but for where the thing is."""
    turn = "color=gray:s=320x180:r=30:d=3[g];testsrc2=s=90x90:r=30:d=3[t];[g][t]overlay=x={}:y=40"
    first = make_clip(tmp_path / "a.mp4", turn.format("20+2*n"))
    second = make_clip(tmp_path / "b.mp4", turn.format("20+2*mod(n+45\\,90)"))
    other = make_clip(tmp_path / "c.mp4", "testsrc2=s=320x180:r=30:d=3")
    files: dict[str, Path | bytes] = {"a.mp4": first, "b.mp4": second, "c.mp4": other}
    assert ingested(tmp_path / "job", files)["num_clips"] == 3


def test_a_raised_limit_of_unpacked_bytes_is_heeded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where archives may have a thousand bytes by default, films of more go by the option."""
    limits = ArchiveLimits(max_unpacked_bytes=1000)
    monkeypatch.setattr(ArchiveLimits.__init__, "__defaults__", astuple(limits))
    film = make_clip(tmp_path / "a.mp4")
    raised = IngestOptions(max_unpacked_bytes=2**20)
    assert ingested(tmp_path / "job", {"a.mp4": film}, raised)["num_clips"] == 1


def test_frames_are_those_of_the_film_not_of_a_preview_before_it(tmp_path: Path) -> None:
    """Some cameras keep a small preview in the same file, as its first stream."""
    preview = make_clip(tmp_path / "small.mp4", "color=red:s=160x90:r=15:d=3")
    film = numbered_clip(tmp_path, "film", 0, 60, 20)
    both = tmp_path / "both.mov"
    ffmpeg("-i", preview, "-i", film, "-map", "0:v", "-map", "1:v", "-c", "copy", both)
    summary = ingested(tmp_path / "job", {"both.mov": both})
    assert [clip["width"] for clip in summary["clips"]] == [320]
    _, listed, out = chosen(tmp_path / "job", num_frames=20)
    for row in listed["frames"]:
        assert number_in(out / row["file"]) == row["source_frame_index"]
