"""Numbers of intersections: on a map of the network, and minute by minute."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

from ugat_marl.reporting.drawing import Drawing, Point, shortened
from ugat_marl.reporting.palette import STEPS, on, step
from ugat_marl.reporting.plot import TITLE, WIDTH, tick_text
from ugat_marl.scenarios import Network

_NAMED = 30
_MOST_HIGH, _LEAST_HIGH = 340.0, 150.0
_ROWS, _COLUMNS = 16, 60
_CELL = 17.0
_LEFT = 112.0


def node_map(
    name: str,
    title: str,
    network: Network,
    values: Mapping[str, tuple[float, str]],
    ends: tuple[float, float],
    unit: str,
) -> Drawing:
    """The network with its intersections coloured by a number.

    Args:
        name: Of the picture.
        title: What the number is.
        network: Where the intersections are.
        values: Intersection to its number and to what is written in it; nan is shown empty.
        ends: Of the scale of colours.
        unit: Of the number.
    """
    centres = {item.id: item.position for item in network.intersections if item.id in values}
    place, high = _placed(list(centres.values()))
    drawing = Drawing(name, title, WIDTH, 34 + high + 34)
    drawing.text((8, 20), shortened(title, TITLE), 14, bold=True)
    for lane in network.lanes.values():
        for piece in _inside([place(point) for point in lane.shape], 34 + high):
            drawing.line(piece, "road", max(2.0, 2.6 * place.scale))
    points = {tls: place(centre) for tls, centre in centres.items()}
    radius = _radius(list(points.values()))
    for tls, at in points.items():
        value, text = values[tls]
        colour = step(value, *ends) if math.isfinite(value) else "paper"
        drawing.disc(at, radius, colour, "soft", title=f"{tls}: {text or 'no value'} {unit}")
        if radius >= 11:
            size = min(13.0, 2.6 * radius / max(len(text), 3))
            ink = on(colour) if math.isfinite(value) else "soft"
            drawing.text((at[0], at[1] + size / 3), text or "–", size, ink, "middle", bold=True)
        if len(points) <= _NAMED:
            below = at[0], at[1] + radius + 12
            drawing.text(below, shortened(tls, 12), 11, "ink", "middle", halo="paper")
    _scale(drawing, 34 + high + 12, ends, unit)
    return drawing


def minutes_picture(
    name: str, title: str, queues: Mapping[str, Sequence[float]], most: float | None = None
) -> Drawing:
    """Queues of intersections over the minutes of an episode, the longest queues first.

    Args:
        name: Of the picture.
        title: Whose queues they are.
        queues: Intersection to its mean queue in every minute, vehicles.
        most: End of the scale of colours; default: the longest queue.
    """
    means = {tls: sum(row) / len(row) for tls, row in queues.items() if row}
    shown = sorted(means, key=lambda tls: -means[tls])[:_ROWS]
    minutes = max((len(queues[tls]) for tls in shown), default=0)
    per = max(1, math.ceil(minutes / _COLUMNS))
    columns = math.ceil(minutes / per)
    wide = (WIDTH - _LEFT - 12) / max(columns, 1)
    most = most or max((max(queues[tls]) for tls in shown), default=1.0) or 1.0
    bottom = 40 + _CELL * len(shown)
    drawing = Drawing(name, title, WIDTH, bottom + 62)
    drawing.text((8, 20), shortened(title, TITLE), 14, bold=True)
    for row, tls in enumerate(shown):
        top = 34 + _CELL * row
        drawing.text((_LEFT - 7, top + 13), shortened(tls, 16), 11, anchor="end")
        parts = [queues[tls][k * per : (k + 1) * per] for k in range(columns)]
        colours = [step(sum(p) / len(p), 0, most) if p else "paper" for p in parts]
        start = 0
        for colour, run in itertools.groupby(colours):
            count = len(list(run))
            drawing.box(_LEFT + wide * start, top, wide * count, _CELL - 1.5, colour)
            start += count
    for minute in range(0, minutes + 1, _tick(minutes)):
        x = _LEFT + wide * minute / per
        drawing.text((x, bottom + 10), str(minute), 12, "soft", "middle")
    drawing.text((WIDTH - 14, bottom + 25), "minute of the episode", 12, "soft", "end")
    _scale(drawing, bottom + 36, (0.0, most), "vehicles standing, mean")
    return drawing


def _tick(minutes: int) -> int:
    return next((k for k in (1, 2, 5, 10, 20, 30, 60) if minutes <= 8 * k), 120)


def _placed(points: Sequence[Point]) -> tuple[Placing, float]:
    x, y = zip(*points, strict=True)
    extent = max(max(x) - min(x), max(y) - min(y), 1.0)
    margin = min(max(90.0, 0.3 * extent), 220.0)
    low, high = (min(x) - margin, min(y) - margin), (max(x) + margin, max(y) + margin)
    width, height = high[0] - low[0], high[1] - low[1]
    scale = min((WIDTH - 16) / width, _MOST_HIGH / height)
    tall = max(height * scale, _LEAST_HIGH)
    left, top = (WIDTH - width * scale) / 2, 34 + (tall - height * scale) / 2
    return Placing(low[0], high[1], scale, left, top), tall


class Placing:
    """Metres of a network to units of a drawing.

    Attributes:
        scale: Units per metre.
    """

    def __init__(self, west: float, north: float, scale: float, left: float, top: float) -> None:
        self.scale = scale
        self._from, self._to = (west, north), (left, top)

    def __call__(self, point: Point) -> Point:
        """Where a point of the network lies in the drawing."""
        x, y = point[0] - self._from[0], self._from[1] - point[1]
        return self._to[0] + x * self.scale, self._to[1] + y * self.scale


def _inside(points: Sequence[Point], bottom: float) -> list[list[Point]]:
    """The parts of a road within the frame; an end that sticks out is cut where it leaves it."""
    found: list[list[Point]] = []
    for one, other in itertools.pairwise(points):
        part = _cut(one, other, (8.0, 34.0), (WIDTH - 8, bottom))
        if part is None:
            continue
        if found and found[-1][-1] == part[0]:
            found[-1].append(part[1])
        else:
            found.append(list(part))
    return found


def _cut(a: Point, b: Point, low: Point, high: Point) -> tuple[Point, Point] | None:
    """The part of a segment in a box (Liang and Barsky)."""
    begin, end = 0.0, 1.0
    for axis in (0, 1):
        way = b[axis] - a[axis]
        for limit, sign in ((low[axis], -1.0), (high[axis], 1.0)):
            p, q = sign * way, sign * (limit - a[axis])
            if p == 0 and q < 0:
                return None
            if p < 0:
                begin = max(begin, q / p)
            elif p > 0:
                end = min(end, q / p)
    if begin >= end:
        return None
    ends = [(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])) for t in (begin, end)]
    return ends[0], ends[1]


def _radius(points: Sequence[Point]) -> float:
    """So large that discs and names below them keep apart."""
    distances = [math.dist(a, b) for a, b in itertools.combinations(points[:400], 2)]
    return min(max(0.36 * min(distances, default=60.0), 3.0), 17.0)


def _scale(drawing: Drawing, top: float, ends: tuple[float, float], unit: str) -> None:
    drawing.text((14, top + 11), tick_text(float(f"{ends[0]:.3g}")), 12, "soft")
    for number, colour in enumerate(STEPS):
        drawing.box(44 + 22 * number, top, 22, 13, colour)
    right = 44 + 22 * len(STEPS) + 6
    drawing.text((right, top + 11), f"{tick_text(float(f'{ends[1]:.3g}'))} {unit}", 12, "soft")
