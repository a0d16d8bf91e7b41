"""Queues upstream of the lanes at lights: whose they are, and that nothing counts twice."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from ugat_marl.scenarios import NO_UPSTREAM_LANES, UpstreamLanes
from ugat_marl.simulation.upstream import UpstreamQueues

LANES = ("a_0", "a_1", "b_0", "x_0")
TURNS = (("a", "x", (0, 1)), ("a", "y", (1,)), ("b", "x", (2,)))
"""Lanes 0 and 1 of road a lead straight, lane 1 also to y; b is a road at another light."""


@dataclass
class Roads:
    """Stand-in for libsumo: vehicles with a lane (or a road: due there), a speed and a route."""

    vehicles: dict[str, tuple[str, float, tuple[str, ...]]]
    asked: list[str] = field(default_factory=list[str])
    halted: list[str] = field(default_factory=list[str])

    @property
    def api(self) -> Any:
        def on(road: str) -> list[str]:
            return [n for n, (lane, _, _) in self.vehicles.items() if lane[:-2] == road]

        def halting(road: str) -> int:
            self.halted.append(road)
            return sum(self.vehicles[name][1] < 0.1 for name in on(road))

        def route(name: str) -> tuple[str, ...]:
            self.asked.append(name)
            return self.vehicles[name][2]

        def at(name: str) -> int:
            lane, _, way = self.vehicles[name]
            return way.index(lane[:-2]) if "_" in lane else -1

        def outside() -> list[str]:
            return [name for name, (lane, _, _) in self.vehicles.items() if "_" not in lane]

        def due(road: str) -> list[str]:
            return [name for name, (lane, _, _) in self.vehicles.items() if lane == road]

        links = {"e_0": ("a_0", "f_0"), "f_0": ("b_0",)}

        return SimpleNamespace(
            edge=SimpleNamespace(
                getIDList=lambda: ["a", "b", "e", "f", "x", "y", ":j"],
                getLaneNumber=lambda road: 1,
                getLastStepHaltingNumber=halting,
                getLastStepVehicleIDs=on,
                getPendingVehicles=due,
            ),
            vehicle=SimpleNamespace(
                getSpeed=lambda name: self.vehicles[name][1],
                getLaneID=lambda name: self.vehicles[name][0],
                getRoute=route,
                getRouteIndex=at,
            ),
            lane=SimpleNamespace(getLinks=lambda lane: [(to,) for to in links.get(lane, ())]),
            simulation=SimpleNamespace(getPendingVehicles=outside),
        )


def queued(
    roads: Roads, behind: UpstreamLanes = NO_UPSTREAM_LANES, backlog: int = 1
) -> list[float]:
    return UpstreamQueues(roads.api, LANES, TURNS, behind).measure(backlog).tolist()


def test_each_vehicle_belongs_to_the_next_light_of_its_route() -> None:
    roads = Roads(
        {
            "straight": ("e_0", 0.0, ("e", "a", "x")),  # both lanes lead there: half on each
            "left": ("e_0", 0.05, ("e", "a", "y")),
            "drives": ("e_0", 5.0, ("e", "a", "y")),
            "other light": ("f_0", 0.0, ("f", "b", "x")),
            "between two lights": ("f_0", 0.0, ("a", "y", "f", "b", "x")),
            "waits outside": ("e", 0.0, ("e", "f", "b", "x")),
            "at the light": ("a_1", 0.0, ("a", "y")),  # counted by the lane itself
            "past the last light": ("x_0", 0.0, ("a", "x")),
            "meets no light": ("e", 0.0, ("e", "f")),
        }
    )
    assert queued(roads) == [0.5, 1.5, 3.0, 0.0]
    assert sum(queued(roads, backlog=0)) == 4.0, "SUMO says that nobody waits outside"


def test_what_a_reach_counts_is_left_out() -> None:
    behind = UpstreamLanes(
        lanes=((("e_0", 0.75),), (("e_0", 0.5),), (), ()), roads=((), (), (("f", 0.25),), ())
    )
    roads = Roads(
        {
            "counted": ("e_0", 0.0, ("e", "a", "y")),
            "a quarter is counted": ("f", 0.0, ("f", "b", "x")),
            "beyond the reach": ("f_0", 0.0, ("f", "b", "x")),
        }
    )
    assert queued(roads, behind) == [0.0, 0.0, 1.75, 0.0]


def test_a_vehicle_that_departs_later_on_its_route_belongs_to_the_light_after_that_road() -> None:
    roads = Roads({"departs on f": ("f", 0.0, ("a", "y", "f", "b", "x"))})
    behind = UpstreamLanes(lanes=((),) * 4, roads=((("a", 1.0),), (), (("f", 0.25),), ()))
    assert queued(roads) == [0.0, 0.0, 1.0, 0.0]
    assert queued(roads, behind) == [0.0, 0.0, 0.75, 0.0]
    assert queued(Roads({"past it": ("y", 0.0, ("a", "y"))})) == [0.0] * 4


def test_a_route_is_asked_for_once_on_each_road() -> None:
    roads = Roads({"one": ("e", 0.0, ("e", "f", "b", "x")), "two": ("e_0", 0.0, ("e", "a", "y"))})
    queues = UpstreamQueues(roads.api, LANES, TURNS, NO_UPSTREAM_LANES)
    for _ in range(3):
        queues.measure(1)
    assert sorted(roads.asked) == ["one", "two"]
    roads.vehicles["one"] = ("f_0", 0.0, ("e", "f", "b", "x"))
    assert queues.measure(0).tolist() == pytest.approx([0.0, 1.0, 1.0, 0.0])
    assert sorted(roads.asked) == ["one", "one", "two"]


def test_roads_that_lead_to_no_light_are_not_asked() -> None:
    roads = Roads({"one": ("x_0", 0.0, ("a", "x"))})
    assert queued(roads) == [0.0] * 4
    assert roads.halted == ["e", "f"]
