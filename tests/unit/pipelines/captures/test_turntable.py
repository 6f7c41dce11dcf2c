"""A thing that turns before a camera on a tripod is cut out of the room behind it; nothing else."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from numpy.typing import NDArray

from pipelines.captures.record import CaptureRecord
from pipelines.captures.small_pictures import small
from pipelines.captures.turntable import find_ground
from pipelines.stage import StageContext
from tests.unit.pipelines.captures.archives import nerfstudio_files
from tests.unit.pipelines.captures.ingesting import ingest
from tests.unit.pipelines.captures.made_turntable import NUM, made
from tests.unit.pipelines.sfm import synthetic_room

Picture = NDArray[np.uint8]


def brighter(pictures: tuple[Picture, ...]) -> list[Picture]:
    """As a phone's exposure goes after what is in the middle."""
    gains = 1.0 + 0.15 * np.sin(np.arange(len(pictures)))
    return [
        np.clip(one * gain, 0, 255).astype(np.uint8)
        for one, gain in zip(pictures, gains, strict=True)
    ]


def written(folder: Path, pictures: list[Picture]) -> list[Path]:
    folder.mkdir()
    files = [folder / f"{number:02d}.jpg" for number in range(len(pictures))]
    for file, picture in zip(files, pictures, strict=True):
        PIL.Image.fromarray(picture).save(file, quality=92)
    return files


@pytest.fixture
def ctx(tmp_path: Path) -> StageContext:
    """Of a small capture."""
    return ingest(tmp_path / "any", nerfstudio_files(4))[1]


@pytest.mark.parametrize("light", [list, brighter])
def test_what_turns_is_told_from_what_stands_still(
    tmp_path: Path, ctx: StageContext, light: Callable[..., list[Picture]]
) -> None:
    pictures, things = made()
    files = written(tmp_path / "p", light(pictures))
    ground = find_ground(files, ctx)
    assert ground is not None
    for file, thing in zip(files, things, strict=True):
        found = ground.thing(small(file, 640, "RGB", ctx))
        # Its plain shoulder looks the same from all sides, an eighth of it.
        assert (found & thing).sum() > 0.85 * thing.sum()
        assert (found & ~thing).sum() < 0.05 * thing.sum()


def before_a_plain_ground(number: int) -> Picture:
    picture = made()[0][number].copy()
    picture[~made()[1][number]] = (200, 205, 210)
    return picture


def a_hand_that_holds_the_camera(number: int) -> Picture:
    return np.roll(made()[0][number], (number * 5) % 17 - 8, axis=1)


def a_walk(number: int) -> Picture:
    return np.asarray(synthetic_room.render(synthetic_room.arc_poses(NUM)[number]))


def nothing_moves(number: int) -> Picture:
    del number
    return made()[0][0]


def somebody_walks_by(number: int) -> Picture:
    """In two of the pictures."""
    picture = made()[0][0].copy()
    if number in (5, 6):
        picture[50:250, 40 * number : 40 * number + 60] = 90
    return picture


def a_recorded_screen(number: int) -> Picture:
    """A scanner's window, and around it buttons and a picture of what it is."""
    picture = made()[0][0].copy()
    view = np.asarray(synthetic_room.render(synthetic_room.arc_poses(NUM)[number]))
    picture[50:260, 70:370] = view[50:260, 70:370]
    return picture


@pytest.mark.parametrize(
    "shown",
    [
        before_a_plain_ground,
        a_recorded_screen,
        a_hand_that_holds_the_camera,
        a_walk,
        nothing_moves,
        somebody_walks_by,
    ],
)
def test_nothing_else_is_cut(
    tmp_path: Path, ctx: StageContext, shown: Callable[[int], Picture]
) -> None:
    files = written(tmp_path / "p", [shown(number) for number in range(NUM)])
    assert find_ground(files, ctx) is None


def test_few_pictures_tell_no_ground(tmp_path: Path, ctx: StageContext) -> None:
    files = written(tmp_path / "p", list(made()[0]))
    assert find_ground(files[:11], ctx) is None


def jpeg(picture: Picture) -> bytes:
    data = io.BytesIO()
    PIL.Image.fromarray(picture).save(data, "JPEG", quality=92)
    return data.getvalue()


def test_photos_become_cut_out_ones(tmp_path: Path) -> None:
    files = {f"IMG_{number}.jpg": jpeg(one) for number, one in enumerate(made()[0])}
    summary, ctx = ingest(tmp_path, files)
    assert summary["num_turned"] == NUM
    assert any("turned before it" in line for line in summary["warnings"])
    record = CaptureRecord.load(ctx.out)
    for image in record.images:
        assert "mask" not in image
        check_cut(ctx.out, image["file"], image["cut"])


def check_cut(out: Path, file: str, cut: str) -> None:
    """White where the cut is black."""
    with PIL.Image.open(out / cut) as opened:
        thing = np.asarray(opened) > 0
    with PIL.Image.open(out / file) as opened:
        picture = np.asarray(opened.convert("RGB"))
    assert 0.1 < thing.mean() < 0.5
    assert np.median(picture[~thing].min(axis=1)) >= 250
    assert np.median(picture[thing].min(axis=1)) < 200
