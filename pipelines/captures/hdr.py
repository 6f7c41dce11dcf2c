"""HDR video in the colours of SDR, by the backward compatibility that HLG was made with.

An SDR screen of BT.2020 that is given an HLG signal shows a good picture: the upper half of the
signal is logarithmic, so bright surfaces keep their differences. So HLG is taken as the signal of
such a screen, and only its primaries are exchanged for those of BT.709. PQ is first turned into
the HLG signal of the same light. docs/video.md compares this with the usual tone curves.

Symbols: signal is what the video holds, [0, 1]; E is scene light, [0, 1]; F is display light in
cd/m2. Sources: ITU-R BT.2100-2, tables 4 and 5; BT.1886; BT.2087-0 for the primaries.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

Colors = npt.NDArray[np.float64]
"""[..., 3], red, green, blue of BT.2020."""

TRANSFERS = {"hlg": "arib-std-b67", "pq": "smpte2084"}
"""ffmpeg's names of the transfer functions that `VideoInfo.hdr` speaks of."""

_A, _B, _C = 0.17883277, 0.28466892, 0.55991073
_PEAK_NITS = 1000.0
"""Of the display that HLG's system gamma of 1.2 is for. What PQ has above is clipped."""
_SYSTEM_GAMMA = 1.2
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])
_M1, _M2 = 2610 / 16384, 2523 / 4096 * 128
_C1, _C2, _C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
SDR_GAMMA = 2.4
BT709_FROM_BT2020 = (
    (1.6605, -0.5876, -0.0728),
    (-0.1246, 1.1329, -0.0083),
    (-0.0182, -0.1006, 1.1187),
)
_TABLE_SIDE = 33
"""Steps of each channel: 99 in 100 colours come out within 1.2 of 255 levels."""


def hlg_signal(scene: Colors) -> Colors:
    """The HLG signal of scene light E."""
    light = np.clip(scene, 0.0, 1.0)
    logarithm = _A * np.log(np.maximum(12 * light - _B, 1e-9)) + _C
    return np.where(light <= 1 / 12, np.sqrt(3 * light), logarithm)


def pq_light(signal: Colors) -> Colors:
    """Display light F of a PQ signal."""
    power = np.clip(signal, 0.0, 1.0) ** (1 / _M2)
    linear: Colors = (np.maximum(power - _C1, 0.0) / (_C2 - _C3 * power)) ** (1 / _M1)
    return 10_000.0 * linear


def hlg_from_pq(signal: Colors) -> Colors:
    """The HLG signal that a display of 1,000 cd/m2 shows with the same light as a PQ signal."""
    shown = np.minimum(pq_light(signal) / _PEAK_NITS, 1.0)
    luminance = np.maximum(shown @ _LUMINANCE, 1e-9)[..., None]
    return hlg_signal(shown * luminance ** ((1 - _SYSTEM_GAMMA) / _SYSTEM_GAMMA))


def write_pq_table(path: Path) -> None:
    """`hlg_from_pq` as a table for ffmpeg's `lut3d`: the red channel changes fastest."""
    steps = np.linspace(0.0, 1.0, _TABLE_SIDE)
    blue, green, red = np.meshgrid(steps, steps, steps, indexing="ij")
    table = hlg_from_pq(np.stack([red, green, blue], axis=-1)).reshape(-1, 3)
    with path.open("w", encoding="ascii") as file:
        file.write(f"LUT_3D_SIZE {_TABLE_SIDE}\n")
        np.savetxt(file, table, fmt="%.6f")


def sdr_filters(kind: str, pq_table: Path | None) -> list[str]:
    """The ffmpeg filters that turn Y'CbCr of HDR into R'G'B' of BT.709, 16 bits a channel.

    kind: "hlg", or "pq" with `pq_table` as `write_pq_table` wrote it.
    """
    # Some phones tag the transfer alone: the matrix is that of all HDR video.
    filters = ["setparams=colorspace=bt2020nc", "scale=flags=bicubic+accurate_rnd,format=gbrp16"]
    if kind == "pq":
        assert pq_table is not None, "PQ needs its table"
        filters.append(f"lut3d=file={_escaped(pq_table)}:interp=tetrahedral")
    matrix = ":0:".join(":".join(f"{value}" for value in row) for row in BT709_FROM_BT2020)
    filters += [_power(SDR_GAMMA), f"colorchannelmixer={matrix}", _power(1 / SDR_GAMMA)]
    return filters


def _power(exponent: float) -> str:
    expression = f"'maxval*pow(val/maxval,{exponent:.9f})'"
    return f"lutrgb=r={expression}:g={expression}:b={expression}"


def _escaped(path: Path) -> str:
    """A path as the value of an option inside a filter graph: escaped for both."""
    value = re.sub(r"([\\':])", r"\\\1", str(path))
    return re.sub(r"([\\'\[\],;])", r"\\\1", value)
