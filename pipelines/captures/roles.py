"""What a file's name says that it is not: a photo. Standard library only.

Programs put masks, depth maps, confidence maps, normals and thumbnails into folders of that name,
or put the word before or behind the photo's own name.
"""

from __future__ import annotations

import re

PICTURE_SUFFIX = (
    r"\.(jpe?g|png|webp|tiff?|hei[cf]s?|hif|avif|"
    r"dng|cr[23w]|nef|nrw|arw|srf|sr2|raf|rw2|orf|pef|srw)"
)
"""How names of pictures end, as a pattern."""

_OF_COPIES = frozenset({"edited", "edit", "copy", "of", "small", "large", "reduced", "resized"})
"""Words that programs add to the name of a copy."""

_WHATS = {
    "mask": "masks",
    "masks": "masks",
    "segmentation": "masks",
    "segmentations": "masks",
    "depth": "depth maps",
    "depths": "depth maps",
    "disparity": "depth maps",
    "conf": "confidence maps",
    "confidence": "confidence maps",
    "normals": "normal maps",
    "thumb": "thumbnails",
    "thumbs": "thumbnails",
    "thumbnail": "thumbnails",
    "thumbnails": "thumbnails",
}


def folder_role(name: str) -> str | None:
    """What the folders above a file call it ("masks", "depth maps", ...); None for a photo."""
    return _role(name.rpartition("/")[0])


def file_role(name: str) -> str | None:
    """What a file's own name calls it; None for a photo."""
    return _role(_stem(name))


def named_role(name: str) -> str | None:
    """What a file's name or its folders call it; None for a photo."""
    return folder_role(name) or file_role(name)


def plain_stem(name: str) -> str:
    """A file's name without its folders, its suffix and such words, in small letters.

    "depth/IMG_1_mask.png" and "photos/IMG_1.jpg" have the same one, "img1".
    """
    words = re.findall(r"[a-z]+|[0-9]+", _stem(name).lower())
    return "".join(word for word in words if word not in _WHATS)


def original_stem(name: str) -> str:
    """`plain_stem` without words that say that it is a copy: "img0001" of "IMG_0001-edited.jpg"."""
    words = re.findall(r"[a-z]+|[0-9]+", _stem(name).lower())
    return "".join(word for word in words if word not in _WHATS and word not in _OF_COPIES)


def _stem(name: str) -> str:
    """The name without folders and suffixes; "a.jpg.png", as COLMAP calls masks, is "a"."""
    base = name.rpartition("/")[2]
    return re.sub(rf"({PICTURE_SUFFIX})+$", "", base, flags=re.IGNORECASE)


def _role(text: str) -> str | None:
    words = re.findall(r"[a-z]+", text.lower())
    return next((_WHATS[word] for word in words if word in _WHATS), None)
