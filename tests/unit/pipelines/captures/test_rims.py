"""Black rims of undistorted pictures: found where they are, and nowhere else."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from numpy.typing import NDArray

from pipelines.captures.record import CaptureRecord
from pipelines.captures.rims import common_rim
from pipelines.stage import StageContext
from tests.unit.pipelines.captures.archives import polycam_files
from tests.unit.pipelines.captures.ingesting import cameras, ingest

Bools = NDArray[np.bool_]
_HEIGHT, _WIDTH = 120, 160


def curved(depth: float = 5.0) -> Bools:
    """A rim as undistorting leaves it: deepest in the middle of the longer sides."""
    rows, columns = np.mgrid[:_HEIGHT, :_WIDTH]
    bow = depth * np.sin(np.pi * columns / _WIDTH)
    rim: Bools = (rows < bow) | (rows > _HEIGHT - 1 - 0.5 * bow)
    return rim


def jpeg(seed: int, black: Bools | None = None) -> bytes:
    """A picture of patches, black where it is to be."""
    rng = np.random.default_rng(seed)
    small = rng.integers(30, 255, (_HEIGHT // 8, _WIDTH // 8, 3), np.uint8)
    pixels = small.repeat(8, axis=0).repeat(8, axis=1)
    if black is not None:
        pixels[black] = 0
    data = io.BytesIO()
    PIL.Image.fromarray(pixels).save(data, "JPEG", quality=90)
    return data.getvalue()


def written(folder: Path, pictures: list[bytes]) -> list[Path]:
    """Files of pictures."""
    folder.mkdir(exist_ok=True)
    files = [folder / f"{index:02d}.jpg" for index in range(len(pictures))]
    for file, picture in zip(files, pictures, strict=True):
        file.write_bytes(picture)
    return files


@pytest.fixture
def ctx(tmp_path: Path) -> StageContext:
    """Of a small export."""
    return ingest(tmp_path / "any", polycam_files(4))[1]


def test_a_rim_is_found_with_what_is_mixed_with_it(tmp_path: Path, ctx: StageContext) -> None:
    true = curved()
    rim = common_rim(written(tmp_path / "p", [jpeg(seed, true) for seed in range(12)]), ctx)
    assert rim is not None
    assert rim[true].mean() > 0.9, "its thin ends are as grey as what is beside them"
    assert rim.mean() < true.mean() + 0.06
    assert not rim[20:-20, 20:-20].any()


def _cloth(seed: int) -> Bools:
    """All but a thing that is elsewhere in each picture."""
    rng = np.random.default_rng(100 + seed)
    rows, columns = np.mgrid[:_HEIGHT, :_WIDTH]
    middle = rng.uniform((50, 60), (70, 100))
    cloth: Bools = np.hypot(rows - middle[0], columns - middle[1]) > 35
    return cloth


def _dusk(seed: int) -> Bools:
    """A corner that is dark in all, beside what is dark in one."""
    rows, columns = np.mgrid[:_HEIGHT, :_WIDTH]
    own = 30 + 40 * np.random.default_rng(200 + seed).random()
    dark: Bools = (rows < 8) & (columns < 90) | (rows < own) & (columns < 60)
    return dark


@pytest.mark.parametrize("dark", [_cloth, _dusk, lambda _: curved(60.0), lambda _: None])
def test_what_is_dark_is_no_rim(tmp_path: Path, ctx: StageContext, dark: Any) -> None:
    pictures = [jpeg(seed, dark(seed)) for seed in range(12)]
    assert common_rim(written(tmp_path / "p", pictures), ctx) is None


def test_one_picture_without_it_and_there_is_none(tmp_path: Path, ctx: StageContext) -> None:
    pictures = [jpeg(seed, None if seed == 7 else curved()) for seed in range(12)]
    assert common_rim(written(tmp_path / "p", pictures), ctx) is None


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize("rimmed", [True, False])
def test_rims_are_ignored_from_ingest_on(tmp_path: Path, posed: bool, rimmed: bool) -> None:
    black = curved() if rimmed else None
    files: dict[str, bytes | str] = {f"IMG_{seed}.jpg": jpeg(seed, black) for seed in range(12)}
    if posed:
        files = {
            name: jpeg(seed, black) if name.endswith(".jpg") else data
            for seed, (name, data) in enumerate(polycam_files(12).items())
        }
    summary, ctx = ingest(tmp_path, files)
    assert summary.get("num_rims", 0) == (12 if rimmed else 0)
    if posed:
        masks = [image.mask for image in cameras(ctx).images]
    else:
        masks = [image.get("mask") for image in CaptureRecord.load(ctx.out).images]
    if not rimmed:
        assert masks == [None] * 12
        assert not (ctx.out / "masks").exists()
        return
    assert len(set(masks)) == 12
    for mask in masks:
        with PIL.Image.open(ctx.out / str(mask)) as opened:
            pixels = np.asarray(opened)
        assert opened.mode == "L"
        assert (pixels[curved()] == 0).mean() > 0.9
        assert (pixels == 255).mean() > 0.88
