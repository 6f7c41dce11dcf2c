"""Which clips of a capture are the same film again: a camera's small proxy, a re-encoded copy.

Cameras write a small film beside each (GoPro's `.LRV`, DJI's `.LRF`), under a name of its own. Two
clips are one film where they are equally long and of one shape, and show the same at the same
times, and something else at others: a camera on a tripod shows nearly the same all the time, and
two rounds of a turntable are two films.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.captures.importers.video import Checked
from pipelines.errors import ToolError
from pipelines.stage import StageContext
from pipelines.tools.ffmpeg import run_ffmpeg, untrusted_input

_LENGTH_SLACK = 0.005
_LENGTH_SLACK_S = 0.25
"""Encoders drop or add a few frames at the end of a film."""
_ASPECT_SLACK = 0.02
_LEAST_LOOKS = 8
_LOOK_PX = 48
_LOOK_LIMIT_S = 120.0
_FEWEST_LOOKS = 4
"""Of a film of fewer that can be compared, nothing is said."""
_ALIKE = 0.9
"""Least correlation of what both show at one time."""
_TIMES_NEARER = 3.0
"""So many times nearer each other than what the film shows from one time to the next."""

Look = NDArray[np.float32]


def film_copies(
    clips: Mapping[str, Checked],
    num_bytes: Mapping[str, int],
    extract: Callable[[str, Path], None],
    scratch: Path,
    ctx: StageContext,
) -> dict[str, str]:
    """The clips that are copies, and which clip each is a copy of: one larger, or as large.

    clips: by name. num_bytes: of each file. extract: writes the clip of a name to a path. scratch:
    where one clip may lie meanwhile. Clips that cannot be decoded there are no copies. Nothing is
    decoded where no two are equally long. Raises Cancelled.
    """
    order = sorted(clips, key=lambda name: (-_num_pixels(clips[name]), -num_bytes[name]))
    copies: dict[str, str] = {}
    known: dict[tuple[str, float], list[Look | None]] = {}

    def looks_of(name: str, step_s: float) -> list[Look | None]:
        if (name, step_s) not in known:
            extract(name, scratch)
            try:
                times_s = look_times(clips[name], step_s)
                known[name, step_s] = _looks(scratch, clips[name].info.stream, times_s, ctx)
            finally:
                scratch.unlink(missing_ok=True)
        return known[name, step_s]

    for place, name in enumerate(order):
        for larger in order[:place]:
            if larger in copies or not _may_be_one(clips[name], clips[larger]):
                continue
            step_s = _step_s(min(_length_s(clips[name]), _length_s(clips[larger])))
            if is_one_film(looks_of(name, step_s), looks_of(larger, step_s)):
                copies[name] = larger
                break
    return copies


def _num_pixels(clip: Checked) -> int:
    return clip.info.width * clip.info.height


def _length_s(clip: Checked) -> float:
    return (clip.info.duration_s or 0.0) - clip.start_s


def _may_be_one(first: Checked, second: Checked) -> bool:
    """Whether clips have one length and one shape."""
    lengths = _length_s(first), _length_s(second)
    shapes = [clip.info.width / clip.info.height for clip in (first, second)]
    slack_s = max(_LENGTH_SLACK_S, _LENGTH_SLACK * max(lengths))
    return (
        abs(lengths[0] - lengths[1]) <= slack_s and abs(shapes[0] / shapes[1] - 1) <= _ASPECT_SLACK
    )


def _step_s(length_s: float) -> float:
    """Between looks: the same for films of about one length, so that each is looked at once."""
    return float(2.0 ** np.floor(np.log2(max(length_s, 1e-3)))) / _LEAST_LOOKS


def look_times(clip: Checked, step_s: float) -> list[float]:
    """When a clip is looked at: its frames nearest to the middles of steps from its first one on.

    A proxy may have every second frame, or be cut by one.
    """
    times_s = clip.packets.times_s
    wanted_s = np.arange(times_s[0] + step_s / 2, times_s[-1], step_s)
    return [_nearest(times_s, float(each)) for each in wanted_s]


def _nearest(times_s: Sequence[float], wanted_s: float) -> float:
    place = bisect_left(times_s, wanted_s)
    return min(times_s[max(place - 1, 0) : place + 1], key=lambda each: abs(each - wanted_s))


def _looks(
    path: Path, stream: str, times_s: Sequence[float], ctx: StageContext
) -> list[Look | None]:
    """What a stream of a clip shows at these times, [_LOOK_PX, _LOOK_PX] each; None where that is
    not to be decoded."""
    looks: list[Look | None] = []
    for time_s in times_s:
        ctx.check_cancelled()
        data: list[bytes] = []
        # Just before the frame: times are rounded, and the first frame from there on is taken.
        one = untrusted_input(path, start_s=max(time_s - 0.002, 0.0)).output(
            "pipe:1",
            map=stream,
            f="rawvideo",
            vf=f"scale={_LOOK_PX}:{_LOOK_PX}:flags=area,format=gray",
            **{"frames:v": 1, "an": None, "sn": None, "dn": None},
        )
        try:
            run_ffmpeg(
                one,
                time_limit_s=_LOOK_LIMIT_S,
                is_cancelled=ctx.is_cancelled,
                on_stdout=data.append,
            )
        except ToolError:
            data = []
        values = np.frombuffer(b"".join(data), np.uint8).astype(np.float32)
        looks.append(
            values.reshape(_LOOK_PX, _LOOK_PX) if values.size == _LOOK_PX * _LOOK_PX else None
        )
    return looks


def is_one_film(first: Sequence[Look | None], second: Sequence[Look | None]) -> bool:
    """Whether looks at the same times of two clips show one film.

    They are compared by their correlation, as a copy may be brighter or have other contrast.
    """
    pairs = [
        (_normal(one), _normal(other))
        for one, other in zip(first, second, strict=False)
        if one is not None and other is not None
    ]
    if len(pairs) < _FEWEST_LOOKS:
        return False
    apart = [1 - float((one * other).sum()) for one, other in pairs]
    moves = [1 - float((one * later).sum()) for (one, _), (_, later) in pairwise(pairs)]
    return max(apart) <= 1 - _ALIKE and _TIMES_NEARER * float(np.median(apart)) <= float(
        np.median(moves)
    )


def _normal(look: Look) -> Look:
    """Without its mean, of length 1; all zeros where it is flat."""
    plain: NDArray[np.float32] = look - look.mean()
    length = float(np.sqrt((plain**2).sum()))
    normal: NDArray[np.float32] = plain / np.float32(length if length > 0 else 1.0)
    return normal
