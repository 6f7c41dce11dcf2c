"""Which photos are copies of others under any name: edited ones, those of messengers, reduced ones.

A copy has the original's details in the original's places. So two looks at LOOK_PX are compared
twice: details (what is left without the blurred look) must agree, and the affine motion that
explains best how one differs from the other must be none. Neighbouring frames of a slow film
agree in details, too, but the camera moved. Brightness, contrast and size may differ.

Photos whose EXIF says that they were taken at other times are no copies; names that are alike, or
one time, allow for more, as edited photos need.

Symbols: S: LOOK_PX. P: photos.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

LOOK_PX = 192
"""Both sides of a look: its shape is lost, which is compared beforehand."""
_ASPECT_SLACK = 0.01
_COARSE = 4
_ALIKE = 0.9
"""Least correlation of looks at a quarter of their size; of edited photos .93 and more."""
_BLUR_PX = 2.0


@dataclass(frozen=True)
class _Border:
    """details: least correlation of them. motion: the most, in pixels of a look, root of the mean
    square over it."""

    details: float
    motion: float


_UNRELATED = _Border(0.97, 0.045)
"""By looks alone. Real photos saved again, at a quality of 40 or 320 px wide: .97 and more, .027
and less. Neighbours in films at 30 and 60 frames a second: up to .989 with .14 (a door
handle) and .979 with .07 (a box); a camera that hardly moved, .998 with .050."""
_SAME_TIME = _Border(0.9, 0.12)
"""Brighter by 15 %, or of 1.4 times the contrast: .97 and .11."""
_SAME_NAME = _Border(0.9, 0.5)
"""Sharpened, or so bright that much is white: .92 and .35."""


@dataclass(frozen=True)
class Candidate:
    """A photo that may be a copy, or have some.

    aspect: width by height. taken_at: as in `Exif`. stem: what its name says but for words that
    programs add to a copy's.
    """

    aspect: float
    taken_at: str | None
    stem: str


def copies_among(
    photos: Sequence[Candidate], look_at: Callable[[int], NDArray[np.float32] | None]
) -> dict[int, int]:
    """The photos that are copies, and which each is a copy of, by their numbers.

    photos: the one to be kept before its copies. look_at: brightness [S, S] of a photo, or None
    where it cannot be looked at; only asked where another may be its copy. Raises what that does.
    """
    aspects = np.array([photo.aspect for photo in photos])
    times = np.array([photo.taken_at or "" for photo in photos])

    def partners(number: int) -> NDArray[np.bool_]:
        same_time = (times == "") | (times == times[number]) | (times[number] == "")
        found: NDArray[np.bool_] = same_time & (
            np.abs(aspects / aspects[number] - 1) <= _ASPECT_SLACK
        )
        found[number] = False
        return found

    coarse = np.zeros((len(photos), (LOOK_PX // _COARSE) ** 2), np.float32)
    looks: dict[int, NDArray[np.float16]] = {}
    kept = np.zeros(len(photos), np.bool_)
    copies: dict[int, int] = {}
    for number, photo in enumerate(photos):
        others = partners(number)
        look = look_at(number) if others.any() else None
        if look is None:
            continue
        coarse[number] = _normal(_reduced(look)).ravel()
        nearest = coarse[:number] @ coarse[number] * (kept & others)[:number]
        for other in np.argsort(-nearest):
            if nearest[other] < _ALIKE:
                break
            border = _border(photo, photos[other])
            if is_copy(looks[int(other)].astype(np.float32), look, border):
                copies[number] = int(other)
                break
        if number not in copies:
            kept[number] = True
            looks[number] = look.astype(np.float16)
    return copies


def _border(photo: Candidate, other: Candidate) -> _Border:
    if photo.stem == other.stem:
        return _SAME_NAME
    same_time = photo.taken_at is not None and photo.taken_at == other.taken_at
    return _SAME_TIME if same_time else _UNRELATED


def is_copy(
    first: NDArray[np.float32], second: NDArray[np.float32], border: _Border = _UNRELATED
) -> bool:
    """Whether two looks [S, S] have one picture's details in one picture's places."""
    agreement = float((_normal(_details(first)) * _normal(_details(second))).sum())
    return agreement >= border.details and motion_px(first, second) <= border.motion


def motion_px(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """How far an affine motion of less than a pixel has moved the second look [S, S] from the
    first: root mean square over the look.

    d = g a + o + u . grad: difference d of the looks, brightness a with gain g and offset o, motion
    u, affine in the place. Least squares, again with less weight for what disagrees.
    """
    one, other = (gaussian_filter(look, 1.0) for look in (first, _toned(second, first)))
    down, across = np.gradient((one + other) / 2)
    y, x = np.mgrid[-1 : 1 : LOOK_PX * 1j, -1 : 1 : LOOK_PX * 1j].astype(np.float32)
    plain = [across, across * x, across * y, down, down * x, down * y, one, np.ones_like(one)]
    inside = np.s_[2:-2:2, 2:-2:2]
    system = np.stack([part[inside].ravel() for part in plain], axis=1).astype(np.float64)
    wanted = (other - one)[inside].ravel().astype(np.float64)
    weight = np.ones_like(wanted)
    solution = np.zeros(system.shape[1])
    for _ in range(3):
        weighed = system * weight[:, None]
        solution = np.linalg.lstsq(weighed.T @ system, weighed.T @ wanted, rcond=None)[0]
        left = np.abs(wanted - system @ solution)
        weight = 1 / (1 + (left / (2 * (np.median(left) + 0.1))) ** 2)
    # The mean squares of 1, x and y over the look.
    squares = solution[:6] ** 2 @ np.array([1, 1 / 3, 1 / 3, 1, 1 / 3, 1 / 3])
    return float(np.sqrt(squares))


def _toned(look: NDArray[np.float32], like: NDArray[np.float32]) -> NDArray[np.float32]:
    """The look with the other's values in the order of its own: an edited photo's tones undone."""
    toned = np.empty_like(look)
    toned.ravel()[np.argsort(look.ravel(), kind="stable")] = np.sort(like.ravel())
    return toned


def _reduced(look: NDArray[np.float32]) -> NDArray[np.float32]:
    size = LOOK_PX // _COARSE
    reduced: NDArray[np.float32] = look.reshape(size, _COARSE, size, _COARSE).mean(axis=(1, 3))
    return reduced


def _details(look: NDArray[np.float32]) -> NDArray[np.float32]:
    details: NDArray[np.float32] = look - gaussian_filter(look, _BLUR_PX)
    return details


def _normal(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Without their mean, of length 1; zeros where they are all alike."""
    plain: NDArray[np.float32] = values - values.mean()
    length = float(np.sqrt((plain**2).sum()))
    normal: NDArray[np.float32] = plain / np.float32(length if length > 0 else 1.0)
    return normal
