"""Pictures in, an MP4 out: H.264, HEVC or AV1, written while the pictures are being made.

yuv420p with even sides, `+faststart` (the index comes first). Matrix, primaries and transfer are
tagged BT.709, in the stream and in the container (`colr`): players guess what is not. HEVC is
tagged `hvc1`, as Apple's players want it. There is a key frame each second at least: to show any
moment, as where somebody scrubs, a player decodes all since the last one. ffmpeg is fed through a
pipe by a thread of its own, so that encoding runs beside rendering.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from pathlib import Path
from types import TracebackType

import ffmpeg
import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ToolError
from pipelines.exports.formats.spherical import mark_equirectangular
from pipelines.tools.ffmpeg import compile_command
from pipelines.tools.process import Program

_WAITING_FRAMES = 8
_CLOSE_LIMIT_S = 300.0
_POLL_S = 0.5
_TAGGED = (
    "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709"
)
"""What each frame says of its colours overrules what is asked of the encoder: raw pictures say
nothing of primaries and transfer, and so would the file."""
_LEAST_BETWEEN_KEY_FRAMES = 12
_CODECS: dict[str, dict[str, str]] = {
    "h264": {"vcodec": "libx264", "preset": "medium", "x264-params": "threads=6"},
    "hevc": {
        "vcodec": "libx265",
        "preset": "medium",
        "tag:v": "hvc1",
        "x265-params": "log-level=warning:pools=6:frame-threads=2:open-gop=0",
    },
    "av1": {"vcodec": "libsvtav1", "preset": "8"},
}
"""ffmpeg's options of each.

How many frames x264 and x265 work on at once changes what they find, so that the number is the same
on every machine, not that of its cores. SVT-AV1 writes the same whatever it is.
"""


class VideoWriter:
    """A context manager: `write` each frame; leaving the block normally finishes the file.

    equirectangular: whether the file says that its picture is a whole sphere.
    Leaving it by an exception (a cancel too) ends ffmpeg and removes the file. Raises ToolError
    where ffmpeg fails, with its last lines in `details["log"]`.
    """

    def __init__(
        self,
        path: Path,
        width: int,
        height: int,
        fps: float,
        crf: int,
        codec: str = "h264",
        equirectangular: bool = False,
    ) -> None:
        if width % 2 or height % 2:
            raise ValueError(f"yuv420p needs even sides, not {width}x{height}")
        self._path = path
        self._shape = (height, width, 3)
        self._equirectangular = equirectangular
        options = _CODECS[codec]
        self._hint = (
            f"Check that the disk has room and that this ffmpeg was built with {options['vcodec']}."
        )
        stream = ffmpeg.input(
            "pipe:", format="rawvideo", pix_fmt="rgb24", s=f"{width}x{height}", framerate=fps
        ).output(
            str(path),
            pix_fmt="yuv420p",
            crf=crf,
            g=max(round(fps), _LEAST_BETWEEN_KEY_FRAMES),
            vf=_TAGGED,
            colorspace="bt709",
            color_primaries="bt709",
            color_trc="bt709",
            movflags="+faststart",
            **options,
        )
        command = compile_command(stream, log_level="warning")
        self._program = Program(command, stdin=True)
        self._frames: queue.Queue[bytes | None] = queue.Queue(maxsize=_WAITING_FRAMES)
        self._feeder = threading.Thread(target=self._feed, daemon=True)
        self._failure: ToolError | None = None

    def __enter__(self) -> VideoWriter:
        self._program.__enter__()
        self._feeder.start()
        return self

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Add one frame, [H, W, 3] uint8 sRGB. Waits while ffmpeg is several frames behind."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(f"expected uint8 {self._shape}, got {frame.dtype} {frame.shape}")
        self._put(frame.tobytes())

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        complete = False
        try:
            if kind is None:
                self._finish()
                complete = True
        finally:
            self._program.kill()
            self._drain()
            self._program.__exit__(kind, error, trace)
            if not complete:
                self._path.unlink(missing_ok=True)

    def _finish(self) -> None:
        """Send what waits, let ffmpeg end, and check that it was content."""
        self._put(None)
        self._feeder.join(_CLOSE_LIMIT_S)
        if self._feeder.is_alive():
            self._program.kill()
            self._feeder.join()
        if self._failure is not None:
            raise self._explained(self._failure)
        try:
            self._program.wait(_CLOSE_LIMIT_S)
        except ToolError as failure:
            raise self._explained(failure) from failure
        if self._equirectangular:
            mark_equirectangular(self._path)

    def _put(self, data: bytes | None) -> None:
        """Hand a frame to the feeder, or None for the end. Raises why the feeder gave up."""
        while True:
            if self._failure is not None:
                raise self._explained(self._failure)
            with contextlib.suppress(queue.Full):
                self._frames.put(data, timeout=_POLL_S)
                return

    def _drain(self) -> None:
        """Leave only the end in the queue, and wait for the feeder to see it."""
        while self._feeder.is_alive():
            with contextlib.suppress(queue.Empty):
                while True:
                    self._frames.get_nowait()
            with contextlib.suppress(queue.Full):
                self._frames.put_nowait(None)
            self._feeder.join(_POLL_S)

    def _feed(self) -> None:
        """The feeding thread: until None comes or ffmpeg ends."""
        try:
            while (data := self._frames.get()) is not None:
                self._program.write(data)
        except ToolError as error:
            self._failure = error

    def _explained(self, failure: ToolError) -> ToolError:
        """The program's failure, told without the last line of its log, which may hold a path."""
        hint = self._hint if failure.hint == ToolError.hint else failure.hint
        return ToolError(
            f"ffmpeg failed while encoding {self._path.name}.",
            code=failure.code,
            hint=hint,
            details=failure.details,
        )
