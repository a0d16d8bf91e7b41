"""Numbers of intersections and lanes on a map of the network, and minute by minute."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ugat_marl.reporting.figures import (
    TOP,
    WIDTH,
    NamedFigure,
    add_axes,
    add_tip,
    new_picture,
    printable,
    shortened,
)
from ugat_marl.reporting.formats import tick_text
from ugat_marl.reporting.style import (
    LIGHT,
    STEPS,
    disagreement_level,
    step,
    styled,
    text_on,
)
from ugat_marl.scenarios import Network

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Point = tuple[float, float]

_NAMED = 30
"""Largest number of intersections whose names are shown; more names would cover the roads."""
_LANE_M = 2.6
"""Width of a lane on a map, m."""
_HIGH, _LOW = 340.0, 150.0
"""Largest and least height of a map, in points."""
_ROWS, _COLUMNS = 16, 60
"""Most intersections and most columns of minutes in a picture of queues."""
_CELL = 17.0
"""Height of a row of a picture of queues, in points."""


@styled()
def node_map(
    name: str, title: str, network: Network, values: Mapping[str, tuple[float, str]],
    ends: tuple[float, float], unit: str, intervals: Mapping[str, str] | None = None,
) -> NamedFigure:  # fmt: skip
    """Draw the network with its intersections coloured by a number.

    Args:
        name: Name of the picture.
        title: Title of the picture.
        network: Network with the intersections.
        values: Intersection to its number and to the text in its circle; nan gets no colour.
        ends: Lower and upper end of the scale of colours.
        unit: Unit of the number.
        intervals: Intersection to the interval of its number, below its name and in its tip.
    """
    centres = {
        intersection.id: intersection.position
        for intersection in network.intersections
        if intersection.id in values
    }
    picture, axes, scale = _map(name, title, network, list(centres.values()), 34)
    radius = _radius([(x * scale, y * scale) for x, y in centres.values()])
    for tls, (x, y) in centres.items():
        value, text = values[tls]
        known = math.isfinite(value)
        colour = step(value, *ends) if known else "paper"
        (disc,) = axes.plot(
            x, y, "o", markersize=2 * radius, markerfacecolor=LIGHT[colour],
            markeredgecolor=LIGHT["soft"], markeredgewidth=1.2, zorder=3,
        )  # fmt: skip
        interval = f" ({intervals[tls]})" if intervals and tls in intervals else ""
        add_tip(disc, f"{tls}: {text or 'no value'}{interval} {unit}")
        if radius >= 11:
            axes.annotate(
                text or "–", (x, y), ha="center", va="center_baseline", fontweight="bold", zorder=4,
                fontsize=min(13.0, 2.6 * radius / max(len(text), 3)),
                color=LIGHT[text_on(colour) if known else "soft"],
            )  # fmt: skip
        if len(centres) <= _NAMED:
            _name(axes, tls, (x, y), -radius - 9)
            if intervals and tls in intervals:
                _name(axes, f"({intervals[tls]})", (x, y), -radius - 22, "soft")
    _add_scale(picture, ends, unit)
    return picture


@styled()
def disagreement_map(
    name: str, title: str, network: Network, lanes: Mapping[str, float], tls: Iterable[str]
) -> NamedFigure | None:
    """Draw the network with its lanes coloured by the disagreement of data and simulation.

    Args:
        name: Name of the picture.
        title: Title of the picture.
        network: Network with the lanes.
        lanes: Lane to its disagreement: root mean square of the standardised differences.
        tls: Traffic lights that the map must show.

    Returns:
        The picture; None if the network has none of the lanes.
    """
    known = {lane: z for lane, z in lanes.items() if lane in network.lanes}
    if not known:
        return None
    shown = set(tls)
    centres = {
        intersection.id: intersection.position
        for intersection in network.intersections
        if intersection.id in shown
    }
    around = [*centres.values()] or [network.lanes[next(iter(known))].shape[-1]]
    picture, axes, scale = _map(name, title, network, around, 8)
    width = max(3.0, _LANE_M * scale)
    for lane, z in sorted(known.items(), key=lambda pair: pair[1]):  # the strongest on top
        (line,) = axes.plot(
            *np.array(network.lanes[lane].shape).T, color=LIGHT[f"d{disagreement_level(z)}"],
            linewidth=width, solid_capstyle="butt", zorder=3,
        )  # fmt: skip
        add_tip(line, f"{lane}: {tick_text(float(f'{z:.3g}'))} standard deviations")
    if len(centres) <= _NAMED:
        for tls_id, centre in centres.items():
            _name(axes, tls_id, centre, 0)
    return picture


@styled()
def minutes_picture(
    name: str, title: str, queues: Mapping[str, Sequence[float]], most: float | None = None
) -> NamedFigure:
    """Draw queues of intersections over the minutes of an episode, the longest queues first.

    Args:
        name: Name of the picture.
        title: Title of the picture.
        queues: Intersection to its mean queue in every minute, vehicles.
        most: Upper end of the scale of colours, vehicles; None for the longest queue.
    """
    from matplotlib.ticker import MaxNLocator

    means = {tls: sum(row) / len(row) for tls, row in queues.items() if row}
    shown = sorted(means, key=lambda tls: -means[tls])[:_ROWS]
    minutes = max((len(queues[tls]) for tls in shown), default=0)
    per = max(1, math.ceil(minutes / _COLUMNS))
    most = most or max((max(queues[tls]) for tls in shown), default=1.0) or 1.0
    picture = new_picture(name, title, TOP + _CELL * len(shown) + 74)
    axes = add_axes(picture, 118, TOP, 12, 74)
    for row, tls in enumerate(shown):
        starts = range(0, len(queues[tls]), per)
        parts = [queues[tls][start : start + per] for start in starts]
        colours = [step(sum(part) / len(part), 0, most) for part in parts]
        begin = 0
        for colour, run in itertools.groupby(colours):
            count = per * len(list(run))
            axes.barh(row, count, 0.91, begin, color=LIGHT[colour], linewidth=0)
            begin += count
    axes.set_xlim(0, max(minutes, 1))
    axes.set_ylim(len(shown) - 0.5, -0.5)
    names = [printable(shortened(tls, 16)) for tls in shown]
    axes.set_yticks(range(len(shown)), names, color=LIGHT["ink"], fontsize=11)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(visible=False)
    axes.set_xlabel("minute of the episode", loc="right")
    _add_scale(picture, (0.0, most), "vehicles standing, mean")
    return picture


def _map(
    name: str, title: str, network: Network, points: Sequence[Point], below: float
) -> tuple[NamedFigure, Axes, float]:
    """Return a picture of the roads around some points, its axes, and its scale.

    The scale is in points of the picture per metre.
    """
    from matplotlib.collections import LineCollection

    low, high = _frame(points)
    extent = high - low
    scale = float(min((WIDTH - 16) / extent[0], _HIGH / extent[1]))
    size = np.array([WIDTH - 16, max(extent[1] * scale, _LOW)])
    picture = new_picture(name, title, TOP + size[1] + below)
    axes = add_axes(picture, 8, TOP, 8, below)
    half = size / scale / 2
    low, high = (low + high) / 2 - half, (low + high) / 2 + half
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.axis("off")
    shapes = [np.array(lane.shape) for lane in network.lanes.values() if lane.shape]
    near = [s for s in shapes if (s.max(axis=0) >= low).all() and (s.min(axis=0) <= high).all()]
    width = max(2.0, _LANE_M * scale)
    axes.add_collection(LineCollection(near, colors=LIGHT["road"], linewidths=width), autolim=False)
    return picture, axes, scale


def _frame(points: Sequence[Point]) -> tuple[Any, Any]:
    """Return two opposite corners of a frame with some road around the points, m."""
    places = np.array(points)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = min(max(90.0, 0.3 * float(max(high - low))), 220.0)
    return low - margin, high + margin


def _radius(points: Sequence[Point]) -> float:
    """Return a radius, in points, at which discs and the names below them do not overlap."""
    distances = [math.dist(a, b) for a, b in itertools.combinations(points[:400], 2)]
    return min(max(0.36 * min(distances, default=60.0), 3.0), 17.0)


def _name(axes: Axes, name: str, at: Point, down: float, colour: str = "ink") -> None:
    axes.annotate(
        printable(shortened(name, 14)), at, (0, down), textcoords="offset points", ha="center",
        va="center", fontsize=11, color=LIGHT[colour], zorder=5,
        bbox={"boxstyle": "round,pad=0.1", "facecolor": LIGHT["paper"], "edgecolor": "none",
              "alpha": 0.75},
    )  # fmt: skip


def _add_scale(picture: NamedFigure, ends: tuple[float, float], unit: str) -> None:
    """Add the key of the colours at the bottom."""
    from matplotlib.patches import Rectangle

    figure = picture.figure
    width, height = figure.get_size_inches() * 72
    for number, colour in enumerate(STEPS):
        corner = (50 + 22 * number) / width, 13 / height
        box = Rectangle(
            corner, 22 / width, 11 / height, facecolor=LIGHT[colour], linewidth=0,
            transform=figure.transFigure,
        )  # fmt: skip
        figure.add_artist(box)
    low, high = (tick_text(float(f"{end:.3g}")) for end in ends)
    style: dict[str, Any] = {"color": LIGHT["soft"], "va": "center_baseline"}
    figure.text(44 / width, 18 / height, low, ha="right", **style)
    figure.text((56 + 22 * len(STEPS)) / width, 18 / height, f"{high} {unit}", **style)
