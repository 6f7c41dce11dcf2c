"""Pictures in, a zip of numbered PNG files out: what editing programs take as a sequence."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats.archive import entry

_QUICK = 3
"""zlib's level: larger by some percent, and several times faster, than the default."""


class FramesWriter:
    """A context manager: `write` each frame of a sequence; leaving it by an exception removes the
    file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._archive = zipfile.ZipFile(path, "w")
        self._counts: dict[str, int] = {}

    def __enter__(self) -> FramesWriter:
        return self

    def write(self, sequence: str, frame: NDArray[np.uint8]) -> None:
        """Add one frame, [H, W, 3] uint8 sRGB, as `<sequence>/00001.png` and so on."""
        number = self._counts[sequence] = self._counts.get(sequence, 0) + 1
        held = io.BytesIO()
        Image.fromarray(frame).save(held, "PNG", compress_level=_QUICK)
        self._archive.writestr(
            entry(f"{sequence}/{number:05d}.png", compressed=False), held.getvalue()
        )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._archive.close()
        if kind is not None:
            self._path.unlink(missing_ok=True)
