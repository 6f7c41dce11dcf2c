"""Pictures in the colours that everything behind expects: sRGB, whatever profile they came with.

Phones take photos in Display P3, cameras in Adobe RGB, scanners and print shops in their own. Read
as sRGB such numbers are other colours. The conversion is colorimetric, with black mapped to black;
what sRGB cannot show is clipped.

HEIC may name its colours by numbers instead (`nclx`, ITU-T H.273): primaries, and a transfer
function, which may be HDR's: those become SDR as HDR video does (`pipelines.captures.hdr`).
"""

from __future__ import annotations

import functools
import io

import numpy as np
import numpy.typing as npt
import PIL.Image
from PIL import ImageCms, ImageFilter

from pipelines.captures.hdr import BT709_FROM_BT2020, SDR_GAMMA, hlg_from_pq
from pipelines.errors import CaptureError

_MODE_OF_SPACE = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
_FITTING_MODES = {"RGB": ("RGB", "L"), "GRAY": ("L",), "CMYK": ("CMYK",)}
"""Modes that a profile of each colour space can speak of; a grey RGB picture may be stored as L."""
_PRIMARIES_BT2020, _PRIMARIES_P3 = 9, 12
_TRANSFER_PQ, _TRANSFER_HLG = 16, 18
_SRGB_FROM_P3 = ((1.22494, -0.22494, 0.0), (-0.04206, 1.04206, 0.0), (-0.01964, -0.07864, 1.09828))
_TABLE_SIDE = 33
_SAME_LEVELS = 2
"""A profile that moves no colour by more is sRGB under one of its many names."""
_GRID = np.stack(
    np.meshgrid(*[np.arange(0, 256, 51, dtype=np.uint8)] * 3, indexing="ij"), axis=-1
).reshape(1, -1, 3)


def in_srgb(image: PIL.Image.Image) -> PIL.Image.Image:
    """The picture as 8-bit sRGB, RGB or RGBA; itself where it names no profile.

    Raises CaptureError profile_unusable where the profile is broken or is for other pixels; the
    pixels can then only be taken as sRGB.
    """
    profile = image.info.get("icc_profile")
    if not profile:
        named = image.info.get("nclx_profile") or {}
        return _from_numbers(
            image, named.get("color_primaries"), named.get("transfer_characteristics")
        )
    colors, alpha = _split(image)
    try:
        transform = _transform(bytes(profile), colors.mode)
        converted = colors.convert("RGB") if transform is None else _applied(transform, colors)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        raise CaptureError(
            "The colour profile is broken or not for such a picture.",
            code="profile_unusable",
            hint="Export the picture in sRGB.",
        ) from error
    if alpha is not None:
        converted.putalpha(alpha)
    return converted


def _from_numbers(
    image: PIL.Image.Image, primaries: int | None, transfer: int | None
) -> PIL.Image.Image:
    """The picture in sRGB, by H.273's numbers of its colours; itself where those are near sRGB's.

    Other transfer functions of SDR are taken for sRGB's, as viewers do.
    """
    if primaries not in (_PRIMARIES_BT2020, _PRIMARIES_P3):
        return image
    colors, alpha = _split(image)
    converted = colors.convert("RGB").filter(_table(primaries, transfer or 0))
    if alpha is not None:
        converted.putalpha(alpha)
    return converted


@functools.lru_cache(maxsize=8)
def _table(primaries: int, transfer: int) -> ImageFilter.Color3DLUT:
    steps = np.linspace(0.0, 1.0, _TABLE_SIDE)
    blue, green, red = np.meshgrid(steps, steps, steps, indexing="ij")
    signal = np.stack([red, green, blue], axis=-1).reshape(-1, 3)
    matrix = np.array(BT709_FROM_BT2020 if primaries == _PRIMARIES_BT2020 else _SRGB_FROM_P3)
    if transfer in (_TRANSFER_PQ, _TRANSFER_HLG):
        signal = hlg_from_pq(signal) if transfer == _TRANSFER_PQ else signal
        shown = np.clip(signal**SDR_GAMMA @ matrix.T, 0.0, 1.0) ** (1 / SDR_GAMMA)
    else:
        shown = _srgb_signal(np.clip(_srgb_light(signal) @ matrix.T, 0.0, 1.0))
    return ImageFilter.Color3DLUT(_TABLE_SIDE, shown.ravel().tolist())


def _srgb_light(signal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


def _srgb_signal(light: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def _split(image: PIL.Image.Image) -> tuple[PIL.Image.Image, PIL.Image.Image | None]:
    """Colours, as L, RGB or CMYK, and the transparency where there is one."""
    if image.mode in ("LA", "La"):
        straight = image.convert("LA")
        return straight.getchannel("L"), straight.getchannel("A")
    if image.mode in ("RGBA", "RGBa", "PA") or "transparency" in image.info:
        straight = image.convert("RGBA")
        return straight.convert("RGB"), straight.getchannel("A")
    if image.mode == "1":
        return image.convert("L"), None
    return (image.convert("RGB") if image.mode == "P" else image), None


@functools.lru_cache(maxsize=8)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """From pixels of that mode under a profile to sRGB; None where they are sRGB already.

    Photos of one capture share a profile: it is read once.
    """
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    space = source.profile.xcolor_space.strip()
    if mode not in _FITTING_MODES.get(space, ()):
        raise ValueError(f"a profile for {space} at pixels of mode {mode}")
    transform = ImageCms.buildTransform(
        source,
        ImageCms.createProfile("sRGB"),
        _MODE_OF_SPACE[space],
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
    if space == "RGB":
        moved = np.asarray(_applied(transform, PIL.Image.fromarray(_GRID))).astype(int) - _GRID
        if np.abs(moved).max() <= _SAME_LEVELS:
            return None
    return transform


def _applied(transform: ImageCms.ImageCmsTransform, image: PIL.Image.Image) -> PIL.Image.Image:
    fitting = image if image.mode == transform.input_mode else image.convert(transform.input_mode)
    converted = ImageCms.applyTransform(fitting, transform)
    assert converted is not None, "Pillow gives None only when asked to work in place"
    return converted
