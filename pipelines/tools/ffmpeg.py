"""ffmpeg: find it, ask it what a video is, and open untrusted files with it safely.

The wheel brings no ffprobe, so `probe` reads what `ffmpeg -i` says on stderr, whichever ffmpeg it
is; known from releases 5 to 9. Commands are composed with ffmpeg-python.

An untrusted file is opened with the demuxer that its first bytes name and no other, so that a
playlist cannot make ffmpeg read other files or addresses (CVE-2016-1897, CVE-2017-9993).
"""

from __future__ import annotations

import functools
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import ffmpeg
import imageio_ffmpeg

from pipelines.captures.magic import HEAD_BYTES, video_container
from pipelines.errors import CaptureError, ToolError
from pipelines.tools.process import ProgramResult, run_program

ENVIRONMENT_VARIABLE = "NERFWORKS_FFMPEG"
PROBE_LIMIT_S = 60.0

# ffmpeg 5 to 9 leave with these: 8-bit forms of AVERROR_INVALIDDATA, EINVAL, ENOMEM, ENOSPC.
_ADVICE = {
    183: "The file is damaged or not of the type it claims: play it, or export it again.",
    234: "The file or an option was refused: play it, or export it again as MP4 (H.264).",
    244: "The machine ran out of memory: use smaller pictures or a larger machine.",
    228: "The disk is full: free some space and try again.",
}
_YUV = ("yuv", "nv", "uyvy", "yuyv", "p0")
_MATRICES = frozenset(
    {"bt709", "fcc", "bt470bg", "smpte170m", "smpte240m", "ycgco", "bt2020nc", "bt2020c", "gbr"}
)
_FORMATS = "mov,matroska,avi"
_MAX_ALLOC_BYTES = 2**31 - 1


@dataclass(frozen=True)
class VideoInfo:
    """What a video says of itself.

    container: "mov", "matroska" or "avi". codec: ffmpeg's name, such as "h264".
    width, height: pixels of an upright frame, after `rotation_deg` and with square pixels.
    rotation_deg: 0, 90, 180 or 270, clockwise turn that makes a stored frame upright.
    fps: mean frames per second, None where the file does not say.
    duration_s: of the whole file, None where the file does not say.
    hdr: "none", "hlg", "pq", or "dolby" (Dolby Vision without a compatible base layer).
    matrix: where the file does not name its colour matrix, ffmpeg's name of the one to assume.
    projection: ffmpeg's name of a 360-degree projection, such as "equirectangular"; "" for none.
    num_frames: None unless counted.
    stream: ffmpeg's name of the stream that is the film.
    """

    container: str
    codec: str
    width: int
    height: int
    rotation_deg: int
    fps: float | None
    duration_s: float | None
    hdr: str
    pix_fmt: str
    color: str = ""
    matrix: str | None = None
    projection: str = ""
    num_frames: int | None = None
    stream: str = "0:V:0"

    def as_dict(self) -> dict[str, Any]:
        """As plain JSON, for `capture.json`."""
        return asdict(self)


def ffmpeg_executable() -> str:
    """The ffmpeg to use: NERFWORKS_FFMPEG, else the one on PATH, else the wheel's.

    Raises ToolError where there is none.
    """
    chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    if chosen:
        found = shutil.which(chosen)
        if not found:
            raise ToolError(
                f"{ENVIRONMENT_VARIABLE} names a program that cannot be run.",
                code="tool_missing",
                hint=f"Set {ENVIRONMENT_VARIABLE} to an ffmpeg, or unset it.",
            )
        return found
    on_path = shutil.which("ffmpeg")
    if on_path:
        return on_path
    try:
        wheel: str = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise ToolError(
            "There is no ffmpeg on this machine.",
            code="tool_missing",
            hint="Install ffmpeg, or the Python package imageio-ffmpeg.",
        ) from error
    return wheel


@functools.cache
def _ask(executable: str, question: str) -> str:
    """What the program answers on stdout to `-version`, `-filters` and the like."""
    answer: list[bytes] = []
    run_program(
        [executable, "-hide_banner", question],
        time_limit_s=PROBE_LIMIT_S,
        on_stdout=answer.append,
    )
    return b"".join(answer).decode("utf-8", "replace")


def ffmpeg_version() -> str:
    """Such as "7.1.1"; "unknown" where the program does not say."""
    match = re.search(r"ffmpeg version n?(\S+)", _ask(ffmpeg_executable(), "-version"))
    return match.group(1) if match else "unknown"


def has_filter(name: str) -> bool:
    """Whether this ffmpeg was built with a filter."""
    listing = _ask(ffmpeg_executable(), "-filters")
    return re.search(rf"^\s*\S+\s+{re.escape(name)}\s", listing, re.MULTILINE) is not None


def passthrough_timing() -> dict[str, str]:
    """Output option that keeps every frame with its own time; renamed in release 5.1."""
    match = re.match(r"(\d+)\.(\d+)", ffmpeg_version())
    if match and (int(match.group(1)), int(match.group(2))) < (5, 1):
        return {"vsync": "passthrough"}
    return {"fps_mode": "passthrough"}


def container_of(path: Path) -> str:
    """The container by the file's first bytes. Raises CaptureError for anything but a video."""
    with path.open("rb") as file:
        container = video_container(file.read(HEAD_BYTES))
    if container is None:
        raise CaptureError(
            "The file is not a video of a known container.",
            code="unknown_type",
            hint="Send an MP4, MOV, MKV, WebM or AVI file.",
        )
    return container


def untrusted_input(path: Path, start_s: float = 0.0) -> Any:
    """An ffmpeg-python input stream that opens a user's file with its own demuxer only.

    start_s: what lies before that time is passed over.
    Raises CaptureError for anything but a video of a known container.
    """
    return ffmpeg.input(
        str(path.resolve()),
        f=container_of(path),
        format_whitelist=_FORMATS,
        protocol_whitelist="file,pipe",
        max_alloc=_MAX_ALLOC_BYTES,
        **({"ss": f"{start_s:.6f}"} if start_s > 0 else {}),
    )


def compile_command(stream: Any, *, log_level: str = "error") -> list[str]:
    """The argument list of an ffmpeg-python output stream, never waiting for a keyboard."""
    options = ["-nostdin", "-hide_banner", "-nostats", "-loglevel", log_level, "-y"]
    arguments: list[str] = ffmpeg.get_args(stream)
    return [ffmpeg_executable(), *options, *arguments]


def run_ffmpeg(
    stream: Any,
    *,
    log_level: str = "error",
    time_limit_s: float = 3600.0,
    is_cancelled: Callable[[], bool] = lambda: False,
    on_line: Callable[[str], None] | None = None,
    on_stdout: Callable[[bytes], None] | None = None,
) -> ProgramResult:
    """Run an ffmpeg-python output stream to its end; see `tools.process.Program` for the rest."""
    return run_program(
        compile_command(stream, log_level=log_level),
        time_limit_s=time_limit_s,
        is_cancelled=is_cancelled,
        on_line=on_line,
        on_stdout=on_stdout,
        advice=_ADVICE,
    )


def probe(path: Path) -> VideoInfo:
    """What an untrusted video file is, from its headers; nothing is decoded.

    Raises CaptureError: unknown_type, video_truncated, no_video_stream, video_undecodable.
    """
    container = container_of(path)
    lines: list[str] = []
    # With no output named, ffmpeg prints what it found and leaves with an error: expected here.
    argv = compile_command(untrusted_input(path).output("-", f="null"), log_level="info")
    argv = argv[: argv.index("-i") + 2]
    try:
        run_program(argv, time_limit_s=PROBE_LIMIT_S, on_line=lines.append)
    except ToolError as error:
        if error.code == "tool_timeout":
            raise
    return parse_probe(container, lines)


def parse_probe(container: str, lines: Sequence[str]) -> VideoInfo:
    """`VideoInfo` from the stderr lines of `ffmpeg -i`. Raises CaptureError as `probe` does."""
    text = "\n".join(lines)
    if not re.search(r"^Input #0", text, re.MULTILINE):
        if "moov atom not found" in text or "ended prematurely" in text or "EBML" in text:
            raise CaptureError(
                "The video is cut off: its index is missing.",
                code="video_truncated",
                hint="Upload the file again; it was not copied or recorded to its end.",
            )
        raise CaptureError(
            "The video cannot be opened: it is damaged or not what it claims to be.",
            code="video_undecodable",
            hint="Check that it plays, or export it again as MP4 (H.264 or HEVC).",
        )
    specifier, stream, side_data = _video_stream(lines)
    codec, pix_fmt, color, width, height = _picture(stream)
    rotation = _rotation(side_data)
    width, height = _square_pixels(stream, width, height)
    if rotation in (90, 270):
        width, height = height, width
    hdr = _hdr(color, side_data)
    return VideoInfo(
        container=container,
        codec=codec,
        width=width,
        height=height,
        rotation_deg=rotation,
        fps=_rate(stream),
        duration_s=_duration(text),
        hdr=hdr,
        pix_fmt=pix_fmt,
        color=color,
        matrix=_assumed_matrix(pix_fmt, color, width, height) if hdr == "none" else None,
        projection=_projection(side_data),
        stream=specifier,
    )


def _video_stream(lines: Sequence[str]) -> tuple[str, str, str]:
    """ffmpeg's name of the video stream that is the film, its line, and the lines below it.

    That is the largest one, the first of several as large: cameras keep a preview beside the film.
    Cover pictures and thumbnails are none. Raises CaptureError no_video_stream.
    """
    found = [
        (match.group(1), number)
        for number, line in enumerate(lines)
        if (match := re.match(r"\s+Stream #(0:\d+).*: Video: ", line))
        and "(attached pic)" not in line
        and "(timed thumbnails)" not in line
    ]
    if not found:
        raise CaptureError(
            "The file has no video stream.",
            code="no_video_stream",
            hint="Send a file with pictures in it; this one holds sound or data only.",
        )
    # Phones keep a few large stills beside a film, as a stream of its own.
    fastest = max(_rate(lines[number]) or 0.0 for _, number in found)
    moving = [one for one in found if (_rate(lines[one[1]]) or 0.0) >= fastest / 4]
    specifier, start = max(moving, key=lambda item: _num_pixels(lines[item[1]]))
    below = []
    for line in lines[start + 1 :]:
        if re.match(r"\s+Stream #|\s*Stream mapping|Output #|At least one output", line):
            break
        below.append(line)
    return specifier, lines[start], "\n".join(below)


def _num_pixels(stream: str) -> int:
    """Of a stored frame; 0 where it cannot be decoded."""
    try:
        *_, width, height = _picture(stream)
    except CaptureError:
        return 0
    return width * height


def _split(description: str) -> list[str]:
    """The parts between commas, but not those inside brackets."""
    return [part.strip() for part in re.split(r",\s*(?![^(\[]*[)\]])", description)]


def _picture(stream: str) -> tuple[str, str, str, int, int]:
    """codec, pix_fmt, colour description, and the stored width and height."""
    parts = _split(stream.split(": Video: ", 1)[1])
    codec = parts[0].split()[0]
    size = next((match for part in parts if (match := re.match(r"(\d+)x(\d+)\b", part))), None)
    if size is None or codec in ("none", "unknown") or "unknown codec" in stream:
        raise CaptureError(
            f"The video's pictures are in a form that cannot be decoded ({codec}).",
            code="video_undecodable",
            hint="Export the video again as MP4 with H.264 or HEVC.",
        )
    pixels = re.match(r"(\w+)(?:\((.*)\))?", parts[1]) if len(parts) > 1 else None
    pix_fmt = pixels.group(1) if pixels else "unknown"
    color = (pixels.group(2) or "") if pixels else ""
    return codec, pix_fmt, color, int(size.group(1)), int(size.group(2))


def _square_pixels(stream: str, width: int, height: int) -> tuple[int, int]:
    """The size with square pixels: the stored width times the pixel aspect."""
    aspect = re.search(r"SAR (\d+):(\d+)", stream)
    if aspect and int(aspect.group(1)) > 0 and int(aspect.group(2)) > 0:
        width = max(1, round(width * int(aspect.group(1)) / int(aspect.group(2))))
    return width, height


def _rotation(side_data: str) -> int:
    """Clockwise turn in degrees; ffmpeg states the display matrix counter-clockwise."""
    matrix = re.search(r"display ?matrix: rotation of (-?[\d.]+)", side_data, re.IGNORECASE)
    if matrix:
        return round(-float(matrix.group(1)) / 90) * 90 % 360
    return 0


def _rate(stream: str) -> float | None:
    for unit in ("fps", "tbr"):
        match = re.search(rf"([\d.]+)(k?) {unit}\b", stream)
        if match and float(match.group(1)) > 0:
            return float(match.group(1)) * (1000 if match.group(2) else 1)
    return None


def _duration(text: str) -> float | None:
    match = re.search(r"^  Duration: (\d+):(\d+):(\d+(?:\.\d+)?)", text, re.MULTILINE)
    if match is None:
        return None
    hours, minutes, seconds = match.groups()
    return int(hours) * 3600 + int(minutes) * 60 + float(seconds)


def _hdr(color: str, side_data: str) -> str:
    if "arib-std-b67" in color:
        return "hlg"
    if "smpte2084" in color:
        return "pq"
    dolby = re.search(r"DOVI configuration record:.*?profile: (\d+)", side_data)
    return "dolby" if dolby and dolby.group(1) == "5" else "none"


def _assumed_matrix(pix_fmt: str, color: str, width: int, height: int) -> str | None:
    """The matrix of Y'CbCr that names none: BT.709 for HD, BT.601 for less, as players do.

    color: such as "tv, bt709", or "tv, unknown/bt709/bt709", where the matrix comes first.
    """
    if not pix_fmt.startswith(_YUV) or any(
        part.strip().split("/")[0] in _MATRICES for part in color.split(",")
    ):
        return None
    is_hd = max(width, height) >= 1280 or min(width, height) >= 720
    return "bt709" if is_hd else "smpte170m"


def _projection(side_data: str) -> str:
    spherical = re.search(r"(?im)^\s*spherical(?: mapping)?: *([a-z][a-z -]*)", side_data)
    name = spherical.group(1).strip().lower() if spherical else ""
    return "" if name == "rectilinear" else name
