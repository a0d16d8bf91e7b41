"""A picture of the network with its vehicles and signals, as pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.measurements import HALTING_MPS
from ugat_marl.network import Network
from ugat_marl.simulator import VehiclePicture

_COLOURS = {
    "G": "#1a9850", "g": "#66bd63", "y": "#fdae61", "Y": "#fdae61", "u": "#fdae61",
    "r": "#d73027", "s": "#9970ab",
}  # fmt: skip
_SIZE_PX = 800


class Picture:
    """Draws one network again and again; the roads are drawn once.

    Args:
        network: What to draw.
    """

    def __init__(self, network: Network) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection, PatchCollection
        from matplotlib.figure import Figure

        self._patches = PatchCollection
        points = np.concatenate([np.array(lane.shape) for lane in network.lanes.values()])
        low, high = points.min(axis=0) - 20, points.max(axis=0) + 20
        width, height = high - low
        scale = _SIZE_PX / max(width, height)
        figure = Figure(figsize=(width * scale / 100, height * scale / 100), dpi=100)
        self._canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal", adjustable="datalim")
        axes.axis("off")
        shapes = [np.array(lane.shape) for lane in network.lanes.values()]
        lane_points = max(1.0, 3.0 * scale * 72 / 100)
        axes.add_collection(LineCollection(shapes, colors="#c8c8c8", linewidths=lane_points))
        self._axes = axes
        self._stop_lines: list[tuple[str, int, NDArray[np.float64]]] = [
            (item.id, link.index, _stop_line(network.lanes[link.from_lane].shape))
            for item in network.intersections
            for link in item.links
        ]
        self._lines = LineCollection([line for *_, line in self._stop_lines], linewidths=2.5)
        axes.add_collection(self._lines)
        self._vehicles: Any = None

    def draw(self, vehicles: VehiclePicture, states: dict[str, str]) -> None:
        """Puts vehicles and signal states into the picture."""
        if self._vehicles is not None:
            self._vehicles.remove()
            self._vehicles = None
        if len(vehicles.length_m):
            placed = vehicles.position, vehicles.angle_deg, vehicles.length_m
            self._vehicles = self._patches(
                [_body(*row) for row in zip(*placed, strict=True)],
                facecolors=[
                    "#b2182b" if v < HALTING_MPS else "#2166ac" for v in vehicles.speed_mps
                ],
                zorder=3,
            )
            self._axes.add_collection(self._vehicles)
        letters = [states.get(tls, "")[index : index + 1] for tls, index, _ in self._stop_lines]
        self._lines.set_color([_COLOURS.get(letter, "#888888") for letter in letters])

    def pixels(self) -> NDArray[np.uint8]:
        """The picture, uint8 ``(height, width, 3)``."""
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def _stop_line(shape: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """A bar of 3 m across the end of a lane."""
    before, end = np.array(shape[-2]), np.array(shape[-1])
    along = (end - before) / max(float(np.linalg.norm(end - before)), 1e-9)
    across = np.array([-along[1], along[0]])
    return np.array([end - 1.5 * across, end + 1.5 * across])


def _body(position: NDArray[np.float64], angle_deg: float, length_m: float) -> Any:
    from matplotlib.patches import Polygon

    angle = np.deg2rad(angle_deg)
    along = np.array([np.sin(angle), np.cos(angle)])
    across = np.array([along[1], -along[0]])
    back = position - length_m * along
    return Polygon([back - across, back + across, position + across, position - across])
