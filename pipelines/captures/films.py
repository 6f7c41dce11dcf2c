"""Pictures that an archive holds as frames of a film: the wanted ones decoded, in one pass.

An app that writes a pose for each frame of a film means frames by their number. Decoding is that of
any video (`pipelines.captures.video_frames`): whole frames, SDR, no metadata.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedSource
from pipelines.captures.unpack import CaptureArchive
from pipelines.captures.video_frames import DecodePlan, Frame, decode
from pipelines.errors import CaptureError, ToolError
from pipelines.stage import StageContext
from pipelines.tools.ffmpeg import probe

_JPEG_QUALITY = 95
_TOLD_FRAMES = 30
_SLACK_FRAMES = 2
"""How many frames a film may have more or fewer than poses were written; an app that is stopped
loses the last ones."""


class FilmFrames:
    """The frames of films that sources name, as JPEG files below `out` until it is closed."""

    def __init__(self, archive: CaptureArchive, out: Path, *, max_pixels: int) -> None:
        self._archive = archive
        self._folder = out / ".film"
        self._max_pixels = max_pixels
        self.warnings: list[str] = []

    def close(self) -> None:
        """Remove the files."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def decode(
        self, sources: Sequence[PosedSource], num_expected: int | None, ctx: StageContext
    ) -> None:
        """Decode the frames of the one film that sources name, if they do.

        num_expected: how many frames it must have for the numbers to be right, or None.
        Raises CaptureError: video_undecodable, too_large, poses_malformed for another number.
        """
        wanted = {source.frame for source in sources if source.frame is not None}
        names = {source.name for source in sources if source.frame is not None}
        if not names:
            return
        (name,) = names
        ctx.progress(0.0, "Decoding the film")
        self._folder.mkdir(parents=True)
        film = self._folder / "film"
        self._archive.extract(name, film)

        def keep(frame: Frame) -> None:
            if frame.index % _TOLD_FRAMES == 0:
                ctx.progress(0.0, f"Decoding the film, frame {frame.index}")
            if frame.index in wanted:
                frame.save(self._path(frame.index), _JPEG_QUALITY)

        try:
            info = probe(film)
            if info.width * info.height > self._max_pixels:
                raise CaptureError(
                    f'The frames of "{shown(name)}" are {info.width}x{info.height}; '
                    f"{self._max_pixels} pixels are allowed.",
                    code="too_large",
                    hint="Record at a smaller size.",
                )
            plan = DecodePlan(
                info.width, info.height, str(info.hdr), info.matrix, stream=info.stream
            )
            num_decoded = decode(film, plan, ctx, keep)
        except ToolError as error:
            if error.code == "tool_timeout":
                raise
            raise CaptureError(
                f'The film "{shown(name)}" cannot be decoded.',
                code="video_undecodable",
                hint="Export the capture again from the app, and check that its film plays.",
                details=error.details,
            ) from error
        film.unlink()
        self._check_count(name, num_decoded, num_expected)

    def file(self, source: PosedSource) -> Path:
        """The decoded frame of a source. Raises CaptureError image_undecodable where none is."""
        assert source.frame is not None
        path = self._path(source.frame)
        if not path.is_file():
            raise CaptureError(
                f'The film "{shown(source.name)}" has no frame {source.frame}.',
                code="image_undecodable",
                hint="Export the capture again from the app.",
            )
        return path

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.jpg"

    def _check_count(self, name: str, num_decoded: int, num_expected: int | None) -> None:
        if num_expected is None or num_decoded == num_expected:
            return
        told = (
            f'The film "{shown(name)}" has {num_decoded} frames, and poses are there for '
            f"{num_expected}"
        )
        if abs(num_decoded - num_expected) > _SLACK_FRAMES:
            raise CaptureError(
                f"{told}: it cannot be told which pose is whose.",
                code="poses_malformed",
                hint="Export the capture again from the app, or send the film alone to have its "
                "poses found.",
            )
        self.warnings.append(f"{told}; they are counted from the first one.")
