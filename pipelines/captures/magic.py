"""What a file is by its first bytes; names are never asked. Standard library only."""

from __future__ import annotations

HEAD_BYTES = 256
"""How many of a file's first bytes are looked at: 64 tell what it is, and in a text that many hold
its first lines, by which importers tell their formats from others of the same name."""

_HEVC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs"})
_AV1_BRANDS = frozenset({b"avif", b"avis"})
# Of pictures of either; which it is, is among the brands that follow.
_COMMON_BRANDS = frozenset({b"mif1", b"msf1"})
_HEIF_BRANDS = _HEVC_BRANDS | _AV1_BRANDS | _COMMON_BRANDS
_RAW_BRANDS = frozenset({b"crx "})
_RAW_HEADS = (b"FUJIFILMCCD-RAW", b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FOVb", b"\0MRM")
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
    """The name of an image format that is accepted, else None.

    "JPEG", "PNG", "WEBP", "HEIF", "AVIF", "TIFF", which cameras may write raw photos as too (DNG,
    CR2, NEF, ARW), or "RAW" for a raw photo that is none (CR3, RAF, RW2, ORF).
    """
    if head[:3] == b"\xff\xd8\xff":
        return "JPEG"
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return "PNG"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WEBP"
    if head[4:8] == b"ftyp":
        return _heif_format(head)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return "TIFF"
    return "RAW" if head.startswith(_RAW_HEADS) else None


def _heif_format(head: bytes) -> str | None:
    """What a file of ISO's boxes is, by its brands, where it is a picture."""
    brand = head[8:12]
    if brand in _RAW_BRANDS:
        return "RAW"
    if brand in _COMMON_BRANDS:
        end = min(int.from_bytes(head[:4], "big"), len(head))
        others = {head[place : place + 4] for place in range(16, end, 4)}
        return "AVIF" if others & _AV1_BRANDS else "HEIF"
    if brand in _AV1_BRANDS:
        return "AVIF"
    return "HEIF" if brand in _HEVC_BRANDS else None


def is_exr(head: bytes) -> bool:
    """Whether the bytes open an OpenEXR file."""
    return head[:4] == b"\x76\x2f\x31\x01"


def is_npy(head: bytes) -> bool:
    """Whether the bytes open an array as NumPy saves it."""
    return head[:6] == b"\x93NUMPY"


def foreign_image(head: bytes) -> str | None:
    """The name of a picture format that is recognised but not read ("GIF", ...), else None."""
    if head[:6] in (b"GIF87a", b"GIF89a"):
        return "GIF"
    if head[:12] == b"\0\0\0\x0cJXL \r\n\x87\n" or head[:2] == b"\xff\x0a":
        return "JPEG XL"
    if head[:12] == b"\0\0\0\x0cjP  \r\n\x87\n":
        return "JPEG 2000"
    return None


def is_zip(head: bytes) -> bool:
    """Whether the bytes open a zip archive (also an empty or a split one)."""
    return head[:4] in (b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08")
