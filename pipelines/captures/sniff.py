"""What an uploaded file is, by its content and never by its name.

The API imports this file: standard library only. Nothing is decoded and nothing unpacked; only an
archive's directory and the first bytes of its entries are read.

The formats, and which comes first where several would do: `pipelines.captures.catalogue`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.captures.archive_rules import (
    ArchiveLimits,
    checked_entries,
    copy_entry,
    head_of,
    is_archive,
    open_archive,
)
from pipelines.captures.catalogue import claimed
from pipelines.captures.importer import Claim, Listing
from pipelines.captures.magic import (
    HEAD_BYTES,
    foreign_image,
    image_format,
    is_zip,
    video_container,
)
from pipelines.errors import CaptureError

_ACCEPTED = (
    "Send a video (MP4, MOV, MKV, WebM, AVI), a .zip of photos (JPEG, HEIC, raw) or of several "
    "videos, or a .zip of an app export; .tar and .tar.gz do as well."
)


@dataclass(frozen=True)
class Sniffed:
    """What a file is.

    kind: one of `catalogue.KINDS`. claim: where in it the capture starts, and why it is of that
    kind. details: small JSON-able facts.
    """

    kind: str
    claim: Claim
    details: dict[str, Any] = field(default_factory=dict)


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
    if is_archive(path, head):
        return _sniff_archive(path, limits or ArchiveLimits())
    found = claimed(Listing({"": head}, is_archive=False))
    if found is None:
        raise _unknown(head, filename)
    importer, claim = found
    return Sniffed(importer.kind, claim, {"container": video_container(head)})


def _unknown(head: bytes, filename: str) -> CaptureError:
    image = image_format(head) or foreign_image(head)
    if image:
        return CaptureError(
            f"The file is a single picture ({image}); one picture has no depth.",
            code="unknown_type",
            hint="Send a video, or a .zip of many photos of the subject.",
        )
    if head.startswith((b"Rar!", b"7z\xbc\xaf", b"\x1f\x8b")) or head[:3] == b"BZh":
        return CaptureError(
            "The file is packed, but neither a zip nor a .tar or .tar.gz.",
            code="unknown_type",
            hint="Pack the photos as .zip and send that.",
        )
    alone = claimed(Listing({filename.rpartition("/")[2] or "file": head}))
    if alone is not None:
        return CaptureError(
            f"The file lists camera poses ({alone[0].kind}); the pictures that it lists are not "
            "with it.",
            code="unknown_type",
            hint="Pack it into a .zip together with those pictures, and send that.",
        )
    suffix = Path(filename).suffix[:12]
    named = f' (it is called "{suffix}")' if suffix.isprintable() and suffix else ""
    return CaptureError(
        f"The file is of a type that is not known{named}.", code="unknown_type", hint=_ACCEPTED
    )


def _sniff_archive(path: Path, limits: ArchiveLimits) -> Sniffed:
    with open_archive(path, limits) as archive:
        entries = checked_entries(archive, limits)
        heads = {name: head_of(archive, info) for name, info in entries.items()}
        listing = Listing(
            heads,
            copy=lambda name, target: copy_entry(archive, entries[name], target),
            num_bytes={name: info.file_size for name, info in entries.items()},
        )
        found = claimed(listing)
    if found is None:
        raise _no_images(heads)
    importer, claim = found
    return Sniffed(
        importer.kind,
        claim,
        {
            "num_images": len(listing.pictures),
            "num_entries": len(entries),
            "unpacked_bytes": sum(info.file_size for info in entries.values()),
            "root": claim.root,
            "recognised_by": claim.why,
        },
    )


def _no_images(heads: Mapping[str, bytes]) -> CaptureError:
    foreign = sorted({kind for head in heads.values() if (kind := foreign_image(head))})
    hint = "Put the photos (JPEG, HEIC, camera raw, PNG, WebP, AVIF, TIFF) into the .zip."
    if foreign:
        hint = f"{', '.join(foreign)} pictures are not supported yet: convert them to JPEG."
    elif any(is_zip(head) for head in heads.values()):
        hint = "It holds other archives, which are not opened: pack what is in them instead."
    return CaptureError(
        f"The archive has {len(heads)} files, and none is a picture that can be read.",
        code="no_images",
        hint=hint,
    )
