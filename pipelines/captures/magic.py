"""What a file is by its first bytes; names are never asked. Standard library only."""

from __future__ import annotations

HEAD_BYTES = 256
"""How many of a file's first bytes are looked at: 64 tell what it is, and in a text that many hold
its first lines, by which importers tell their formats from others of the same name."""

_HEIF_BRANDS = frozenset(
    {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis"}
)
_RAW_BRANDS = frozenset({b"crx "})
# QuickTime files of old start without `ftyp`, at one of these boxes.
_QUICKTIME_BOXES = frozenset({b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot"})


def video_container(head: bytes) -> str | None:
    """ffmpeg's name of the container: "mov", "matroska" or "avi"; None for anything else."""
    box = head[4:8]
    if box == b"ftyp":
        return None if head[8:12] in _HEIF_BRANDS | _RAW_BRANDS else "mov"
    # Text may hold those letters there too, but does not start with a box's size.
    if box in _QUICKTIME_BOXES and head[0] < 0x20:
        return "mov"
    if head[:4] == b"\x1a\x45\xdf\xa3":
        return "matroska"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "avi"
    return None


def image_format(head: bytes) -> str | None:
    """Pillow's name of an image format that is accepted: "JPEG", "PNG" or "WEBP"; else None."""
    if head[:3] == b"\xff\xd8\xff":
        return "JPEG"
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return "PNG"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WEBP"
    return None


def is_exr(head: bytes) -> bool:
    """Whether the bytes open an OpenEXR file."""
    return head[:4] == b"\x76\x2f\x31\x01"


def foreign_image(head: bytes) -> str | None:
    """The name of a photo format that is recognised but not read ("HEIC", ...), else None."""
    if head[4:8] == b"ftyp":
        if head[8:12] in _HEIF_BRANDS:
            return "AVIF" if head[8:11] == b"avi" else "HEIC"
        if head[8:12] in _RAW_BRANDS:
            return "camera raw"
    if head[:4] in (b"II*\x00", b"MM\x00*"):
        return "TIFF or camera raw"
    if head[:6] in (b"GIF87a", b"GIF89a"):
        return "GIF"
    return None


def is_zip(head: bytes) -> bool:
    """Whether the bytes open a zip archive (also an empty or a split one)."""
    return head[:4] in (b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08")
