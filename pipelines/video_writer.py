"""Pictures in, an H.264 MP4 out: plays in browsers, written while the pictures are being made.

yuv420p with even sides, BT.709 tags, `+faststart` (the index comes first). ffmpeg is fed through a
pipe by a thread of its own, so that encoding runs beside rendering.
"""

from __future__ import annotations

import contextlib
import queue
import subprocess
import threading
from pathlib import Path
from types import TracebackType
from typing import Any

import ffmpeg
import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ToolError
from pipelines.tools.ffmpeg import compile_command

_WAITING_FRAMES = 8
_CLOSE_TIMEOUT_S = 300.0
_LOG_LINES = 20


class VideoWriter:
    """A context manager: `write` each frame; leaving the block normally finishes the file.

    Leaving it by an exception (a cancel too) kills ffmpeg and removes the file. Raises ToolError
    where ffmpeg fails, with its last lines in `details["log"]`.
    """

    def __init__(self, path: Path, width: int, height: int, fps: float, crf: int) -> None:
        if width % 2 or height % 2:
            raise ValueError(f"yuv420p needs even sides, not {width}x{height}")
        self._path = path
        self._shape = (height, width, 3)
        stream = ffmpeg.input(
            "pipe:", format="rawvideo", pix_fmt="rgb24", s=f"{width}x{height}", framerate=fps
        ).output(
            str(path),
            vcodec="libx264",
            pix_fmt="yuv420p",
            crf=crf,
            preset="medium",
            vf="scale=out_color_matrix=bt709:out_range=tv",
            colorspace="bt709",
            color_primaries="bt709",
            color_trc="bt709",
            movflags="+faststart",
        )
        self._command = compile_command(stream, log_level="warning")
        self._frames: queue.Queue[bytes | None] = queue.Queue(maxsize=_WAITING_FRAMES)
        self._process: subprocess.Popen[bytes] | None = None
        self._log: list[str] = []
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> VideoWriter:
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        self._threads = [
            threading.Thread(target=self._feed, args=(self._process,), daemon=True),
            threading.Thread(target=self._read_log, args=(self._process,), daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        return self

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Add one frame, [H, W, 3] uint8 sRGB. Waits while ffmpeg is several frames behind."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(f"expected uint8 {self._shape}, got {frame.dtype} {frame.shape}")
        data = frame.tobytes()
        while True:
            if not self._threads[0].is_alive():
                raise self._failure()
            with contextlib.suppress(queue.Full):
                self._frames.put(data, timeout=0.5)
                return

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        process = self._process
        assert process is not None
        if kind is not None:
            self._abort(process)
            return
        self._finish(process)

    def _finish(self, process: subprocess.Popen[bytes]) -> None:
        """Send what waits, let ffmpeg end, and check that it was content."""
        while self._threads[0].is_alive():
            with contextlib.suppress(queue.Full):
                self._frames.put(None, timeout=0.5)
                break
        try:
            code = process.wait(timeout=_CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._abort(process)
            raise self._failure() from None
        for thread in self._threads:
            thread.join(timeout=10.0)
        if code != 0 or not self._path.is_file():
            self._path.unlink(missing_ok=True)
            raise self._failure(code)

    def _abort(self, process: subprocess.Popen[bytes]) -> None:
        process.kill()
        process.wait()
        while not self._frames.empty():
            with contextlib.suppress(queue.Empty):
                self._frames.get_nowait()
        with contextlib.suppress(queue.Full):
            self._frames.put_nowait(None)
        for thread in self._threads:
            thread.join(timeout=10.0)
        self._path.unlink(missing_ok=True)

    def _feed(self, process: subprocess.Popen[bytes]) -> None:
        """The feeding thread: until None comes or ffmpeg closes its end."""
        pipe: Any = process.stdin
        # A pipe that breaks means that ffmpeg ended: its exit code and log tell why.
        with contextlib.suppress(BrokenPipeError, ValueError):
            while (data := self._frames.get()) is not None:
                pipe.write(data)
        with contextlib.suppress(BrokenPipeError, ValueError):
            pipe.close()

    def _read_log(self, process: subprocess.Popen[bytes]) -> None:
        pipe: Any = process.stderr
        for line in pipe:
            self._log.append(line.decode("utf-8", "replace").rstrip())
            del self._log[:-_LOG_LINES]
        pipe.close()

    def _failure(self, code: int | None = None) -> ToolError:
        ended = "did not end" if code is None else f"ended with code {code}"
        return ToolError(
            f"ffmpeg {ended} while encoding {self._path.name}.",
            hint="Check that the disk has room and that this ffmpeg was built with libx264.",
            details={"log": list(self._log)},
        )
