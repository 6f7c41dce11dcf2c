"""Charts packed into one picture, close together and never nearer than their margins.

A chart takes up, of each of its columns, what lies between its highest and its lowest edge there,
and its margin. Large charts fall from above, the tallest first, each where it comes to lie lowest,
on what lies there already (as in Levy, Petitjean, Ray, Maillot, "Least squares conformal maps",
SIGGRAPH 2002, section 4.3). Small ones, which are most, then go into whatever room is left between.
Two charts have no 2 x 2 texels in common, so that a copy of half the size mixes none.

Symbols: U corners, F faces, C charts. Places are in texels, to the right and down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAST_SIDE = 64
"""Of a picture, px."""
_BLOCK = 2
_SMALL = 24
"""A chart of at most so many texels each way is small."""
_SAMPLES = 2_000_000
_FULLEST = 0.88
_HOPEFUL = 0.85
"""Share of a picture that charts may take up to be tried at all, and to be tried first."""
_SHRINK, _LEAST_SCALE = 0.97, 0.01


class TextureFull(ValueError):
    """More charts than the largest picture has room for."""


@dataclass(frozen=True)
class _Spans:
    """What charts take up of each of their columns. starts: [C + 1], of each chart's columns in
    low and high, which are from the top of its box; a column that it has nothing in has low > high.
    """

    starts: Ints
    low: Ints
    high: Ints

    def of(self, chart: int) -> tuple[Ints, Ints]:
        """low and high of one chart's columns."""
        mine = slice(self.starts[chart], self.starts[chart + 1])
        return self.low[mine], self.high[mine]


@dataclass(frozen=True)
class Outlines:
    """What charts take up, margins and all.

    origin: [C, 2], left and top of each one's box. size: [C, 2], of the box. columns, rows: what is
    taken up of each.
    """

    origin: Ints
    size: Ints
    columns: _Spans
    rows: _Spans

    @property
    def area(self) -> int:
        """Texels that all of them take up, about."""
        across = (np.maximum(one.high - one.low, 0).sum() for one in (self.columns, self.rows))
        return int(min(across))


@dataclass(frozen=True)
class Packing:
    """Where charts lie. size: width and height of the picture, powers of two.

    place: [C, 2], left and top of each one's box. turned: [C], whether by a quarter, so that what
    was on the right is on top.
    """

    outlines: Outlines
    size: tuple[int, int]
    place: Ints
    turned: NDArray[np.bool_]

    def moved(self, place: Floats, chart: NDArray[np.integer]) -> Floats:
        """Where places [U, 2] of charts [U] come to lie."""
        own = place - self.outlines.origin[chart]
        turned = np.stack([own[:, 1], self.outlines.size[chart, 0] - own[:, 0]], axis=1)
        found: Floats = np.where(self.turned[chart, None], turned, own) + self.place[chart]
        return found

    def texels(self, chart: int) -> tuple[Ints, Ints]:
        """Rows and columns of what a chart takes up."""
        left, top = self.place[chart].tolist()
        rows, columns = np.nonzero(self._mask(chart))
        return rows + top, columns + left

    def lay(
        self, chart: int, patch: NDArray[np.uint8], picture: NDArray[np.uint8]
    ) -> tuple[Ints, Ints]:
        """Lay what a chart takes up of a patch on the picture, in place; rows and columns of it.

        patch: [h, w, 3], from where the chart's own places begin; what it has not is left out.
        """
        width, height = self.outlines.size[chart].tolist()
        left, top = self.outlines.origin[chart].tolist()
        part = patch[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)]
        box = np.zeros((height, width, 3), np.uint8)
        inside = np.zeros((height, width), np.bool_)
        x, y = max(-left, 0), max(-top, 0)
        here = slice(y, y + len(part)), slice(x, x + part.shape[1])
        box[here], inside[here] = part, True
        if self.turned[chart]:
            box, inside = np.rot90(box), np.rot90(inside)
        rows, columns = np.nonzero(inside & self._mask(chart))
        left, top = self.place[chart].tolist()
        picture[rows + top, columns + left] = box[rows, columns]
        return rows + top, columns + left

    def _mask(self, chart: int) -> NDArray[np.bool_]:
        """[h, w], what a chart takes up of its box as it lies in the picture."""
        low, high, height = _lying(self.outlines, chart, bool(self.turned[chart]))
        rows = np.arange(height)[:, None]
        taken: NDArray[np.bool_] = (rows >= low) & (rows < high)
        return taken


def outlines_of(
    place: Floats, faces: NDArray[np.integer], chart: NDArray[np.integer], margin: int
) -> Outlines:
    """What charts take up with so many texels around their faces.

    place: [U, 2]. faces: [F, 3]. chart: [U], each of which has a corner.
    """
    count = int(chart.max(initial=-1)) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, place)
    np.maximum.at(high, chart, place)
    origin = np.floor(low).astype(np.int64) - margin
    size = np.floor(high).astype(np.int64) + 1 + margin - origin
    size += -size % _BLOCK
    starts = [np.concatenate([[0], np.cumsum(size[:, axis])]) for axis in (0, 1)]
    least = [np.full(start[-1], np.iinfo(np.int64).max // 4) for start in starts]
    most = [np.full(start[-1], np.iinfo(np.int64).min // 4) for start in starts]
    for axis in (0, 1):
        for own, begin, end, whose in _across(place, faces, chart, axis):
            at = starts[axis][whose] + own - origin[whose, axis]
            first = origin[whose, 1 - axis]
            np.minimum.at(least[axis], at, np.minimum(begin, end) - first)
            np.maximum.at(most[axis], at, np.maximum(begin, end) - first + 1)
    columns, rows = (
        _Spans(
            start,
            _around(one, margin, np.minimum) - margin,
            _around(two, margin, np.maximum) + margin,
        )
        for start, one, two in zip(starts, least, most, strict=True)
    )
    return Outlines(origin, size, columns, rows)


def _across(
    place: Floats, faces: NDArray[np.integer], chart: NDArray[np.integer], axis: int
) -> Iterator[tuple[Ints, Ints, Ints, Ints]]:
    """The columns that edges pass (rows, for axis 1), at which rows they come in and leave them,
    and their charts, [N] each; some edges at a time."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ahead = place[pairs[:, 1], axis] >= place[pairs[:, 0], axis]
    pairs = np.where(ahead[:, None], pairs, pairs[:, ::-1])
    column = np.floor(place[pairs, axis]).astype(np.int64)
    numbers = column[:, 1] - column[:, 0] + 1
    total = np.cumsum(numbers)
    cuts = np.searchsorted(total, np.arange(_SAMPLES, total[-1] + _SAMPLES, _SAMPLES))
    begin = 0
    for end in (cuts + 1).tolist():
        some, number = pairs[begin:end], numbers[begin:end]
        which = np.repeat(np.arange(len(number)), number)
        own = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
        own += column[begin:end, 0][which]
        one, other = place[some[:, 0]][which], place[some[:, 1]][which]
        slope = (other[:, 1 - axis] - one[:, 1 - axis]) / np.maximum(
            other[:, axis] - one[:, axis], 1e-9
        )
        rows = []
        for step in (0, 1):
            at = np.clip(own + step, one[:, axis], other[:, axis])
            rows.append(one[:, 1 - axis] + slope * (at - one[:, axis]))
        # What is as good as upright passes its column from end to end.
        upright = number[which] == 1
        rows = [
            np.where(upright, ends[:, 1 - axis], row)
            for ends, row in zip((one, other), rows, strict=True)
        ]
        yield (
            own,
            np.floor(rows[0]).astype(np.int64),
            np.floor(rows[1]).astype(np.int64),
            chart[some[:, 0]][which].astype(np.int64),
        )
        begin = end


def _around(values: Ints, margin: int, best: np.ufunc) -> Ints:
    """The best within so many columns; charts begin and end with as many columns of nothing."""
    found = values.copy()
    for step in range(1, margin + 1):
        found[step:] = best(found[step:], values[:-step])
        found[:-step] = best(found[:-step], values[step:])
    return found


def packed(
    outlines_at: Callable[[float], Outlines],
    largest_side: int,
    poll: Callable[[], None] = lambda: None,
) -> tuple[float, Packing]:
    """The smallest picture that holds all charts as they are, or the largest one and their scale.

    outlines_at: of the charts at a scale of 1 or less. largest_side: px, a power of two. poll:
    called every second or so; may raise. Raises TextureFull where not even a hundredth fits.
    """
    outlines, scale, room = outlines_at(1.0), 1.0, largest_side * largest_side
    found = smallest(outlines, largest_side, room, poll)
    while found is None:
        # Margins do not shrink, so this is never too much.
        scale *= min(_SHRINK, float(np.sqrt(_HOPEFUL * room / outlines.area)))
        poll()
        outlines = outlines_at(scale)
        if outlines.area <= _HOPEFUL * room:
            found = pack(outlines, largest_side, largest_side)
        if found is None and scale < _LEAST_SCALE:
            raise TextureFull(f"{len(outlines.size)} charts do not fit into {largest_side} px")
    return scale, found


def smallest(
    outlines: Outlines,
    largest_side: int,
    largest_area: int,
    poll: Callable[[], None] = lambda: None,
) -> Packing | None:
    """Charts in the smallest picture of so many pixels at most that holds them; None if none does.

    Of pictures of one size the squarest that is as wide as the widest chart, at least as wide as
    high. poll: as of `packed`.
    """
    sides = [min(LEAST_SIDE, largest_side)]
    while sides[-1] < largest_side:
        sides.append(2 * sides[-1])
    pairs = sorted(
        ((wide, high) for wide in sides for high in sides if high <= wide),
        key=lambda pair: (pair[0] * pair[1], pair[0]),
    )
    longest = int(outlines.size.max(initial=1))
    tried = 0
    for width, height in pairs:
        area = width * height
        roomy = area <= largest_area and outlines.area <= _FULLEST * area and longest <= width
        if not roomy or area == tried:
            continue
        poll()
        tried = area
        found = pack(outlines, width, height)
        if found is not None:
            return found
    return None


def pack(outlines: Outlines, width: int, height: int) -> Packing | None:
    """Charts in a picture of some size, px; None where they do not fit."""
    size = outlines.size
    # The tallest first, and upright, where that fits.
    turned = size[:, 0] > size[:, 1]
    turned &= size[:, 0] <= height
    turned |= size[:, 1] > height
    lying = np.where(turned[:, None], size[:, ::-1], size)
    if (lying > (width, height)).any():
        return None
    small = (lying <= _SMALL).all(axis=1)
    taken = np.zeros((height // _BLOCK, width // _BLOCK), np.bool_)
    place = np.zeros((len(size), 2), np.int64)
    large = np.flatnonzero(~small)
    large = large[np.lexsort((-lying[large, 0], -lying[large, 1]))]
    if not _fall(outlines, large, turned, taken, place):
        return None
    if not _fill(np.flatnonzero(small), lying, taken, place):
        return None
    return Packing(outlines, (width, height), place, turned)


def _lying(outlines: Outlines, chart: int, turned: bool) -> tuple[Ints, Ints, int]:
    """low and high of a chart's columns as it lies, and the height of its box."""
    width, height = outlines.size[chart].tolist()
    if not turned:
        return *outlines.columns.of(chart), height
    low, high = outlines.rows.of(chart)
    return width - high, width - low, width


def _fall(
    outlines: Outlines,
    order: Ints,
    turned: NDArray[np.bool_],
    taken: NDArray[np.bool_],
    place: Ints,
) -> bool:
    """Let charts fall, in place; whether they have room. taken: [rows, columns], in blocks."""
    rows, columns = taken.shape
    ground = np.zeros(columns, np.int64)
    for chart in order.tolist():
        low, high, _ = _lying(outlines, chart, bool(turned[chart]))
        low = low.reshape(-1, _BLOCK).min(axis=1) // _BLOCK
        high = -(-high.reshape(-1, _BLOCK).max(axis=1) // _BLOCK)
        wide = len(low)
        below = np.lib.stride_tricks.sliding_window_view(ground, wide)
        top = np.maximum((below - low).max(axis=1), 0)
        lost = top * wide - below.sum(axis=1)
        x = int(np.lexsort((lost, top))[0])
        y = int(top[x])
        if y + int(high.max()) > rows:
            return False
        for column, (begin, end) in enumerate(
            zip((y + low).tolist(), (y + high).tolist(), strict=True)
        ):
            taken[begin:end, x + column] = True
        ground[x : x + wide] = y + high
        place[chart] = x * _BLOCK, y * _BLOCK
    return True


def _fill(charts: Ints, size: Ints, taken: NDArray[np.bool_], place: Ints) -> bool:
    """Put small charts where there is room, as the boxes [C, 2] that they are; in place."""
    if len(charts) == 0:
        return True
    wide, high = (size[charts] // _BLOCK).T
    order = np.lexsort((-wide, -high))
    charts, wide, high = charts[order], wide[order], high[order]
    begins = np.flatnonzero(np.diff(wide, prepend=-1) | np.diff(high, prepend=-1))
    for begin, end in zip(begins, [*begins[1:], len(charts)], strict=True):
        w, h = int(wide[begin]), int(high[begin])
        if _put(charts[begin:end], w, h, taken, place) < end - begin:
            return False
    return True


def _put(charts: Ints, wide: int, high: int, taken: NDArray[np.bool_], place: Ints) -> int:
    """Put charts of one size, in blocks, row by row from the top; how many had room."""
    done = 0
    for y in range(len(taken) - high + 1):
        if done == len(charts):
            break
        free = ~taken[y : y + high].any(axis=0)
        edges = np.flatnonzero(np.diff(free, prepend=False, append=False))
        begins, number = edges[::2], (edges[1::2] - edges[::2]) // wide
        which = np.repeat(np.arange(len(number)), number)
        if len(which) == 0:
            continue
        nth = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
        x = (begins[which] + wide * nth)[: len(charts) - done]
        taken[y : y + high, (x[:, None] + np.arange(wide)).ravel()] = True
        place[charts[done : done + len(x)]] = _BLOCK * np.stack([x, np.full_like(x, y)], axis=1)
        done += len(x)
    return done
