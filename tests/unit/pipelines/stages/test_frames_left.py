"""What is left out of a clip's frames, cut away, masked or cut out: bars, logos, repeats, rooms."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from tests.unit.pipelines.captures import made_turntable
from tests.unit.pipelines.stages.test_frames import chosen, ingested, panned
from tests.unit.pipelines.tools.clips import (
    ffmpeg,
    make_clip,
    marked_pictures,
    number_in,
    rotated,
)


def test_bars_are_cut_away_and_a_logo_is_masked(tmp_path: Path) -> None:
    """Of a film that is turned by its display matrix: what is cut is of the upright picture."""
    plain = panned(tmp_path, (0.4, 0.4, 0.4))
    logo = PIL.Image.new("RGB", (40, 40), "white")
    logo.paste((0, 0, 0), (8, 16, 32, 24))
    logo.save(tmp_path / "logo.png")
    framed = tmp_path / "framed.mp4"
    ffmpeg(
        "-i", plain, "-i", tmp_path / "logo.png",
        "-filter_complex", "[0][1]overlay=20:120,pad=640:180:80:0:0x305070,transpose=clock",
        "-pix_fmt", "yuv420p", framed,
    )  # fmt: skip
    clip = tmp_path / "b.mp4"
    rotated(framed, clip, -90)
    ingested(tmp_path, clip)
    summary, rows, out = chosen(tmp_path, num_frames=20)
    (read,) = json.loads((out / "frames.json").read_text())["clips"]
    assert read["crop"] == pytest.approx([80, 0, 320, 180], abs=6)
    assert (summary["width"], summary["height"]) == tuple(read["crop"][2:])
    assert read["burned_in"] == pytest.approx(40 * 40 / (320 * 180), abs=0.02)
    assert [warning.split()[0] for warning in summary["warnings"]] == ["Bars", "Something"]
    left = 80 - read["crop"][0]
    for row in rows:
        with PIL.Image.open(out / row["mask"]) as mask, PIL.Image.open(out / row["file"]) as image:
            assert mask.size == image.size == (summary["width"], summary["height"])
            hidden = np.asarray(mask) < 128
        assert hidden[121:159, left + 21 : left + 59].all()
        assert hidden.mean() < 0.06


@pytest.mark.parametrize("aspect", ["64/45", "8/9"])
def test_bars_are_cut_off_where_pixels_are_not_square(tmp_path: Path, aspect: str) -> None:
    """DV, HDV and DVDs: the film is shown wider or narrower than it is stored."""
    plain, framed = panned(tmp_path, (0.4, 0.4)), tmp_path / "framed.mp4"
    ffmpeg(
        "-i", plain, "-vf", f"pad=400:180:40:0,setsar={aspect}", "-pix_fmt", "yuv420p", framed,
    )  # fmt: skip
    ingested(tmp_path, framed)
    summary, rows, out = chosen(tmp_path, num_frames=16)
    (read,) = json.loads((out / "frames.json").read_text())["clips"]
    stretch = float(Fraction(aspect))
    assert read["crop"] == pytest.approx([40 * stretch, 0, 320 * stretch, 180], abs=6)
    assert [warning.split()[0] for warning in summary["warnings"]] == ["Bars"]
    with PIL.Image.open(out / rows[0]["file"]) as image:
        pixels = np.asarray(image.convert("L"))
    assert pixels[:, 0].mean() > 40
    assert pixels[:, -1].mean() > 40


def test_bars_and_logos_can_be_left(tmp_path: Path) -> None:
    plain, framed = panned(tmp_path, (0.4, 0.4)), tmp_path / "framed.mp4"
    ffmpeg("-i", plain, "-vf", "pad=640:180:160:0", "-pix_fmt", "yuv420p", framed)
    ingested(tmp_path, framed)
    summary, rows, out = chosen(tmp_path, num_frames=16, find_burned_in=False)
    assert (summary["width"], summary["warnings"]) == (640, [])
    assert not any("mask" in row for row in rows)
    assert not (out / "masks").exists()


def test_frames_that_a_film_repeats_are_chosen_once(tmp_path: Path) -> None:
    """A time lapse, or a recording of a slow stream, stored at many frames a second."""
    marked_pictures(tmp_path / "p", 20, blurred=set())
    clip = tmp_path / "a.mp4"
    ffmpeg(
        "-framerate", "2", "-i", tmp_path / "p" / "%04d.png", "-r", "30",
        "-pix_fmt", "yuv420p", "-crf", "30", clip,
    )  # fmt: skip
    ingested(tmp_path, clip)
    summary, rows, out = chosen(tmp_path, num_frames=60)
    numbers = [number_in(out / row["file"]) for row in rows]
    assert numbers == sorted(set(numbers))
    assert len(numbers) >= 19
    (told,) = summary["warnings"]
    assert "show what the one before shows" in told


def test_a_small_thing_that_turns_before_a_still_camera_repeats_nothing(tmp_path: Path) -> None:
    turn = "color=gray:s=320x180:r=30:d=3[g];testsrc2=s=48x48:r=30:d=3[t];[g][t]overlay=x=3*n:y=80"
    ingested(tmp_path, make_clip(tmp_path / "a.mp4", turn))
    summary, _, _ = chosen(tmp_path, num_frames=30)
    assert summary["num_frames"] >= 30
    assert summary["warnings"] == []


def test_a_camera_that_moves_before_a_plain_wall_repeats_nothing(tmp_path: Path) -> None:
    """Light falls off along it, and that is all that is seen for a second of three."""
    shades = "c0=0xb0b0b0:c1=0x909090:n=2:x0=0:y0=0:x1=320:y1=0:speed=0.00001"
    wall = f"gradients={shades}:s=320x180:r=30:d=1[w]"
    film = f"testsrc2=s=320x180:r=30:d=2,hue=H=t[m];{wall};[m][w]concat=n=2"
    ingested(tmp_path, make_clip(tmp_path / "a.mp4", film))
    summary, _, _ = chosen(tmp_path, num_frames=30)
    assert summary["num_frames"] >= 30
    assert summary["warnings"] == []


def test_a_thing_on_a_turntable_is_cut_out_of_the_room_behind_it(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    for number, picture in enumerate(made_turntable.made()[0]):
        PIL.Image.fromarray(picture).save(tmp_path / "p" / f"{number:02d}.png")
    clip = tmp_path / "a.mp4"
    shown = ("-framerate", "6", "-i", tmp_path / "p" / "%02d.png", "-crf", "14")
    ffmpeg(*shown, "-pix_fmt", "yuv420p", clip)
    ingested(tmp_path, clip)
    summary, rows, out = chosen(tmp_path, num_frames=60)
    (told,) = summary["warnings"]
    assert "a thing turned before it" in told
    for row, thing in zip(rows, made_turntable.made()[1], strict=True):
        with PIL.Image.open(out / row["cut"]) as cut, PIL.Image.open(out / row["file"]) as image:
            left, picture = np.asarray(cut) > 0, np.asarray(image)
        assert (left & thing).sum() > 0.85 * thing.sum()
        assert (left & ~thing).sum() < 0.05 * thing.sum()
        assert np.median(picture[~left].min(axis=1)) >= 250
