"""A line chart drawn with Pillow alone: enough to look at a curve on a bare machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

Point = tuple[float, float]
Color = tuple[int, int, int]

BLACK: Color = (30, 30, 30)
GRID: Color = (226, 226, 226)
PALETTE: tuple[Color, ...] = (
    (31, 119, 180),
    (255, 127, 14),
    (44, 160, 44),
    (148, 103, 189),
    (140, 86, 75),
    (23, 190, 207),
)
LEFT, RIGHT, TOP, BOTTOM = 70, 30, 50, 60
TEXT_SIZE = 15
DOT_PX = 5


@dataclass(frozen=True)
class Series:
    """A curve. points: (x, y). dots_only: no line between them. thick: stands out."""

    label: str
    points: Sequence[Point]
    color: Color
    dots_only: bool = False
    thick: bool = False


@dataclass(frozen=True)
class Axes:
    """From values to pixels, x to the right and y upwards. log_x: x by its logarithm, x > 0."""

    width: int
    height: int
    x_range: Point
    y_range: Point
    log_x: bool = False

    @classmethod
    def around(cls, points: Sequence[Point], width: int, height: int, *, log_x: bool) -> Axes:
        """Axes on which all points have a place, with some room around them."""
        xs, ys = [x for x, _ in points], [y for _, y in points]
        room = 0.05 * (max(ys) - min(ys)) or 1.0
        if log_x:
            x_range = (min(xs) / 1.1, max(xs) * 1.1)
        else:
            x_range = (min(0.0, *xs), 1.03 * max(xs) or 1.0)
        return cls(width, height, x_range, (min(ys) - room, max(ys) + room), log_x)

    def pixel(self, point: Point) -> Point:
        """Where a value lies in the picture."""
        low, high = (self._along(x) for x in self.x_range)
        x = (self._along(point[0]) - low) / (high - low)
        y = (point[1] - self.y_range[0]) / (self.y_range[1] - self.y_range[0])
        across, up = self.width - LEFT - RIGHT, self.height - TOP - BOTTOM
        return LEFT + x * across, self.height - BOTTOM - y * up

    def x_ticks(self) -> list[float]:
        """Round values along x."""
        if not self.log_x:
            return round_ticks(*self.x_range)
        decades = range(
            math.floor(math.log10(self.x_range[0])), math.ceil(math.log10(self.x_range[1])) + 1
        )
        steps = [factor * 10.0**decade for decade in decades for factor in (1.0, 2.0, 5.0)]
        return [value for value in steps if self.x_range[0] <= value <= self.x_range[1]]

    def _along(self, x: float) -> float:
        return math.log10(x) if self.log_x else x


def round_ticks(low: float, high: float, wanted: int = 8) -> list[float]:
    """At most about `wanted` multiples of 1, 2 or 5 times a power of ten in [low, high]."""
    rough = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def line_chart(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    log_x: bool = False,
    size: tuple[int, int] = (960, 600),
) -> Image.Image:
    """Draw all series into one RGB picture. Raises ValueError where there is no point at all."""
    points = [point for item in series for point in item.points]
    if not points:
        raise ValueError("there is nothing to draw")
    axes = Axes.around(points, *size, log_x=log_x)
    picture = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(picture)
    _draw_axes(draw, axes, title, x_label, y_label)
    for item in series:
        places = [axes.pixel(point) for point in item.points]
        if not item.dots_only and len(places) > 1:
            draw.line(places, fill=item.color, width=4 if item.thick else 2, joint="curve")
        if item.dots_only or len(places) == 1:
            for x, y in places:
                draw.ellipse((x - DOT_PX, y - DOT_PX, x + DOT_PX, y + DOT_PX), fill=item.color)
    _draw_legend(draw, axes, series)
    return picture


def _font() -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size=TEXT_SIZE)


def _draw_axes(
    draw: ImageDraw.ImageDraw, axes: Axes, title: str, x_label: str, y_label: str
) -> None:
    font = _font()
    bottom, right = axes.height - BOTTOM, axes.width - RIGHT
    for value in axes.x_ticks():
        x, _ = axes.pixel((value, axes.y_range[0]))
        draw.line((x, TOP, x, bottom), fill=GRID)
        draw.text((x, bottom + 8), f"{value:g}", fill=BLACK, font=font, anchor="mt")
    for value in round_ticks(*axes.y_range):
        _, y = axes.pixel((axes.x_range[1], value))
        draw.line((LEFT, y, right, y), fill=GRID)
        draw.text((LEFT - 8, y), f"{value:g}", fill=BLACK, font=font, anchor="rm")
    draw.line((LEFT, TOP, LEFT, bottom, right, bottom), fill=BLACK)
    draw.text(((LEFT + right) / 2, axes.height - 8), x_label, fill=BLACK, font=font, anchor="ms")
    draw.text((8, TOP - 8), y_label, fill=BLACK, font=font, anchor="ls")
    draw.text((axes.width / 2, 10), title, fill=BLACK, font=font, anchor="mt")


def _draw_legend(draw: ImageDraw.ImageDraw, axes: Axes, series: Sequence[Series]) -> None:
    """Names at the bottom right, where rising curves are not."""
    font = _font()
    width = max(draw.textlength(item.label, font=font) for item in series)
    left = axes.width - RIGHT - width - 40
    top = axes.height - BOTTOM - 12 - (TEXT_SIZE + 6) * len(series)
    for row, item in enumerate(series):
        y = top + (TEXT_SIZE + 6) * row + TEXT_SIZE / 2
        if item.dots_only:
            draw.ellipse((left + 7, y - DOT_PX, left + 7 + 2 * DOT_PX, y + DOT_PX), fill=item.color)
        else:
            draw.line((left, y, left + 24, y), fill=item.color, width=4 if item.thick else 2)
        draw.text((left + 32, y), item.label, fill=BLACK, font=font, anchor="lm")
