"""Decoding a video once, frame by frame, through a pipe: upright, SDR, reduced, with true times.

Frames arrive as planes of full-range BT.601 Y'CbCr 4:2:0, which is what a JPEG holds: the frames
that are kept are written without another conversion of colours. Memory stays at a few frames.
"""

from __future__ import annotations

import math
import queue
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import PIL.Image

from pipelines.captures.hdr import TRANSFERS, sdr_filters, write_pq_table
from pipelines.captures.pauses import Pause
from pipelines.errors import ToolError
from pipelines.stage import StageContext
from pipelines.tools.ffmpeg import passthrough_timing, run_ffmpeg, untrusted_input

Plane = npt.NDArray[np.uint8]

SHARPNESS_SIDE_PX = 960
"""Sharpness is measured at about this long side: below it noise counts less than blur."""

_TIMES_WAIT_S = 60.0
_BLOCK_PX = 16
"""Side of the blocks by which repeated frames are told."""
_REPEAT_MOST = 5.0
_REPEAT_MOSTLY = 2.0
"""Of 255, by which blocks of a repeated frame differ at most, and 99 in 100 of them: with x264 at
a rate factor of 35 by 4.8 and 1.3, where films at three frames a second differ by 18 and 14."""


@dataclass(frozen=True)
class Frame:
    """One decoded frame.

    index: among all decoded frames, 0-based. time_s: since the start of the file.
    luma: [height, width]; chroma: two planes, [ceil(height / 2), ceil(width / 2)]; uint8.
    """

    index: int
    time_s: float
    luma: Plane
    chroma: tuple[Plane, Plane]

    def sharpness(self) -> float:
        """Variance of the Laplacian of the luma: falls with blur; comparable between neighbours.

        Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
        """
        factor = max(1, round(max(self.luma.shape) / SHARPNESS_SIDE_PX))
        rows, columns = (size // factor for size in self.luma.shape)
        cropped = self.luma[: rows * factor, : columns * factor]
        blocks = cropped.reshape(rows, factor, columns, factor)
        small = blocks.mean(axis=(1, 3), dtype=np.float32)
        laplacian = (
            small[:-2, 1:-1] + small[2:, 1:-1] + small[1:-1, :-2] + small[1:-1, 2:]
        ) - 4.0 * small[1:-1, 1:-1]
        return float(laplacian.var())

    def repeats(self, other: Frame) -> bool:
        """Whether nothing but noise of coding tells the frame from another one of its size.

        Means of blocks are compared, without what they have in common: light may change. Where
        the frame is like itself moved by a block, as a plain wall is, the camera may have moved.
        """
        one, two = (_block_means(frame.luma) for frame in (self, other))
        moved = ((one[1:], one[:-1]), (one[:, 1:], one[:, :-1]))
        return _alike(one, two) and not any(_alike(*pair) for pair in moved)

    def save(self, path: Path, quality: int) -> None:
        """Write as a baseline JPEG, 4:2:0, with no metadata."""
        height, width = self.luma.shape
        full = [
            PIL.Image.fromarray(plane.repeat(2, axis=0).repeat(2, axis=1)[:height, :width])
            for plane in self.chroma
        ]
        picture = PIL.Image.merge("YCbCr", [PIL.Image.fromarray(self.luma), *full])
        picture.save(path, "JPEG", quality=quality, subsampling=2)


def _alike(one: npt.NDArray[np.float32], two: npt.NDArray[np.float32]) -> bool:
    """Whether means of blocks of one shape differ by noise only; where there are none they do."""
    if not one.size:
        return True
    apart = np.abs(one - two - np.median(one - two))
    return bool(apart.max() <= _REPEAT_MOST and np.percentile(apart, 99) <= _REPEAT_MOSTLY)


def _block_means(luma: Plane) -> npt.NDArray[np.float32]:
    """Means of square blocks; what is left over at the right and below is not heeded."""
    side = min(_BLOCK_PX, *luma.shape)
    rows, columns = (size // side for size in luma.shape)
    blocks = luma[: rows * side, : columns * side].reshape(rows, side, columns, side)
    means: npt.NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return means


class Crop(NamedTuple):
    """A part of a picture, in its pixels."""

    x: int
    y: int
    width: int
    height: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    def enlarged(self, size: tuple[int, int], whole: tuple[int, int]) -> Crop:
        """The same part of a picture of size `whole` that had been reduced to `size`; none of what
        lies beside it is in there."""
        across, down = whole[0] / size[0], whole[1] / size[1]
        left, top = math.ceil(self.x * across), math.ceil(self.y * down)
        right = min(math.floor((self.x + self.width) * across), whole[0])
        bottom = min(math.floor((self.y + self.height) * down), whole[1])
        return Crop(left, top, right - left, bottom - top)


@dataclass(frozen=True)
class DecodePlan:
    """What is decoded.

    width, height: of the upright, reduced frames. hdr: as in `VideoInfo`. matrix: ffmpeg's name of
    the colour matrix to assume, or None for the one that the video names.
    step_s: at most one frame is delivered per cell of this length (from `start_s` on, on a clock
    that stands still in the `pauses`); 0 for all.
    crop: the part of the upright, unreduced frames that is taken; None for all. whole: their size
    with square pixels, which a crop is a part of.
    stream: as in `VideoInfo`.
    """

    width: int
    height: int
    hdr: str = "none"
    matrix: str | None = None
    start_s: float = 0.0
    step_s: float = 0.0
    crop: Crop | None = None
    whole: tuple[int, int] = (0, 0)
    stream: str = "0:V:0"
    pauses: Sequence[Pause] = ()


def reduced_size(width: int, height: int, long_side_px: int) -> tuple[int, int]:
    """The size with at most that long side, never larger than it was."""
    scale = min(1.0, long_side_px / max(width, height))
    return max(2, round(width * scale)), max(2, round(height * scale))


def filter_chain(plan: DecodePlan, pq_table: Path | None = None) -> str:
    """The ffmpeg filters of a plan; ffmpeg itself puts the rotation in front of them.

    pq_table: see `hdr.sdr_filters`.
    """
    parts = ["showinfo@all=checksum=0"]
    if plan.step_s > 0:
        cell, before = _cell(plan, "t"), _cell(plan, "prev_selected_t")
        condition = f"gt({cell},{before})"
        parts.append(f"select='isnan(prev_selected_t)+{condition}'")
    parts.append("showinfo@kept=checksum=0")
    if plan.matrix is not None:
        parts.append(f"setparams=colorspace={plan.matrix}")
    if plan.crop is not None:
        # Shares of the stored frame, whose pixels need not be square.
        x, y, width, height = plan.crop
        across, down = plan.whole
        parts.append(
            f"crop=iw*{width}/{across}:ih*{height}/{down}:iw*{x}/{across}:ih*{y}/{down}:exact=1"
        )
    parts.append(f"scale={plan.width}:{plan.height}:flags=bicubic+accurate_rnd")
    if plan.hdr in TRANSFERS:
        parts += sdr_filters(plan.hdr, pq_table)
    parts.append("scale=out_color_matrix=bt601:out_range=full,format=yuv420p")
    return ",".join(parts)


def _cell(plan: DecodePlan, time: str) -> str:
    """ffmpeg's expression for the number of the cell that a time is in, as
    `pauses.without_pauses` has it."""
    passed = "".join(f"-{length_s:.9f}*gte({time},{at_s:.9f})" for at_s, length_s in plan.pauses)
    return f"floor(({time}-{plan.start_s:.9f}{passed})/{plan.step_s:.9f})"


class FrameTimes:
    """Reads the time of each delivered frame from what `showinfo` writes to stderr.

    ffmpeg leaves out the `[showinfo@... ]` in front where another message did not end its line, so
    lines are known by their content then: all frames are counted before some are kept, so that a
    frame with the next number is one of all.
    """

    _CONFIG = re.compile(r"config in time_base: (\d+)/(\d+)")
    _FRAME = re.compile(
        r"(?:\[showinfo@(?P<which>all|kept) @ [^\]]*\] )?"
        r"\bn: *(?P<number>\d+) pts: *(?P<pts>-?\d+|NOPTS) +pts_time: *(?P<seconds>\S+)"
    )

    def __init__(self) -> None:
        self.kept: queue.Queue[tuple[int, float]] = queue.Queue()
        self.num_decoded = 0
        self._unit_s: float | None = None
        self._indices: dict[str, int] = {}

    def on_line(self, line: str) -> None:
        """Take the next line of the log."""
        if line.startswith(" "):
            return  # what the file says of itself, and it may say anything
        config = self._CONFIG.search(line)
        if config and int(config.group(2)) > 0:
            self._unit_s = int(config.group(1)) / int(config.group(2))
        frame = self._FRAME.search(line)
        if not frame:
            return
        number, pts = int(frame["number"]), frame["pts"]
        which = frame["which"] or ("all" if number == self.num_decoded else "kept")
        if which == "all":
            self.num_decoded = number + 1
            self._indices[pts] = number
            return
        index = self._indices.get(pts, max(self.num_decoded - 1, 0))
        self._indices.clear()
        self.kept.put((index, self._time_s(pts, frame["seconds"])))

    def _time_s(self, pts: str, seconds: str) -> float:
        """Without a time of its own (nan) a frame has at least its place in the order."""
        if pts == "NOPTS":
            return float("nan")
        # ffmpeg rounds what it says in seconds to six digits: used where the unit is not known.
        return float(seconds) if self._unit_s is None else int(pts) * self._unit_s


def decode(
    path: Path, plan: DecodePlan, ctx: StageContext, on_frame: Callable[[Frame], None]
) -> int:
    """Decode the video at `path` and hand on its frames in order of time.

    Returns how many frames were decoded, also those that were not delivered. A frame's planes are
    its own and may be kept. Raises ToolError and Cancelled, and what `on_frame` raises.
    """
    times = FrameTimes()
    width, height = plan.width, plan.height
    half_w, half_h = (width + 1) // 2, (height + 1) // 2
    frame_bytes = width * height + 2 * half_w * half_h
    pending = bytearray()

    def on_stdout(chunk: bytes) -> None:
        pending.extend(chunk)
        while len(pending) >= frame_bytes:
            data = np.frombuffer(bytes(pending[:frame_bytes]), np.uint8)
            del pending[:frame_bytes]
            try:
                index, time_s = times.kept.get(timeout=_TIMES_WAIT_S)
            except queue.Empty:
                raise ToolError("ffmpeg delivered a frame without its time.") from None
            luma, rest = data[: width * height], data[width * height :]
            blue, red = rest[: half_w * half_h], rest[half_w * half_h :]
            on_frame(
                Frame(
                    index=index,
                    time_s=time_s,
                    luma=luma.reshape(height, width),
                    chroma=(blue.reshape(half_h, half_w), red.reshape(half_h, half_w)),
                )
            )

    with tempfile.TemporaryDirectory(prefix="frames-") as scratch:
        pq_table = Path(scratch) / "pq.cube"
        if plan.hdr == "pq":
            write_pq_table(pq_table)
        stream = untrusted_input(path).output(
            "pipe:1",
            map=plan.stream,
            f="rawvideo",
            vf=filter_chain(plan, pq_table),
            **passthrough_timing(),
            **{"an": None, "sn": None, "dn": None},
        )
        run_ffmpeg(
            stream,
            log_level="info",
            time_limit_s=float("inf"),
            is_cancelled=ctx.is_cancelled,
            on_line=times.on_line,
            on_stdout=on_stdout,
        )
    return times.num_decoded
