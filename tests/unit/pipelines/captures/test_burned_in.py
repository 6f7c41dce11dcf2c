"""What lies over pictures of a scene that moves beneath it: found where it is, and nowhere else."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageDraw
import pytest
from numpy.typing import NDArray

from pipelines.captures.burned_in import BurnedIn, find_burned_in
from pipelines.captures.record import CaptureRecord
from pipelines.captures.video_frames import Crop
from pipelines.stage import StageContext
from tests.unit.pipelines.captures.archives import nerfstudio_files
from tests.unit.pipelines.captures.ingesting import cameras, ingest
from tests.unit.pipelines.sfm.synthetic_room import arc_poses, render

_WIDTH, _HEIGHT = 640, 360
_DATE = (20, 320, 184, 350)
"""Where a date is drawn: left, top, right, bottom."""
Lay = Callable[[PIL.Image.Image], object]


def scene(seed: int, size: tuple[int, int] = (_WIDTH, _HEIGHT)) -> PIL.Image.Image:
    """A part of a large patterned wall, elsewhere in each picture."""
    x, y = np.random.default_rng(100 + seed).integers((0, 0), (1920 - size[0], 1080 - size[1]))
    return _wall().crop((x, y, x + size[0], y + size[1]))


@functools.cache
def _wall() -> PIL.Image.Image:
    rng = np.random.default_rng(7)
    wall = PIL.Image.fromarray(rng.integers(20, 235, (90, 160, 3), np.uint8))
    return wall.resize((1920, 1080), PIL.Image.Resampling.BICUBIC)


def date(picture: PIL.Image.Image) -> None:
    """Dark digits with a bright edge, as cameras write them."""
    drawn = PIL.ImageDraw.Draw(picture)
    for number, x in enumerate(range(_DATE[0], _DATE[2], 17)):
        drawn.rectangle((x, _DATE[1], x + 11, _DATE[3]), (250, 250, 250))
        drawn.rectangle((x + 3, _DATE[1] + 3 + number, x + 8, _DATE[3] - 6), (10, 10, 10))


def logo(picture: PIL.Image.Image) -> None:
    """A ring through which the scene shines."""
    over = PIL.Image.new("L", picture.size)
    PIL.ImageDraw.Draw(over).ellipse((520, 20, 600, 100), outline=115, width=6)
    picture.paste(PIL.Image.new("RGB", picture.size, (255, 255, 255)), mask=over)


def shelf(picture: PIL.Image.Image) -> None:
    """The edge of one, level, along which a camera slides."""
    pixels = np.asarray(picture).copy()
    pixels[250:] //= 3
    picture.paste(PIL.Image.fromarray(pixels))


def backdrop(picture: PIL.Image.Image) -> None:
    """A plain ground, and what turns before it: its outline stays."""
    whole = picture.copy()
    inside = PIL.Image.new("L", picture.size)
    PIL.ImageDraw.Draw(inside).ellipse((200, 60, 440, 300), fill=255)
    picture.paste((90, 120, 150), (0, 0, *picture.size))
    picture.paste(whole, mask=inside)


def written(
    folder: Path, *lays: Lay, count: int = 16, moving: bool = True, quality: int = 85
) -> list[Path]:
    """JPEG files of pictures with all that is laid over them."""
    folder.mkdir()
    files = []
    for seed in range(count):
        picture = scene(seed if moving else 0)
        for lay in lays:
            lay(picture)
        files.append(folder / f"{seed:02d}.jpg")
        picture.save(files[-1], quality=quality)
    return files


def framed(files: list[Path], bars: tuple[int, int, int, int], color: tuple[int, int, int]) -> None:
    """The pictures between bars: left, top, right, bottom."""
    left, top, right, bottom = bars
    for file in files:
        with PIL.Image.open(file) as opened:
            wide = PIL.Image.new("RGB", (left + _WIDTH + right, top + _HEIGHT + bottom), color)
            wide.paste(opened, (left, top))
        wide.save(file, quality=85)


@pytest.fixture
def ctx(tmp_path: Path) -> StageContext:
    """Of a small capture."""
    return ingest(tmp_path / "any", nerfstudio_files(4))[1]


def found(files: list[Path], ctx: StageContext) -> BurnedIn:
    burned_in = find_burned_in(files, ctx)
    assert burned_in is not None
    return burned_in


def boxed(box: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """[H, W] of a box."""
    inside = np.zeros((_HEIGHT, _WIDTH), np.bool_)
    inside[box[1] : box[3], box[0] : box[2]] = True
    return inside


def test_a_date_and_a_logo_are_found_and_hardly_more(tmp_path: Path, ctx: StageContext) -> None:
    burned_in = found(written(tmp_path / "p", date, logo), ctx)
    assert burned_in.crop is None
    drawn = [PIL.Image.new("RGB", (_WIDTH, _HEIGHT), level) for level in ("black", "blue")]
    for picture in drawn:
        date(picture)
        logo(picture)
    changed = np.stack([np.asarray(picture) for picture in drawn])
    opaque = (changed[0] == changed[1]).all(axis=2)
    assert burned_in.mask[opaque].mean() > 0.99
    assert burned_in.mask[60, 521:526].all(), "the ring, through which the scene shines"
    beside = burned_in.mask & ~boxed((10, 310, 194, 360)) & ~boxed((508, 8, 612, 112))
    assert not beside.any()
    assert 0.01 < burned_in.share < 0.05


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (60, 90, 130)])
@pytest.mark.parametrize("bars", [(0, 60, 0, 60), (420, 0, 420, 0), (0, 34, 0, 80)])
def test_bars_are_cut_away(
    tmp_path: Path,
    ctx: StageContext,
    bars: tuple[int, int, int, int],
    color: tuple[int, int, int],
) -> None:
    files = written(tmp_path / "p")
    framed(files, bars, color)
    crop = found(files, ctx).crop
    assert crop is not None
    left, top, right, bottom = bars
    true = Crop(left, top, _WIDTH, _HEIGHT)
    at_most = 3 * max(left + right + _WIDTH, top + bottom + _HEIGHT) / 640
    for start, length, want, whole in (
        (crop.x, crop.width, true.x, true.width),
        (crop.y, crop.height, true.y, true.height),
    ):
        assert 0 <= start - want <= at_most
        assert 0 <= want + whole - (start + length) <= at_most


def test_bars_with_buttons_on_them_are_cut_away_too(tmp_path: Path, ctx: StageContext) -> None:
    files = written(tmp_path / "p", date)
    framed(files, (0, 0, 0, 60), (20, 20, 20))
    for file in files:
        with PIL.Image.open(file) as opened:
            picture = opened.convert("RGB")
        drawn = PIL.ImageDraw.Draw(picture)
        for x in range(40, 600, 90):
            drawn.ellipse((x, _HEIGHT + 12, x + 36, _HEIGHT + 48), (200, x % 255, 90))
        picture.save(file, quality=85)
    burned_in = found(files, ctx)
    assert burned_in.crop == pytest.approx((0, 0, _WIDTH, _HEIGHT), abs=3)
    assert burned_in.mask[boxed(_DATE).nonzero()].mean() > 0.9


@pytest.mark.parametrize(
    ("lays", "moving"),
    [
        ([], True),
        ([shelf], True),
        ([backdrop], True),
        ([backdrop, date], True),
        ([], False),
        ([date], False),
    ],
    ids=["nothing", "an edge along the way", "a ground", "a date on it", "still", "still, dated"],
)
def test_what_is_no_overlay(
    tmp_path: Path, ctx: StageContext, lays: list[Lay], moving: bool
) -> None:
    assert find_burned_in(written(tmp_path / "p", *lays, moving=moving), ctx) is None


def test_what_a_gimbal_keeps_in_the_middle_is_no_overlay(tmp_path: Path, ctx: StageContext) -> None:
    """All pictures of a circle look at one point, and what is around it stays nearly in place."""
    (tmp_path / "p").mkdir()
    plain, dated = [], []
    for number, pose in enumerate(arc_poses(24)):
        plain.append(tmp_path / "p" / f"{number:02d}.jpg")
        picture = PIL.Image.fromarray(np.asarray(render(pose)))
        picture.save(plain[-1], quality=92)
        dated.append(tmp_path / "p" / f"{number:02d}-dated.jpg")
        picture = picture.resize((_WIDTH, _HEIGHT))
        date(picture)
        picture.save(dated[-1], quality=92)
    assert find_burned_in(plain, ctx) is None
    mask = found(dated, ctx).mask
    assert mask[boxed(_DATE)].mean() > 0.95
    assert not mask[:300].any()


def test_a_frame_hides_what_it_covers_and_not_what_is_in_it(
    tmp_path: Path, ctx: StageContext
) -> None:
    def round_frame(picture: PIL.Image.Image) -> None:
        inside = PIL.Image.new("L", picture.size)
        PIL.ImageDraw.Draw(inside).rounded_rectangle((20, 20, 620, 340), 30, fill=255)
        over = PIL.Image.new("RGB", picture.size, (240, 200, 120))
        picture.paste(over, mask=PIL.Image.eval(inside, lambda level: 255 - level))

    burned_in = found(written(tmp_path / "p", round_frame), ctx)
    assert burned_in.mask[18:26, 18:26].all(), "a corner"
    assert not burned_in.mask[60:300, 60:580].any()
    assert burned_in.crop == pytest.approx((20, 20, 600, 320), abs=6)


def test_few_pictures_have_too_much_in_common(tmp_path: Path, ctx: StageContext) -> None:
    files = written(tmp_path / "p", date)
    assert find_burned_in(files[:11], ctx) is None
    assert find_burned_in(files[:12], ctx) is not None


def test_a_hand_that_hides_it_for_a_moment_changes_nothing(
    tmp_path: Path, ctx: StageContext
) -> None:
    files = written(tmp_path / "p", date, count=24)
    for file in files[3:5]:
        scene(99).save(file)
    assert found(files, ctx).mask[boxed(_DATE)].mean() > 0.9


@pytest.mark.parametrize("posed", [True, False])
def test_photos_with_a_date_have_it_masked(tmp_path: Path, posed: bool) -> None:
    pictures = [file.read_bytes() for file in written(tmp_path / "p", date)]
    files: dict[str, bytes | str] = {f"IMG_{n}.jpg": data for n, data in enumerate(pictures)}
    if posed:
        files = {
            **nerfstudio_files(len(pictures), w=_WIDTH, h=_HEIGHT),
            **{f"images/{n}.jpg": data for n, data in enumerate(pictures)},
        }
    summary, ctx = ingest(tmp_path, files)
    assert summary["num_burned_in"] == len(pictures)
    assert any("date" in warning for warning in summary["warnings"])
    if posed:
        masks = [image.mask for image in cameras(ctx).images]
    else:
        masks = [image.get("mask") for image in CaptureRecord.load(ctx.out).images]
    assert len(set(masks)) == len(pictures)
    for mask in masks:
        with PIL.Image.open(ctx.out / str(mask)) as opened:
            pixels = np.asarray(opened)
        assert pixels[boxed(_DATE)].mean() < 30
        assert (pixels == 255).mean() > 0.9
