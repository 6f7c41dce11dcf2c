"""Masks beside photos: each belongs to its photo, and does what is meant by it, or nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import PIL.ImageFilter
import pytest
from numpy.typing import NDArray

from pipelines.captures.photo_masks import fitted
from pipelines.options import IngestOptions
from pipelines.stage import StageContext
from tests.unit.pipelines.captures.archives import llff_files, phone_exif
from tests.unit.pipelines.captures.ingesting import (
    Files,
    cameras,
    ingest,
    sources,
    warning_with,
)
from tests.unit.pipelines.captures.test_photo_choice import disc, encoded, photos, scene

Bytes = NDArray[np.uint8]


def passer_by() -> Bytes:
    """Somebody who stands at the lower border is black. [H, W]"""
    mask = np.full((120, 160), 255, np.uint8)
    mask[50:, 30:60] = 0
    return mask


def with_masks(
    mask: Bytes, where: str = "masks/{}.png", kind: str = "PNG", count: int = 9
) -> Files:
    return photos() | {where.format(n): encoded(np.roll(mask, n, 1), kind) for n in range(count)}


def written(ctx: StageContext, number: int) -> Bytes:
    return np.asarray(PIL.Image.open(ctx.out / "images" / f"{number:05d}.jpg"))


def near_edges(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What shares JPEG's squares of 8 pixels with an edge of a mask. [H, W]"""
    mask = PIL.Image.fromarray((inside * 255).astype(np.uint8))
    grown, shrunk = (
        np.asarray(mask.filter(of(17)))
        for of in (PIL.ImageFilter.MaxFilter, PIL.ImageFilter.MinFilter)
    )
    near: NDArray[np.bool_] = grown != shrunk
    return near


def entries(ctx: StageContext) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((ctx.out / "capture.json").read_text())["images"]
    return found


@pytest.mark.parametrize(
    ("where", "kind"),
    [
        ("masks/{}.png", "PNG"),
        ("masks/{}.jpg", "JPEG"),
        ("masks/{}.jpg.png", "PNG"),
        ("images/{}_mask.png", "PNG"),
    ],
)
def test_a_thing_that_masks_cut_out_is_left_on_white(tmp_path: Path, where: str, kind: str) -> None:
    summary, ctx = ingest(tmp_path, with_masks(disc(), where, kind))
    assert (summary["num_masks"], summary["masks"], summary["warnings"]) == (9, "cut_out", [])
    assert sources(ctx) == list(photos())
    for n in range(9):
        inside = np.roll(disc(), n, 1) > 0
        picture = written(ctx, n + 1).astype(int)
        edge = near_edges(inside)
        assert (picture[~inside & ~edge] > 240).all()
        assert np.abs(picture - scene(n))[inside & ~edge].mean() < 6
    assert not (ctx.out / "masks").exists()
    assert all("mask" not in entry for entry in entries(ctx))
    for n, entry in enumerate(entries(ctx)):
        cut = np.asarray(PIL.Image.open(ctx.out / entry["cut"]))
        assert ((cut > 127) == (np.roll(disc(), n, 1) > 0)).mean() > 0.99


def test_what_masks_hide_is_to_be_ignored(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, with_masks(passer_by()))
    assert (summary["num_masks"], summary["masks"], summary["warnings"]) == (9, "ignore", [])
    for n, entry in enumerate(entries(ctx)):
        assert entry["mask"] == f"masks/{n + 1:05d}.png"
        mask = np.asarray(PIL.Image.open(ctx.out / entry["mask"]))
        np.testing.assert_array_equal(mask, np.roll(passer_by(), n, 1))
        assert np.abs(written(ctx, n + 1).astype(int) - scene(n)).mean() < 6


@pytest.mark.parametrize("wanted", ["ignore", "cut_out", "off"])
def test_who_sends_masks_may_say_what_they_mean(tmp_path: Path, wanted: Any) -> None:
    mask = passer_by() if wanted == "cut_out" else disc()
    summary, ctx = ingest(tmp_path, with_masks(mask), IngestOptions(masks=wanted))
    assert summary.get("masks") == (None if wanted == "off" else wanted)
    assert (ctx.out / "masks").exists() == (wanted == "ignore")
    is_white = bool((written(ctx, 1)[mask == 0] > 230).all())
    assert is_white == (wanted == "cut_out")
    if wanted == "off":
        assert warning_with(summary, "9 pictures in masks/ were not used")


def test_a_photo_that_is_not_cut_out_as_the_others_are_is_left_out(tmp_path: Path) -> None:
    files = photos(12) | {f"masks/{n}.png": encoded(disc()) for n in range(11)}
    summary, ctx = ingest(tmp_path, files)
    assert summary["masks"] == "cut_out"
    assert sources(ctx) == [f"images/{n}.jpg" for n in range(11)]
    assert warning_with(summary, "Left out", "images/11.jpg", "has no mask")


def test_few_masks_cut_nothing_out(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, with_masks(disc(), count=5))
    assert (summary["num_masks"], summary["masks"]) == (5, "ignore")
    assert sources(ctx) == list(photos())
    assert sum("mask" in entry for entry in entries(ctx)) == 5


@pytest.mark.parametrize(
    "mask",
    [
        pytest.param(np.full((120, 160), 255, np.uint8), id="all white"),
        pytest.param(np.full((120, 160), 120, np.uint8), id="grey"),
        pytest.param(disc()[:, :120], id="another shape"),
    ],
)
def test_what_is_no_mask_of_a_photo_changes_nothing(tmp_path: Path, mask: Bytes) -> None:
    files = photos() | {f"masks/{n}.png": encoded(mask) for n in range(9)}
    summary, ctx = ingest(tmp_path, files)
    assert "masks" not in summary
    assert np.abs(written(ctx, 1).astype(int) - scene(0)).mean() < 6
    assert warning_with(summary, "9 pictures in masks/ were not used")


def test_names_that_two_photos_have_tell_nothing(tmp_path: Path) -> None:
    files = photos(folder="left/")
    files |= {f"right/{n}.jpg": encoded(scene(100 + n), "JPEG") for n in range(9)}
    files |= {f"masks/{n}.png": encoded(disc()) for n in range(9)}
    summary, ctx = ingest(tmp_path, files)
    assert "masks" not in summary
    assert len(sources(ctx)) == 18


def test_smaller_masks_are_enlarged(tmp_path: Path) -> None:
    small = np.asarray(PIL.Image.fromarray(disc()).resize((80, 60)))
    files = photos() | {f"masks/{n}.png": encoded(small) for n in range(9)}
    _, ctx = ingest(tmp_path, files)
    inside = np.asarray(PIL.Image.fromarray(small).resize((160, 120))) > 127
    white = (written(ctx, 3) > 230).all(axis=-1)
    assert (white != inside).mean() > 0.97


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("turned", [True, False])
def test_masks_turn_with_their_photos(tmp_path: Path, orientation: int, turned: bool) -> None:
    """The photo is stored on its side, the mask as it is stored or as people see it."""
    upright = np.zeros((120, 160), np.uint8)
    upright[20:60, 30:50] = 255
    back = {1: 0, 3: 2, 6: 1, 8: 3}[orientation]
    files: Files = {}
    for n in range(9):
        shot = PIL.Image.fromarray(np.rot90(scene(n), back))
        exif = phone_exif(5.7, 26, orientation)
        shot.save(tmp_path / "shot.jpg", exif=exif)
        files[f"images/{n}.jpg"] = (tmp_path / "shot.jpg").read_bytes()
        mask = upright if turned or orientation == 3 else np.rot90(upright, back)
        files[f"masks/{n}.png"] = encoded(np.ascontiguousarray(mask))
    summary, ctx = ingest(tmp_path / "job", files)
    assert summary["masks"] == "cut_out"
    seen = (written(ctx, 1) < 200).any(axis=-1)
    rows, columns = np.nonzero(seen)
    assert abs(rows.mean() - 39.5) < 4
    assert abs(columns.mean() - 39.5) < 4


def test_a_mask_of_another_shape_fits_nothing() -> None:
    mask = PIL.Image.new("L", (40, 30))
    assert fitted(mask, (30, 40), None, upright=True) is None
    assert fitted(mask, (30, 40), 6, upright=False) is None
    found = fitted(mask, (30, 40), 6, upright=True)
    assert found is not None
    assert found.size == (40, 30)


def test_masks_that_posed_pictures_are_not_turned_to_cost_no_picture(tmp_path: Path) -> None:
    """Their intrinsics speak of pixels as stored; the masks were made of what people see."""
    files = dict(llff_files(9))
    for n in range(9):
        name = f"images/{n:03d}.jpg"
        shot = PIL.Image.fromarray(scene(n, (48, 64)))
        shot.save(tmp_path / "shot.jpg", exif=phone_exif(5.7, 26, 6))
        files[name] = (tmp_path / "shot.jpg").read_bytes()
        mask = np.zeros((64, 48), np.uint8)
        mask[20:40, 10:30] = 255
        files[f"masks/{n:03d}.png"] = encoded(mask)
    summary, ctx = ingest(tmp_path / "job", files)
    assert len(sources(ctx)) == 9
    assert "masks" not in summary
    assert warning_with(summary, "9 pictures in masks/ were not used")


@pytest.mark.parametrize(("mask", "meaning"), [("thing", "cut_out"), ("passer-by", "ignore")])
def test_pictures_with_poses_have_masks_beside_them_too(
    tmp_path: Path, mask: str, meaning: str
) -> None:
    values = np.zeros((48, 64), np.uint8)
    values[10:30, 20:40] = 255
    if mask == "passer-by":
        values = 255 - values
    files = llff_files(9) | {f"masks/{n:03d}.jpg": encoded(values, "JPEG") for n in range(9)}
    summary, ctx = ingest(tmp_path, files)
    assert (summary["num_masks"], summary["masks"]) == (9, meaning)
    assert not [text for text in summary["warnings"] if "masks/" in text]
    found = [image.mask for image in cameras(ctx).images]
    if meaning == "ignore":
        assert found == [f"masks/{n:05d}.png" for n in range(1, 10)]
    else:
        assert found == [None] * 9
        cuts = [image.cut for image in cameras(ctx).images]
        assert cuts == [f"cuts/{n:05d}.png" for n in range(1, 10)]
        assert (written(ctx, 1)[:8] > 230).all()
