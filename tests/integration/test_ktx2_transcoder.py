"""KTX2 textures in the hands of three.js's transcoder. Needs npm once for three.js."""

from __future__ import annotations

from subprocess import CalledProcessError

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.formats import etc1, ktx2
from tests.basis_transcoder import BC1, BC7, ETC1, RGBA, shown, transcode
from tests.benchmarks.browser import NoBrowserError, three_folder
from tests.texture_pictures import edges, gradients, photo, psnr

Bytes = NDArray[np.uint8]


@pytest.fixture(autouse=True)
def _needs_three_js() -> None:
    try:
        three_folder()
    except NoBrowserError as error:
        pytest.skip(f"three.js's transcoder is NOT tested: {error}")


def _every_kind() -> Bytes:
    """Like a photo, smooth, with edges, of one colour, all but black and all but white."""
    side = 128
    picture = np.zeros((2 * side, 4 * side, 3), np.uint8)
    noise = photo(side) // 64
    parts = [photo(side), gradients(side), edges(side), np.full_like(noise, (9, 99, 199))]
    parts += [noise, 255 - noise, photo(side, 9), edges(side)]
    for at, part in enumerate(parts):
        row, column = side * (at // 4), side * (at % 4)
        picture[row : row + side, column : column + side] = part
    return picture


def test_it_reads_every_level_as_we_do() -> None:
    picture = _every_kind()
    data = ktx2.encode(picture)
    facts, made = transcode(data, RGBA)
    height, width = picture.shape[:2]
    sizes = [[max(1, width >> level), max(1, height >> level)] for level in range(10)]
    assert facts == {
        "valid": True,
        "uastc": True,
        "width": width,
        "height": height,
        "levels": 10,
        "alpha": False,
        "transfer": 2,
        "model": 166,
        "started": True,
        "sizes": sizes,
    }
    for level, (across, down) in enumerate(sizes):
        rgba = np.frombuffer(made[RGBA, level], np.uint8).reshape(down, across, 4)
        np.testing.assert_array_equal(rgba[:, :, :3], ktx2.decode(data, level))
        assert (rgba[:, :, 3] == 255).all()


@pytest.mark.parametrize(("form", "least_db"), [(BC7, 40.0), (BC1, 32.0), (ETC1, 31.0)])
def test_what_it_makes_for_graphics_cards_looks_the_same(form: int, least_db: float) -> None:
    picture = photo(256)
    _, made = transcode(ktx2.encode(picture), form)
    assert psnr(shown(form, made[form, 0], 256, 256), picture) > least_db


@pytest.mark.parametrize("form", [BC7, BC1, ETC1])
def test_dark_light_and_one_colour_stay_so(form: int) -> None:
    noise = photo(64) // 64
    for picture in (noise, 255 - noise, np.full_like(noise, (9, 99, 199))):
        _, made = transcode(ktx2.encode(picture), form)
        found = shown(form, made[form, 0], 64, 64)
        assert np.abs(found.astype(int) - picture).max() <= 4


def test_hints_make_etc1_better(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = photo(128)

    def etc1_psnr() -> float:
        _, made = transcode(ktx2.encode(picture), ETC1)
        return psnr(shown(ETC1, made[ETC1, 0], 128, 128), picture)

    with_hints = etc1_psnr()
    monkeypatch.setattr(etc1, "hints", lambda pixels: np.zeros(pixels.shape[2], np.int32))
    assert etc1_psnr() < with_hints - 3.0


def test_it_refuses_what_is_broken() -> None:
    data = bytearray(ktx2.encode(gradients(16)))
    data[44] = 7  # a scheme that there is not
    with pytest.raises(CalledProcessError):
        transcode(bytes(data), RGBA)
