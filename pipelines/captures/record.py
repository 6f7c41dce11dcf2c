"""`ingest/capture.json`: what a capture is, for every later stage and for the report."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

CAPTURE_JSON = "capture.json"


@dataclass(frozen=True)
class CaptureRecord:
    """What ingest found and wrote.

    kind: one of `catalogue.KINDS`. filename: what the sender called it; a label, never a path.
    sha256: of the bytes that were sent.
    num_images: pictures in `ingest/images`; 0 for a video.
    video: `VideoInfo` as plain data, for a film; of several clips that of the longest, with the
    sums of their lengths and numbers of frames.
    clips: `pipelines.captures.clips.Clip` as plain data, for a film.
    images: file (relative to `ingest/`), source (name in the archive), width, height, exif (see
    `pipelines.captures.exif`).
    """

    kind: str
    filename: str
    sha256: str
    num_images: int = 0
    video: dict[str, Any] | None = None
    images: list[dict[str, Any]] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    clips: list[dict[str, Any]] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        """Write `capture.json` into the stage's folder."""
        (folder / CAPTURE_JSON).write_text(json.dumps(asdict(self), indent=1), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> CaptureRecord:
        """Read what `save` wrote. Raises FileNotFoundError, and TypeError for another format."""
        return cls(**json.loads((folder / CAPTURE_JSON).read_text("utf-8")))


@dataclass(frozen=True)
class FoundPoints:
    """Points in the world of `cameras.json`. places: [P, 3] float32. colors: [P, 3] uint8."""

    places: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Found:
    """What the reader of one kind of capture has written below the stage's folder.

    points: to be written beside its `cameras.json`, or None.
    """

    images: list[dict[str, Any]] = field(default_factory=list)
    video: dict[str, Any] | None = None
    details: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    points: FoundPoints | None = None
    clips: list[dict[str, Any]] = field(default_factory=list)
