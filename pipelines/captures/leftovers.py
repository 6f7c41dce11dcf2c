"""What of an archive nobody used, told to the sender: by kind, folder and reason, with counts.

`CaptureArchive` knows what was read and what was set aside; no importer has to do anything for it.
Standard library only.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any

from pipelines.captures.archive_rules import shown
from pipelines.captures.magic import foreign_image, image_format, is_zip, video_container
from pipelines.captures.unpack import CaptureArchive

_MOST_GROUPS = 6
_MOST_LISTED = 50

_BY_SUFFIX = {
    "txt": "text file",
    "md": "text file",
    "json": "JSON file",
    "csv": "table",
    "xml": "XML file",
    "exr": "EXR file",
    "depth": "depth file",
    "conf": "confidence file",
    "npy": "array file",
    "npz": "array file",
    **dict.fromkeys(("ply", "obj", "glb", "gltf", "usd", "usdz", "fbx", "stl", "las"), "3D model"),
    **dict.fromkeys(("docx", "xlsx", "pptx", "odt", "ods", "pages", "numbers", "pdf"), "document"),
}

_POSES_BY_NAME = (
    (r"(^|/)(cameras|images|points3D|frames|rigs)\.(bin|txt)$", "COLMAP"),
    (r"(^|/)reconstruction\.json$", "OpenSfM"),
    (r"(^|/)poses_bounds\.npy$", "LLFF"),
    (r"(^|/)odometry\.csv$", "Stray Scanner"),
    (r"(^|/)frame_[0-9]+\.json$", "3D Scanner App"),
    (r"(^|/)transforms(_[a-z]+)?\.json$", "nerfstudio"),
    (r"\.nvm$", "VisualSFM"),
    (r"\.(psx|psz)$", "Metashape"),
    (r"\.rcproj$", "RealityCapture"),
    (r"(^|/)(cameras|sfm)\.(sfm|abc)$", "Meshroom"),
)
_POSES_BY_HEAD = (
    ("xml", b"<document", "Metashape"),
    ("csv", b"#name", "RealityCapture"),
    ("csv", b"#cameras", "RealityCapture"),
)


@dataclass(frozen=True)
class Leftover:
    """Files of one kind in one folder that were not used, for one reason.

    folder: "" or ending with "/". why: "" where nobody knows. example: one of them.
    """

    kind: str
    folder: str
    count: int
    why: str
    example: str

    def as_dict(self) -> dict[str, Any]:
        """As plain JSON, for `capture.json`."""
        return asdict(self)

    def __str__(self) -> str:
        if self.count == 1:
            return f"1 {self.kind} ({shown(self.example)})"
        where = f"in {shown(self.folder)}" if self.folder else "at the top"
        return f"{self.count} {self.kind}s {where}"


def leftovers(archive: CaptureArchive) -> list[Leftover]:
    """What was not used of an archive so far, the most numerous first."""
    groups: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for name, why in archive.unused.items():
        kind, reason = _known(name, archive.head(name))
        folder = name[: name.rfind("/") + 1]
        groups[kind, folder, why or reason].append(name)
    found = [
        Leftover(kind, folder, len(names), why, min(names))
        for (kind, folder, why), names in groups.items()
    ]
    return sorted(found, key=lambda item: (-item.count, item.folder, item.kind, item.why))


def leftover_warnings(found: list[Leftover]) -> list[str]:
    """One sentence for each reason."""
    by_why: dict[str, list[Leftover]] = defaultdict(list)
    for item in found:
        by_why[item.why].append(item)
    warnings = []
    for why, items in by_why.items():
        parts = [str(item) for item in items[:_MOST_GROUPS]]
        rest = sum(item.count for item in items[_MOST_GROUPS:])
        if rest:
            parts.append(f"{rest} other file{'s' if rest > 1 else ''}")
        listed = " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
        verb = "was" if sum(item.count for item in items) == 1 else "were"
        warnings.append(f"{listed} {verb} not used{': ' + why if why else ''}.")
    return warnings


def as_details(found: list[Leftover]) -> dict[str, Any]:
    """For the record: nothing where nothing was left."""
    return {"leftovers": [item.as_dict() for item in found[:_MOST_LISTED]]} if found else {}


def _known(name: str, head: bytes) -> tuple[str, str]:
    """What kind of file it is, and why such files are not used, "" where that depends."""
    foreign = foreign_image(head)
    suffix = name.rpartition("/")[2].rpartition(".")[2].lower()
    if image_format(head):
        return "picture", ""
    if foreign:
        return f"{foreign} picture", f"{foreign} is not read, convert it to PNG or JPEG"
    if video_container(head):
        return "video", "videos are read where they are sent without photos or poses"
    program = _program(name, suffix, head)
    if program:
        return "file", f"camera poses of {program} are not read"
    if is_zip(head) and suffix not in _BY_SUFFIX:
        return "archive", "archives within an archive are not opened; pack what is in them instead"
    return _BY_SUFFIX.get(suffix, "file"), ""


def _program(name: str, suffix: str, head: bytes) -> str | None:
    """The program whose camera poses a file holds, by its name or its first bytes."""
    for pattern, program in _POSES_BY_NAME:
        if re.search(pattern, name):
            return program
    for wanted, mark, program in _POSES_BY_HEAD:
        if suffix == wanted and mark in head:
            return program
    return None
