"""Measured part of a network: lanes with their signals and detectors, in a fixed order."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import (
    GREEN,
    YELLOW,
    Detector,
    DetectorKind,
    Intersection,
    Network,
    Period,
    SignalLog,
    deciding_letter,
    edge_of,
)


@dataclass(frozen=True)
class SiteLane:
    """A lane in front of a traffic light.

    Attributes:
        id: SUMO id of the lane.
        edge: SUMO id of its edge.
        intersection: Index of its intersection in `Site.intersections`.
        links: Indices of its letters in the signal state.
        speed_mps: Speed limit, m/s.
        detectors: Ids of the detectors on it, by kind.
        following: Ids of the edges that it leads to.
    """

    id: str
    edge: str
    intersection: int
    links: tuple[int, ...]
    speed_mps: float
    detectors: Mapping[DetectorKind, tuple[str, ...]]
    following: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Greens:
    """The greens of one lane in one period; all arrays ``(greens,)``, times in s.

    Attributes:
        start_s: Begin of green.
        end_s: End of green and begin of yellow.
        red_s: Begin of red.
        next_s: Begin of the next green, or end of the period.
        protected: True if the green gives right of way.
    """

    start_s: NDArray[np.float64]
    end_s: NDArray[np.float64]
    red_s: NDArray[np.float64]
    next_s: NDArray[np.float64]
    protected: NDArray[np.bool_]


@dataclass(frozen=True)
class Site:
    """All intersections with measured lanes.

    Attributes:
        intersections: SUMO ids of the traffic lights.
        lanes: Incoming lanes.
        exits: Outgoing lanes with an exit detector: index of the intersection, lane, detectors.
        detectors: All detectors.
        owner: SUMO id of the traffic light, by detector.
    """

    intersections: tuple[str, ...]
    lanes: tuple[SiteLane, ...]
    exits: tuple[tuple[int, str, tuple[str, ...]], ...]
    detectors: tuple[Detector, ...]
    owner: Mapping[str, str]

    @classmethod
    def of(cls, network: Network, detectors: Sequence[Detector]) -> Site:
        """Find the traffic light and the lane of every detector.

        Raises:
            MeasuredDataError: No detector is at an intersection with signals.
        """
        by_lane: dict[str, dict[DetectorKind, list[str]]] = {}
        for item in detectors:
            by_lane.setdefault(item.lane, {}).setdefault(item.kind, []).append(item.id)
        lanes: list[SiteLane] = []
        exits: list[tuple[int, str, tuple[str, ...]]] = []
        owner: dict[str, str] = {}
        for index, item in enumerate(network.intersections):
            for lane in item.incoming_lanes:
                found = by_lane.get(lane, {})
                kinds: dict[DetectorKind, tuple[str, ...]] = {
                    kind: tuple(names) for kind, names in found.items() if kind != "exit"
                }
                lanes.append(
                    SiteLane(
                        lane,
                        network.lanes[lane].edge,
                        index,
                        _links(item, lane),
                        network.lanes[lane].speed_mps,
                        kinds,
                        _following(item, lane),
                    )
                )
                owner |= {name: item.id for names in kinds.values() for name in names}
            for lane in item.outgoing_lanes:
                if names := tuple(by_lane.get(lane, {}).get("exit", ())):
                    exits.append((index, lane, names))
                    owner |= dict.fromkeys(names, item.id)
        if not owner:
            raise MeasuredDataError(
                "no detector lies on a lane that leads to or from a traffic light of the network; "
                "check lane_id in detectors.csv"
            )
        names = tuple(item.id for item in network.intersections)
        return cls(names, tuple(lanes), tuple(exits), tuple(detectors), owner)

    @functools.cached_property
    def places(self) -> tuple[tuple[int, str, str], ...]:
        """Index of the intersection, edge and lane of every place: incoming lanes, then exits."""
        incoming = [(lane.intersection, lane.edge, lane.id) for lane in self.lanes]
        outgoing = [(owner, edge_of(name), name) for owner, name, _ in self.exits]
        return (*incoming, *outgoing)

    @functools.cached_property
    def counted(self) -> Mapping[str, tuple[str, int]]:
        """Feature and place by detector, for the first detector of each kind on a lane."""
        rows: dict[str, tuple[str, int]] = {}
        for index, lane in enumerate(self.lanes):
            for kind, names in lane.detectors.items():
                rows |= dict.fromkeys(names[:1], (f"count_{kind}", index))
        for index, (_, _, names) in enumerate(self.exits):
            rows |= dict.fromkeys(names[:1], ("count_exit", len(self.lanes) + index))
        return rows

    def greens(self, period: Period) -> tuple[Greens, ...]:
        """Return the greens of every lane that begin and end inside the period."""
        found: list[Greens] = []
        for lane in self.lanes:
            log = period.signals.get(self.intersections[lane.intersection], ())
            found.append(_greens(log, lane.links, period))
        return tuple(found)


def _links(item: Intersection, lane: str) -> tuple[int, ...]:
    return tuple(sorted({link.index for link in item.links if link.from_lane == lane}))


def _following(item: Intersection, lane: str) -> frozenset[str]:
    return frozenset(link.to_edge for link in item.links if link.from_lane == lane)


def _greens(log: SignalLog, links: tuple[int, ...], period: Period) -> Greens:
    """Return the greens of a lane from the letters of its links in the signal log."""
    seen: dict[str, str] = {}
    changes: list[tuple[float, str]] = []
    for time, state in log:
        shown = seen.get(state)
        if shown is None:
            shown = seen[state] = deciding_letter([state[index] for index in links])
        kind = "G" if shown in GREEN else "y" if shown in YELLOW else "r"
        if not changes or _kind(changes[-1][1]) != kind:
            changes.append((time, shown))
    rows: list[tuple[float, float, float, bool]] = []
    for (start, shown), (end, after), (later, _) in zip(
        changes, changes[1:], [*changes[2:], (period.end_s, "r")], strict=False
    ):
        if shown in GREEN and start >= period.begin_s and end < period.end_s:
            red = min(later, period.end_s) if after in YELLOW else end
            rows.append((start, end, red, shown == "G"))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    starts = np.array([*(time for time, shown in changes if shown in GREEN), np.inf])
    after = starts[np.searchsorted(starts, table[:, 0], "right")]  # a green cut by the end as well
    following = np.minimum(after, period.end_s)
    return Greens(table[:, 0], table[:, 1], table[:, 2], following, table[:, 3] > 0)


def _kind(shown: str) -> str:
    return "G" if shown in GREEN else "y" if shown in YELLOW else "r"
