"""Picture of the network with its vehicles and signals, as pixels.

Roads, names and the legend are drawn once. Each frame draws signals and vehicles on a copy.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Network
from ugat_marl.simulation import VehiclePositions

SIZE_PX = 1000
"""Longer side of a picture by default, in pixels."""
_LEAST_PX = 220  # of the shorter side
_LEGEND_PX = 34
_DPI = 100
_POINTS = 72 / _DPI  # of type, in a pixel
_LANE_M, _VEHICLE_M = 3.2, 1.9
_LEAST_VEHICLE_PX = 2.4, 4.5  # width and length; smaller ones are invisible on a large network
_NAMED = 100

_SPEEDS = ("#8c0d25", "#d6482f", "#f0a73c", "#56a0c8", "#14508c")
"""Colours from standing to the highest speed limit; the colour-blind can tell them apart."""
_SIGNALS = {"G": "#008f68", "g": "#4fc3a1", "y": "#f0b000", "Y": "#f0b000", "u": "#f0b000"}
_RED, _OFF = "#d1301f", "#888888"

Floats = NDArray[np.float64]


class NetworkRenderer:
    """Draws frames of one network.

    A green signal is a line into the junction; a red or yellow one is a bar across the lane. So
    colour is not the only difference.

    Args:
        network: The network.
        names: Name to the id of a traffic light, to write beside intersections, such as
            `TrafficEnv.intersection_of`; no names by default.
        size_px: Longer side of the picture, in pixels.
    """

    def __init__(
        self, network: Network, names: Mapping[str, str] | None = None, size_px: int = SIZE_PX
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.colors import LinearSegmentedColormap
        from matplotlib.figure import Figure

        self._view = _View.of(network, size_px)
        width, height = self._view.size
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0, 0, 1, 1))
        self._axes.set_xlim(0, width)
        self._axes.set_ylim(0, height)
        self._axes.axis("off")
        self._fastest = max(lane.speed_mps for lane in network.lanes.values())
        self._colours = LinearSegmentedColormap.from_list("speed", _SPEEDS)(np.arange(256))
        self._draw_roads(network)
        self._draw_names(network, names or {})
        self._draw_legend()
        self._canvas.draw()
        self._empty = self._canvas.copy_from_bbox(figure.bbox)
        self._heads = _Heads(network, self._view)
        # Arrays are fastest, but matplotlib's type stubs do not allow them.
        self._lines: Any = LineCollection([], linewidths=max(3.2, self._view.scale) * _POINTS)
        self._lines.set_capstyle("butt")
        self._bodies: Any = PolyCollection([], edgecolors="none")
        for artist in (self._lines, self._bodies):
            self._axes.add_collection(artist, autolim=False)
        self._draw_signals({})

    def draw(self, vehicles: VehiclePositions, states: Mapping[str, str]) -> None:
        """Draw vehicles and signal states (traffic light to SUMO's state letters)."""
        self._canvas.restore_region(self._empty)
        self._draw_signals(states)
        if len(vehicles.length_m):
            self._bodies.set_verts(self._outlines(vehicles))
            share = np.clip(vehicles.speed_mps / self._fastest, 0.0, 1.0)
            self._bodies.set_facecolors(self._colours[np.rint(share * 255).astype(np.int64)])
            self._axes.draw_artist(self._bodies)

    def pixels(self) -> NDArray[np.uint8]:
        """Return the picture, uint8 ``(height, width, 3)``."""
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _draw_signals(self, states: Mapping[str, str]) -> None:
        lines, colours = self._heads.shown(states)
        self._lines.set_segments(lines)
        self._lines.set_color(colours)
        self._axes.draw_artist(self._lines)

    def _outlines(self, vehicles: VehiclePositions) -> Floats:
        """Return the rectangles of vehicles, ``(vehicles, 4, 2)`` in pixels."""
        front = self._view.pixels(vehicles.position)
        angle = np.deg2rad(vehicles.angle_deg)
        along = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        across = np.stack([along[:, 1], -along[:, 0]], axis=1)
        wide, long = _LEAST_VEHICLE_PX
        half = max(_VEHICLE_M * self._view.scale, wide) / 2 * across
        length = np.maximum(vehicles.length_m * self._view.scale, long)
        back = front - length[:, None] * along
        return np.stack([back - half, back + half, front + half, front - half], axis=1)

    def _draw_roads(self, network: Network) -> None:
        from matplotlib.collections import LineCollection

        place, lanes = self._view.pixels, network.lanes
        roads = [place(np.array(lane.shape)) for lane in lanes.values()]
        turns = [
            place(np.array([lanes[link.from_lane].shape[-1], lanes[link.to_lane].shape[0]]))
            for intersection in network.intersections
            for link in intersection.links
            if link.from_lane in lanes and link.to_lane in lanes
        ]
        wide = max(1.6, _LANE_M * self._view.scale) * _POINTS
        for lines, colour in ((turns, "#eceff2"), (roads, "#d5dae0")):
            self._axes.add_collection(
                LineCollection(lines, colors=colour, linewidths=wide), autolim=False
            )

    def _draw_names(self, network: Network, names: Mapping[str, str]) -> None:
        from matplotlib.patheffects import withStroke

        centres = {intersection.id: intersection.position for intersection in network.intersections}
        known = [(name, centres[tls]) for name, tls in names.items() if tls in centres]
        if not known or len(known) > _NAMED:
            return
        points = self._view.pixels(np.array([centre for _, centre in known]))
        apart = _least_distance(points)
        size = min(13.0, apart / 6)
        if size < 6:  # too small to read
            return
        halo = [withStroke(linewidth=3 * _POINTS, foreground="white")]
        away = max(7.0, 10 * self._view.scale)
        for (name, _), (x, y) in zip(known, points.tolist(), strict=True):
            self._axes.text(
                x + away, y + away, name, fontsize=size * _POINTS, color="#1b2430",
                path_effects=halo, zorder=5, parse_math=False,
            )  # fmt: skip

    def _draw_legend(self) -> None:
        """Draw the legend of colours along the lower rim."""
        self._axes.imshow(self._colours[None], extent=(12, 132, 12, 22), aspect="auto", zorder=6)
        width, height = self._view.size
        self._axes.set_xlim(0, width)
        self._axes.set_ylim(0, height)
        self._axes.plot([216, 230], [17, 17], color=_SIGNALS["G"], linewidth=3 * _POINTS)
        self._axes.plot([283, 283], [12, 22], color=_RED, linewidth=3 * _POINTS)
        for x, text in ((138, f"0 to {self._fastest:.0f} m/s"), (235, "green"), (289, "red")):
            size = 12 * _POINTS
            self._axes.text(x, 17, text, fontsize=size, va="center", color="#1b2430", zorder=6)


class _View:
    """Map from metres of a network to pixels of a picture; y goes up in both."""

    def __init__(self, low: Floats, scale: float, offset: Floats, size: tuple[int, int]) -> None:
        self.scale = scale
        self.size = size
        self._low, self._offset = low, offset

    @classmethod
    def of(cls, network: Network, size_px: int) -> _View:
        points = np.concatenate([np.array(lane.shape) for lane in network.lanes.values()])
        low, high = points.min(axis=0) - 15, points.max(axis=0) + 15
        extent = high - low
        scale = float(min(size_px / extent[0], (size_px - _LEGEND_PX) / extent[1]))
        # Video encoders need even sides.
        sides = [2 * round(float(side) / 2) for side in extent * scale + (0, _LEGEND_PX)]
        longest = sides.index(max(sides))
        sides[longest] = 2 * round(size_px / 2)
        shorter = sides[1 - longest]
        nearly = shorter > 0.9 * sides[longest]
        sides[1 - longest] = sides[longest] if nearly else max(shorter, _LEAST_PX)
        free = np.array(sides) - (0, _LEGEND_PX) - extent * scale
        return cls(low, scale, free / 2 + (0, _LEGEND_PX), (sides[0], sides[1]))

    def pixels(self, points: Floats) -> Floats:
        return (points - self._low) * self.scale + self._offset


class _Heads:
    """Signal heads at the ends of lanes, one per link, side by side."""

    def __init__(self, network: Network, view: _View) -> None:
        self._keys: list[tuple[str, int]] = []
        across: list[Floats] = []
        along: list[Floats] = []
        for intersection in network.intersections:
            by_lane = itertools.groupby(
                sorted(intersection.links, key=lambda link: (link.from_lane, link.index)),
                key=lambda link: link.from_lane,
            )
            for lane, links in by_lane:
                lane_links = list(links)
                for number, link in enumerate(lane_links):
                    self._keys.append((intersection.id, link.index))
                    bar, arrow = _head(network.lanes[lane].shape, view, number, len(lane_links))
                    across.append(bar)
                    along.append(arrow)
        self._across, self._along = np.array(across), np.array(along)

    def shown(self, states: Mapping[str, str]) -> tuple[Floats, list[str]]:
        """Return lines, ``(links, 2, 2)``, and colours; grey where lights are off or not known."""
        letters = [states.get(tls, "")[index : index + 1] for tls, index in self._keys]
        green = np.array([letter in ("G", "g") for letter in letters])
        lines = np.where(green[:, None, None], self._along, self._across)
        return lines, [
            _OFF if letter in ("", "o", "O") else _SIGNALS.get(letter, _RED) for letter in letters
        ]


def _head(
    shape: tuple[tuple[float, float], ...], view: _View, number: int, count: int
) -> tuple[Floats, Floats]:
    """Return the bar across a lane's end and the line into the junction of a link, in pixels."""
    before, end = view.pixels(np.array(shape[-2:]))
    way = (end - before) / max(float(np.linalg.norm(end - before)), 1e-9)
    right = np.array([way[1], -way[0]])
    wide = max(_LANE_M * view.scale, 3.0)
    left_end, right_end = (end + right * wide * (k / count - 0.5) for k in (number, number + 1))
    middle = (left_end + right_end) / 2
    return np.array([left_end, right_end]), np.array([middle, middle + way * max(wide * 2.2, 9.0)])


def _least_distance(points: Floats) -> float:
    if len(points) < 2:
        return 200.0
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    return float(apart[np.triu_indices(len(points), 1)].min())
