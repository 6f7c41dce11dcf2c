"""Pictures in the colours that everything behind expects: sRGB, whatever profile they came with.

Phones take photos in Display P3, cameras in Adobe RGB, scanners and print shops in their own. Read
as sRGB such numbers are other colours. The conversion is colorimetric, with black mapped to black;
what sRGB cannot show is clipped.
"""

from __future__ import annotations

import functools
import io

import numpy as np
import PIL.Image
from PIL import ImageCms

from pipelines.errors import CaptureError

_MODE_OF_SPACE = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
_FITTING_MODES = {"RGB": ("RGB", "L"), "GRAY": ("L",), "CMYK": ("CMYK",)}
"""Modes that a profile of each colour space can speak of; a grey RGB picture may be stored as L."""
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
        return image
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
