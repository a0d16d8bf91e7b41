"""The network and every intersection with its phases, as SVG and PNG."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import counted
from ugat_marl.progress import Reporter
from ugat_marl.reporting.figures import NamedFigure, printable, shortened
from ugat_marl.reporting.style import LIGHT, styled
from ugat_marl.scenarios import (
    Intersection,
    Link,
    Network,
    Scenario,
    drawing_name,
    green_of_file,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES: dict[str, tuple[str, Literal["solid", "dashed", "dotted"], str]] = {
    "G": (LIGHT["c0"], "solid", "protected green"),
    "g": (LIGHT["c1"], "dashed", "permitted: lets others pass"),
    "s": (LIGHT["c3"], "dotted", "on red after a stop"),
    "r": (LIGHT["stop"], "solid", "red"),
}
"""Colour, line and meaning of each signal. The lines alone suffice in black and white."""
_ROAD, _INK, _WALK = LIGHT["line"], LIGHT["ink"], LIGHT["c2"]
_COLUMNS, _PER_PAGE = 4, 15
_PANEL_IN = 2.45
_ARM_M = 16.0
"""Least length of road that is drawn around an intersection, in metres."""
_UNDER_TEXT = {
    "boxstyle": "round,pad=0.1",
    "facecolor": LIGHT["paper"],
    "edgecolor": "none",
    "alpha": 0.8,
}
_NAMED = 80
"""Largest number of intersections whose names the overview shows."""


@styled()
def plot_network(scenario: Scenario, out: Path, reporter: Reporter) -> list[Path]:
    """Draw the network of a scenario and all its intersections.

    Args:
        scenario: The scenario.
        out: Folder to write to. It gets ``network`` and a picture for every intersection (several
            if it has more than 15 phases), each as ``.svg`` and ``.png``.
        reporter: Reporter of the progress.

    Returns:
        The files written.

    Raises:
        OutputError: The folder cannot be written.
        ScenarioError: The lights of the network cannot be controlled.
    """
    network = Network.read(scenario)
    walks = _crossing_shapes(scenario)
    written = _overview(network, scenario.id).write(out)
    taken = {"network"}
    with reporter.task("drawing intersections", len(network.intersections)) as advance:
        for intersection in network.intersections:
            place = _Place(intersection, network, walks, _frame(intersection, network))
            count = len(intersection.phases)
            pages = [
                range(first, min(first + _PER_PAGE, count)) for first in range(0, count, _PER_PAGE)
            ]
            for number, phases in enumerate(pages, 1):
                name = f"{intersection.id}-{number}" if len(pages) > 1 else intersection.id
                page = _file_name(name, taken)
                written += _sheet(page, place, scenario.id, phases).write(out)
            advance()
    return written


Frame = tuple[float, float, float, float]
"""Left, bottom, width and height of a part of the network, m."""


@dataclass(frozen=True)
class _Place:
    """An intersection with all data for the panels of its sheet.

    Attributes:
        intersection: The intersection.
        network: The network.
        walks: Lane of a crossing to its centre line, ``(points, 2)``, m.
        frame: Part of the network that is drawn.
    """

    intersection: Intersection
    network: Network
    walks: Mapping[str, NDArray[np.float64]]
    frame: Frame


def _crossing_shapes(scenario: Scenario) -> dict[str, NDArray[np.float64]]:
    """Return lane of each crossing to its centre line, ``(points, 2)``, m."""
    shapes: dict[str, NDArray[np.float64]] = {}
    for edge in scenario.network.parse().iter("edge"):
        if edge.get("function") == "crossing":
            for lane in edge.iter("lane"):
                points = [point.split(",")[:2] for point in lane.get("shape", "").split()]
                shapes[lane.get("id", "")] = np.array(points, dtype=np.float64)
    return shapes


def _file_name(tls: str, taken: set[str]) -> str:
    """Return a new name that is valid in any file system, even if that ignores case."""
    name = drawing_name(tls)
    while name.lower() in taken:
        name += "_"
    taken.add(name.lower())
    return name


def _picture(name: str, title: str, width_in: float, height_in: float) -> NamedFigure:
    from matplotlib.figure import Figure

    picture = NamedFigure(name, title, Figure(figsize=(width_in, height_in)))
    picture.figure.text(
        0.02, 1 - 0.1 / height_in, printable(title), size=12, va="top", weight="bold"
    )  # fmt: skip
    return picture


def _sheet(name: str, place: _Place, scenario: str, phases: range) -> NamedFigure:
    """Return a picture of an intersection: its plan and its phases, four panels in a row."""
    intersection = place.intersection
    rows = math.ceil((len(phases) + 1) / _COLUMNS)
    columns = min(_COLUMNS, len(phases) + 1)
    width = max(columns, 3) * _PANEL_IN
    height = rows * (_PANEL_IN + 0.35) + 1.0
    picture = _picture(name, f"{scenario}: {shortened(intersection.id, 40)}", width, height)
    figure = picture.figure
    figure.text(0.02, 1 - 0.42 / height, _caption(intersection), size=8.5, va="top", color=_INK)
    for panel in range(len(phases) + 1):
        row, column = divmod(panel, _COLUMNS)
        left = (column + 0.04) / max(columns, 3)
        bottom = (height - 0.95 - (row + 1) * (_PANEL_IN + 0.35) + 0.3) / height
        axes = figure.add_axes((left, bottom, 0.92 / max(columns, 3), _PANEL_IN * 0.92 / height))
        _roads(axes, place)
        if panel == 0:
            axes.set_title("plan: roads, and the numbers of their links", size=7.5, loc="center")
            _names(axes, place)
            continue
        state = intersection.phases[phases[panel - 1]]
        axes.set_title(
            _phase_title(phases[panel - 1], intersection), size=9, weight="bold", loc="center"
        )
        _ways(axes, place, state)
    _legend(figure, intersection, height)
    return picture


def _phase_title(phase: int, intersection: Intersection) -> str:
    """Return the number of a phase, and which green of the file's programme it is."""
    if not intersection.programme:
        return f"phase {phase}"
    green = green_of_file(intersection, intersection.phases[phase])
    return f"phase {phase} ({'not in the file' if green is None else f'green {green} of the file'})"


def _caption(intersection: Intersection) -> str:
    parts = [
        f"{len(intersection.phases)} phases",
        f"{len(intersection.incoming_lanes)} incoming lanes",
        f"{len(intersection.links)} links",
    ]
    if intersection.crossings:
        parts.append(f"{len(intersection.crossings)} crossings")
    junctions = len({link.junction for link in intersection.links})
    if junctions > 1:
        parts.append(f"{junctions} junctions under one controller")
    return ", ".join(parts)


def _legend(figure: Figure, intersection: Intersection, height: float) -> None:
    from matplotlib.lines import Line2D

    shown = {letter for phase in intersection.phases for letter in phase}
    lines = [
        Line2D([], [], color=colour, linestyle=style, linewidth=2, label=label)
        for letter, (colour, style, label) in STYLES.items()
        if letter in shown
    ]
    if intersection.crossings:
        lines.append(
            Line2D([], [], color=_WALK, linewidth=5, linestyle=(0, (0.6, 0.4)),
                   dash_capstyle="butt", label="crossing, green")
        )  # fmt: skip
    figure.legend(
        handles=lines, loc="upper left", bbox_to_anchor=(0.012, 1 - 0.58 / height), ncols=5,
        frameon=False, fontsize=8.5, borderaxespad=0, handlelength=3.2,
    )  # fmt: skip


def _frame(intersection: Intersection, network: Network) -> Frame:
    """Return the square to draw: all ways across the intersection and some road around them."""
    ends = np.array(
        [network.lanes[link.from_lane].shape[-1] for link in intersection.links]
        + [network.lanes[link.to_lane].shape[0] for link in intersection.links]
    )
    low, high = ends.min(axis=0), ends.max(axis=0)
    side = float(max(high - low)) + 2 * max(_ARM_M, 0.15 * float(max(high - low)))
    middle = (low + high) / 2
    return (float(middle[0]) - side / 2, float(middle[1]) - side / 2, side, side)


def _roads(axes: Axes, place: _Place) -> None:
    from matplotlib.collections import LineCollection

    intersection, network, frame = place.intersection, place.network, place.frame
    left, bottom, width, height = frame
    axes.set_xlim(left, left + width)
    axes.set_ylim(bottom, bottom + height)
    axes.set_aspect("equal")
    axes.axis("off")
    names = {*intersection.incoming_lanes, *intersection.outgoing_lanes}
    before = (network.lanes[lane].behind for lane in intersection.incoming_lanes)
    names |= {name for chain in before for name in chain.lanes if name in network.lanes}
    shapes = [np.array(network.lanes[name].shape) for name in sorted(names)]
    axes.add_collection(
        LineCollection(shapes, colors=_ROAD, linewidths=_points(2.9, frame), capstyle="butt")
    )
    stops = [
        _stop_line(np.array(network.lanes[lane].shape)) for lane in intersection.incoming_lanes
    ]
    axes.add_collection(LineCollection(stops, colors=_INK, linewidths=1.0))


def _points(metres: float, frame: Frame) -> float:
    """Return a width in points on a panel, 1 at least."""
    return max(1.0, metres / frame[2] * _PANEL_IN * 0.92 * 72)


def _stop_line(shape: NDArray[np.float64]) -> NDArray[np.float64]:
    along = _direction(shape[-2], shape[-1])
    across = 1.4 * np.array([-along[1], along[0]])
    return np.array([shape[-1] - across, shape[-1] + across])


def _direction(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    return (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)


def _ways(axes: Axes, place: _Place, state: str) -> None:
    """Draw the links, red ones first so that green covers them, and the crossings."""
    order = "rsgG"
    for link in sorted(place.intersection.links, key=lambda each: order.find(state[each.index])):
        letter = state[link.index] if state[link.index] in STYLES else "r"
        _arrow(axes, _curve(link, place.network), letter)
    _crossings(axes, place, state)


def _crossings(axes: Axes, place: _Place, state: str = "") -> None:
    """Draw crossings as stripes across the road: green ones in colour, others pale."""
    for crossing in place.intersection.crossings:
        if crossing.to_lane not in place.walks:
            continue
        green = bool(state) and state[crossing.index] in "Gg"
        axes.plot(
            *place.walks[crossing.to_lane].T, color=_WALK if green else STYLES["r"][0],
            linewidth=5 if green else 3, linestyle=(0, (0.6, 0.4)), dash_capstyle="butt",
            zorder=5 if green else 2,
        )  # fmt: skip


def _arrow(axes: Axes, curve: NDArray[np.float64], letter: str) -> None:
    colour, style, _ = STYLES[letter]
    stopped = letter == "r"
    axes.plot(
        *curve.T, color=colour, linestyle=style, linewidth=0.7 if stopped else 1.7,
        zorder=2 if stopped else 3, solid_capstyle="butt",
    )  # fmt: skip
    if not stopped:
        axes.annotate(
            "", xy=curve[-1], xytext=curve[-4],
            arrowprops={"arrowstyle": "-|>,head_width=0.22,head_length=0.42", "color": colour,
                        "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0},
            zorder=4,
        )  # fmt: skip


def _curve(link: Link, network: Network) -> NDArray[np.float64]:
    """Return a cubic Bezier curve from the stop line to the first metres of the next lane.

    With the ends ``p0``, ``p3`` and the control points ``p1``, ``p2`` along the lanes, the curve is
    (1-t)³ p0 + 3(1-t)²t p1 + 3(1-t)t² p2 + t³ p3.
    """
    before = np.array(network.lanes[link.from_lane].shape)
    behind = np.array(network.lanes[link.to_lane].shape)
    start, end = before[-1], behind[0]
    out, into = _direction(before[-2], before[-1]), _direction(behind[0], behind[1])
    reach = max(0.42 * float(np.linalg.norm(end - start)), 4.0 if link.direction in "tT" else 0.0)
    t = np.linspace(0, 1, 24)[:, None]
    points = (
        (1 - t) ** 3 * start
        + 3 * (1 - t) ** 2 * t * (start + reach * out)
        + 3 * (1 - t) * t**2 * (end - reach * into)
        + t**3 * end
    )
    return np.vstack([points, end + 4.0 * into])


def _names(axes: Axes, place: _Place) -> None:
    """Draw all links, and beside every incoming road its name and the numbers of its links."""
    intersection, network = place.intersection, place.network
    left, bottom, width, height = place.frame
    by_edge: dict[str, list[str]] = {}
    for lane in intersection.incoming_lanes:
        by_edge.setdefault(network.lanes[lane].edge, []).append(lane)
    for edge, lanes in by_edge.items():
        shapes = [np.array(network.lanes[lane].shape) for lane in lanes]
        end = np.mean([shape[-1] for shape in shapes], axis=0)
        back = -_direction(shapes[0][-2], shapes[0][-1])
        point = end + back * 0.17 * width
        point = np.clip(point, [left + 0.17 * width, bottom + 0.05 * height],
                        [left + 0.83 * width, bottom + 0.95 * height])  # fmt: skip
        indices = sorted({link.index for link in intersection.links if link.from_edge == edge})
        text = f"{printable(shortened(edge, 16))}\n{_ranges(indices)}"
        axes.text(
            point[0], point[1], text, size=6.5, ha="center", va="center", bbox=_UNDER_TEXT, zorder=6
        )
    for link in intersection.links:
        _arrow(axes, _curve(link, network), "r")
    _crossings(axes, place)


def _ranges(numbers: Sequence[int]) -> str:
    """Return numbers as ranges: 0, 1, 2, 5 as ``0-2, 5``."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else f"{p[0]}" for p in parts)


def _overview(network: Network, scenario: str) -> NamedFigure:
    """Return a picture of the whole network with the names of its agents."""
    from matplotlib.collections import LineCollection

    shapes = [np.array(lane.shape) for lane in network.lanes.values()]
    low, high = _bounds(shapes)
    width, height = np.maximum(high - low, 1.0)
    wide = 9.0
    tall = float(np.clip(wide * height / width, 3.0, 12.0))
    count = len(network.intersections)
    picture = _picture("network", f"{scenario}: {counted(count, 'agent')}", wide, tall + 0.5)
    axes = picture.figure.add_axes((0.01, 0.01, 0.98, tall / (tall + 0.5) - 0.02))
    axes.set_aspect("equal", adjustable="datalim")
    axes.axis("off")
    axes.add_collection(LineCollection(shapes, colors=LIGHT["stop"], linewidths=1.0))
    axes.set_xlim(low[0] - 0.02 * width, high[0] + 0.02 * width)
    axes.set_ylim(low[1] - 0.02 * height, high[1] + 0.02 * height)
    places = np.array([intersection.position for intersection in network.intersections])
    axes.plot(*places.T, "o", color=STYLES["G"][0], markersize=6, zorder=3)
    if count <= _NAMED:
        for intersection in network.intersections:
            axes.annotate(
                shortened(intersection.id, 18), intersection.position, xytext=(5, 5),
                textcoords="offset points", size=7.5, color=_INK, zorder=4,
                bbox=_UNDER_TEXT,
            )  # fmt: skip
    return picture


def _bounds(
    shapes: Iterable[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    points = np.concatenate(list(shapes))
    return points.min(axis=0), points.max(axis=0)
