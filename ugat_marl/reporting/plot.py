"""Axes of a drawing: scales with round ticks, grid lines, labels with units, a legend."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from ugat_marl.reporting.drawing import Drawing, Point, shortened, width_of
from ugat_marl.reporting.palette import CURVES, DASHES, MARKERS

WIDTH = 480.0
HEIGHT = 300.0
TITLE = 52
"""Letters of a title that fit in."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 14.0, 54.0, 46.0
LEGEND = 19.0
"""Height of a line of a legend."""


class Plot:
    """A drawing with a horizontal and a vertical scale.

    Args:
        name: Of the picture.
        title: Of the picture.
        x: Smallest and largest value on the horizontal scale.
        y: On the vertical one.
        x_label: What is on it, with its unit.
        y_label: The same.
        whole: Whether only whole numbers stand on the horizontal scale.
        legend: Texts of the curves in the order of `curve` numbers; nothing for a single one.
    """

    def __init__(
        self,
        name: str,
        title: str,
        x: tuple[float, float],
        y: tuple[float, float],
        x_label: str,
        y_label: str,
        *,
        whole: bool = False,
        legend: Sequence[str] = (),
    ) -> None:
        rows = legend_rows(legend)
        self.drawing = Drawing(name, title, WIDTH, HEIGHT + LEGEND * len(rows))
        self._x, self._y = _widened(x), _widened(y)
        self.drawing.text((8, 20), shortened(title, TITLE), 14, bold=True)
        self.drawing.text((8, _TOP - 15), y_label, 12, "soft")
        self.drawing.text((WIDTH - _RIGHT, HEIGHT - 12), x_label, 12, "soft", "end")
        for value in ticks(*self._y):
            _, height = self.at(self._x[0], value)
            self.drawing.line([(_LEFT, height), (WIDTH - _RIGHT, height)], "line", 1)
            self.drawing.text((_LEFT - 6, height + 4), tick_text(value), 12, "soft", "end")
        for value in ticks(*self._x, whole=whole):
            place, _ = self.at(value, self._y[0])
            self.drawing.line([(place, HEIGHT - _BOTTOM), (place, HEIGHT - _BOTTOM + 4)], "soft", 1)
            text = tick_text(value)
            self.drawing.text((place, HEIGHT - _BOTTOM + 17), text, 12, "soft", "middle")
        draw_legend(self.drawing, rows, HEIGHT)

    def at(self, x: float, y: float) -> Point:
        """Where a pair of values lies."""
        (x0, x1), (y0, y1) = self._x, self._y
        right, down = (x - x0) / (x1 - x0), (y1 - y) / (y1 - y0)
        wide, high = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
        return _LEFT + wide * right, _TOP + high * min(max(down, 0.0), 1.0)

    def curve(
        self, number: int, points: Iterable[tuple[float, float]], *, markers: bool = True
    ) -> None:
        """A curve; it is interrupted where there is no value."""
        colour, marker = CURVES[number % len(CURVES)], MARKERS[number % len(MARKERS)]
        known = [(x, y) for x, y in points]
        for piece in _pieces(known):
            placed = [self.at(*point) for point in piece]
            if len(placed) > 1:
                self.drawing.line(placed, colour, 2, DASHES[number % len(DASHES)])
            if markers or len(placed) == 1:
                for place, (x, y) in zip(placed, piece, strict=True):
                    self.drawing.dot(place, 4, colour, marker, title=f"{x:g}: {tick_text(y)}")

    def band(self, number: int, rows: Iterable[tuple[float, float, float]]) -> None:
        """The interval around a curve: x, low, high; left out where there is none."""
        known = [row for row in rows if all(map(math.isfinite, row))]
        if len(known) > 1:
            upper = [self.at(x, high) for x, _, high in known]
            lower = [self.at(x, low) for x, low, _ in reversed(known)]
            self.drawing.area([*upper, *lower], CURVES[number % len(CURVES)], 0.18)


def span(values: Iterable[float], margin: float = 0.0) -> tuple[float, float]:
    """Smallest and largest of the finite values, a share apart from them; (0, 1) for none."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return 0.0, 1.0
    away = margin * (max(known) - min(known))
    return min(known) - away, max(known) + away


def ticks(low: float, high: float, *, whole: bool = False, most: int = 6) -> list[float]:
    """Round values from low to high, at most about `most`."""
    raw = (high - low) / most
    size = 10.0 ** math.floor(math.log10(raw))
    distance = next(size * k for k in (1, 2, 5, 10) if size * k >= raw * 0.999)
    if whole:
        distance = max(1.0, distance)
    first = math.ceil(low / distance - 1e-9)
    last = math.floor(high / distance + 1e-9)
    return [k * distance for k in range(first, last + 1)]


def tick_text(value: float) -> str:
    """A number as it stands at a scale."""
    if abs(value) >= 10_000:
        return f"{value:,.0f}".replace(",", "\u2009").replace("-", "−")
    return f"{round(value, 6):.4g}".replace("-", "−")


def _widened(ends: tuple[float, float]) -> tuple[float, float]:
    low, high = ends
    if high - low > 1e-9 * max(abs(low), abs(high), 1e-9):
        return low, high
    return low - 0.5, high + 0.5


def _pieces(points: Sequence[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    found: list[list[tuple[float, float]]] = [[]]
    for point in points:
        if all(map(math.isfinite, point)):
            found[-1].append(point)
        elif found[-1]:
            found.append([])
    return [piece for piece in found if piece]


def _entry(text: str) -> float:
    return 32 + width_of(text, 12) + 18


def legend_rows(legend: Sequence[str], width: float = WIDTH) -> list[list[tuple[int, str]]]:
    """The entries of a legend with the numbers of their curves, in as many lines as they need."""
    rows: list[list[tuple[int, str]]] = []
    room = 0.0
    for number, text in enumerate(shortened(text, 56) for text in legend):
        if not rows or _entry(text) > room:
            rows.append([])
            room = width - 14
        rows[-1].append((number, text))
        room -= _entry(text)
    return rows


def draw_legend(drawing: Drawing, rows: Sequence[Sequence[tuple[int, str]]], top: float) -> None:
    """Draws what `legend_rows` made, from `top` downwards."""
    for line, row in enumerate(rows):
        x, y = 14.0, top + 8 + LEGEND * line
        for number, text in row:
            colour, dash = CURVES[number % len(CURVES)], DASHES[number % len(DASHES)]
            drawing.line([(x, y - 4), (x + 26, y - 4)], colour, 2, dash)
            drawing.dot((x + 13, y - 4), 4, colour, MARKERS[number % len(MARKERS)])
            drawing.text((x + 32, y), text, 12)
            x += _entry(text)
