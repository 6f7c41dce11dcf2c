"""Colour profiles for the tests, written byte by byte (ICC.1:2010): what phones and printers embed.

Columns are the primaries in XYZ under D50, as the published profiles hold them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
from skimage.color import xyz2lab

Ink = Literal["C", "M", "Y", "K"]
INKS: tuple[Ink, ...] = ("C", "M", "Y", "K")

SRGB_XYZ = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141))
DISPLAY_P3_XYZ = (
    (0.51512, 0.2412, -0.00105),
    (0.29198, 0.69225, 0.04189),
    (0.1571, 0.06657, 0.78407),
)
ADOBE_RGB_XYZ = (
    (0.60974, 0.31111, 0.01947),
    (0.20528, 0.62567, 0.06087),
    (0.14919, 0.06322, 0.74457),
)
_WHITE_D50 = (0.9642, 1.0, 0.8249)
SRGB_GAMMA = None
"""The transfer curve of sRGB, for `rgb_profile`."""


def _fixed(value: float) -> bytes:
    return struct.pack(">i", round(value * 65536))


def _xyz(values: Sequence[float]) -> bytes:
    return b"XYZ " + bytes(4) + b"".join(map(_fixed, values))


def _linear(signal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Light, in [0, 1], of sRGB numbers in [0, 1]."""
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


def _curve(gamma: float | None) -> bytes:
    """A transfer curve: a power, or that of sRGB in 1,024 steps."""
    if gamma is not None:
        return b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256))
    steps = np.round(_linear(np.linspace(0, 1, 1024)) * 65535).astype(">u2").tobytes()
    return b"curv" + bytes(4) + struct.pack(">I", 1024) + steps


def _profile(space: bytes, connection: bytes, kind: bytes, tags: Mapping[bytes, bytes]) -> bytes:
    tags = {b"wtpt": _xyz(_WHITE_D50), **tags}
    table, body = b"", b""
    start = 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        table += name + struct.pack(">II", start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    size = start + len(body)
    header = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x02400000, kind, space, connection)
    header += bytes(12) + b"acsp" + bytes(28) + b"".join(map(_fixed, _WHITE_D50))
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def rgb_profile(columns: Sequence[Sequence[float]], gamma: float | None) -> bytes:
    """A display's profile. columns: XYZ of red, green and blue."""
    tags = {
        name + b"XYZ": _xyz(column)
        for name, column in zip((b"r", b"g", b"b"), columns, strict=True)
    }
    tags |= {name: _curve(gamma) for name in (b"rTRC", b"gTRC", b"bTRC")}
    return _profile(b"RGB ", b"XYZ ", b"mntr", tags)


def gray_profile(gamma: float) -> bytes:
    return _profile(b"GRAY", b"XYZ ", b"mntr", {b"kTRC": _curve(gamma)})


def cmyk_profile(inks: Mapping[Ink, tuple[int, int, int]]) -> bytes:
    """A printer's profile: each full ink alone has an sRGB colour; several multiply."""
    corners = []
    for corner in range(16):
        color = np.ones(3)
        for bit, ink in zip((8, 4, 2, 1), INKS, strict=True):
            if corner & bit:
                color = color * np.array(inks[ink]) / 255
        lightness, a, b = xyz2lab(np.array(SRGB_XYZ).T @ _linear(color), illuminant="D50")
        corners.append((lightness * 2.55, a + 128, b + 128))
    grid = np.clip(np.round(corners), 0, 255).astype(np.uint8).tobytes()
    ramp = bytes(range(256))
    unit = b"".join(map(_fixed, (1, 0, 0, 0, 1, 0, 0, 0, 1)))
    table = b"mft1" + bytes(4) + bytes((4, 3, 2, 0)) + unit + ramp * 4 + grid + ramp * 3
    return _profile(b"CMYK", b"Lab ", b"prtr", {b"A2B0": table, b"A2B1": table})


def encoded(
    color: Sequence[int], columns: Sequence[Sequence[float]], gamma: float | None
) -> tuple[int, int, int]:
    """The numbers that stand for an sRGB colour under the profile of those columns."""
    linear = _linear(np.array(color) / 255)
    other = np.linalg.solve(np.array(columns).T, np.array(SRGB_XYZ).T @ linear)
    other = np.clip(other, 0, 1)
    if gamma is None:
        coded = np.where(other <= 0.0031308, other * 12.92, 1.055 * other ** (1 / 2.4) - 0.055)
    else:
        coded = other ** (1 / gamma)
    red, green, blue = np.round(coded * 255).astype(int).tolist()
    return red, green, blue
