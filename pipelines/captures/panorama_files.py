"""Pictures of the whole sphere: how a photo says that it is one, and the views cut from it.

A panorama lies in `panoramas/`, where poses are found for it, and its views in `images/`, which
all later stages see (`pipelines.scene.panoramas`).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import PIL.Image

from pipelines.scene.panoramas import cut_views

FOLDER = "panoramas"
EQUIRECTANGULAR = "equirectangular"
JPEG_QUALITY = 95
_XMP_BYTES = 1 << 20


def photo_projection(image: PIL.Image.Image) -> str:
    """The projection that a photo's XMP names, "" for none or for a part of the sphere.

    Google's Photo Sphere XMP: a whole one is as wide as the panorama that it is cut from.
    """
    packet = image.info.get("xmp", b"")
    text = packet[:_XMP_BYTES].decode("utf-8", "replace") if isinstance(packet, bytes) else ""
    if _value(text, "ProjectionType").lower() != EQUIRECTANGULAR:
        return ""
    sides = [
        (_value(text, f"FullPano{side}Pixels"), _value(text, f"CroppedAreaImage{side}Pixels"))
        for side in ("Width", "Height")
    ]
    if any(whole and part and whole != part for whole, part in sides):
        return ""
    return EQUIRECTANGULAR


def write_views(panorama: Path, root: Path, stem: str, num: int) -> list[str]:
    """Cut a panorama's views into `images/<stem>_1.jpg`, ...; their paths below `root`."""
    with PIL.Image.open(panorama) as image:
        pixels = np.asarray(image.convert("RGB"))
    files = []
    for number, view in enumerate(cut_views(pixels, num), start=1):
        files.append(f"images/{stem}_{number}.jpg")
        picture = PIL.Image.fromarray(view)
        picture.save(root / files[-1], "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return files


def _value(text: str, name: str) -> str:
    """What an XMP packet says under GPano's `name`, as attribute or element."""
    found = re.search(rf"GPano:{name}\s*(?:=\s*[\"']|>)\s*([^\"'<\s]+)", text)
    return found.group(1) if found else ""
