"""What an uploaded file is, by its content and never by its name.

The API imports this file: standard library only. Nothing is decoded and nothing unpacked; only an
archive's directory and the first bytes of its entries are read.

Kinds: `video`; `images` (a zip of photos); `nerfstudio` (a zip with `transforms.json`); `polycam`
(a raw data export); `record3d` (an "EXR + RGB" export or an `.r3d` file).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.captures.archive_rules import (
    ArchiveLimits,
    checked_entries,
    head_of,
    open_archive,
)
from pipelines.captures.magic import (
    HEAD_BYTES,
    foreign_image,
    image_format,
    is_zip,
    video_container,
)
from pipelines.errors import CaptureError

__all__ = ["KINDS", "ArchiveLimits", "Layout", "Sniffed", "layout_of", "sniff"]

KINDS = ("video", "images", "nerfstudio", "polycam", "record3d")
_ACCEPTED = "Send a video (MP4, MOV, MKV, WebM, AVI), a .zip of photos, or a .zip of an app export."


@dataclass(frozen=True)
class Sniffed:
    """What a file is. kind: one of `KINDS`. details: small JSON-able facts."""

    kind: str
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Layout:
    """Which kind of capture an archive holds, and the folder in it where that starts.

    root: "" or a folder's name ending with "/".
    """

    kind: str
    root: str


def sniff(path: Path, filename: str, limits: ArchiveLimits | None = None) -> Sniffed:
    """What the file at `path` is; `filename` (what the sender called it) only serves messages.

    Raises CaptureError: empty_file, unknown_type, no_images, archive_unsafe, archive_bomb,
    archive_encrypted, archive_damaged.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if not head:
        raise CaptureError(
            "The file is empty.", code="empty_file", hint="Check the file and send it again."
        )
    container = video_container(head)
    if container:
        return Sniffed("video", {"container": container})
    if is_zip(head):
        return _sniff_zip(path, limits or ArchiveLimits())
    raise _unknown(head, filename)


def _unknown(head: bytes, filename: str) -> CaptureError:
    image = image_format(head) or foreign_image(head)
    if image:
        return CaptureError(
            f"The file is a single picture ({image}); one picture has no depth.",
            code="unknown_type",
            hint="Send a video, or a .zip of many photos (JPEG, PNG or WebP) of the subject.",
        )
    if head.startswith((b"Rar!", b"7z\xbc\xaf", b"\x1f\x8b")) or head[:3] == b"BZh":
        return CaptureError(
            "The file is an archive, but not a zip.",
            code="unknown_type",
            hint="Pack the photos as .zip and send that.",
        )
    suffix = Path(filename).suffix[:12]
    named = f' (it is called "{suffix}")' if suffix.isprintable() and suffix else ""
    return CaptureError(
        f"The file is of a type that is not known{named}.", code="unknown_type", hint=_ACCEPTED
    )


def _sniff_zip(path: Path, limits: ArchiveLimits) -> Sniffed:
    with open_archive(path) as archive:
        entries = checked_entries(archive, limits)
        heads = {name: head_of(archive, info) for name, info in entries.items()}
    images = [name for name, head in heads.items() if image_format(head)]
    layout = layout_of(entries, images)
    if not images:
        raise _no_images(heads)
    return Sniffed(
        layout.kind,
        {
            "num_images": len(images),
            "num_entries": len(entries),
            "unpacked_bytes": sum(info.file_size for info in entries.values()),
            "root": layout.root,
        },
    )


def layout_of(names: Iterable[str], images: Iterable[str]) -> Layout:
    """The kind of an archive by the names in it. images: those that are pictures by content."""
    known = set(names)
    pictures = set(images)
    by_depth = sorted(known, key=lambda name: (name.count("/"), name))
    for name in by_depth:
        folder, _, base = name.rpartition("/")
        root = folder + "/" if folder else ""
        if base == "transforms.json":
            return Layout("nerfstudio", root)
        if base == "metadata.json" and _any_below(pictures, root + "rgb/"):
            return Layout("record3d", root)
        if base == "metadata" and _any_below(pictures, root + "rgbd/"):
            return Layout("record3d", root)
    for name in by_depth:
        before, mark, _ = ("/" + name).partition("/keyframes/")
        root = (before + "/").lstrip("/")
        if mark and any(
            _any_below(pictures, f"{root}keyframes/{folder}/")
            for folder in ("corrected_images", "images")
        ):
            return Layout("polycam", root)
    return Layout("images", "")


def _any_below(names: set[str], folder: str) -> bool:
    return any(name.startswith(folder) for name in names)


def _no_images(heads: dict[str, bytes]) -> CaptureError:
    foreign = sorted({kind for head in heads.values() if (kind := foreign_image(head))})
    videos = sum(video_container(head) is not None for head in heads.values())
    hint = "Put the photos (JPEG, PNG or WebP) into the .zip."
    if foreign:
        hint = f"{', '.join(foreign)} pictures are not supported yet: convert them to JPEG."
    elif videos:
        hint = "Send the video by itself, not in a .zip."
    return CaptureError(
        f"The archive has {len(heads)} files, and none is a picture that can be read.",
        code="no_images",
        hint=hint,
    )
