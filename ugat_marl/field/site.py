"""The controlled site: network, timing, and the observation of a policy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from ugat_marl.envs import CommandMemory, Observer
from ugat_marl.errors import OptionError
from ugat_marl.field.street import LaneCount
from ugat_marl.scenarios import LaneTable, Network, Scenario, SignalTiming, within_hops
from ugat_marl.simulation import Snapshot

_COUNTED = ("count", "queue", "density", "pressure", "movements")
_INCOMING_ONLY = ("count", "queue", "density")
_HALTING = ("queue", "movements")


@dataclass(frozen=True, eq=False)
class Site:
    """Intersections, their timing, and the observation of one policy.

    Attributes:
        network: Lanes, links and phases of the intersections.
        observer: Maker of the policy's observations from counts.
        timing: Minimum green and clearance of all lights, s.
        decision_interval_s: Seconds from one decision to the next.
        sees: Traffic light to the lanes that its agent observes, those of its neighbours included.
        halting: True if the observation needs the number of standing vehicles as well.
    """

    network: Network
    observer: Observer
    timing: SignalTiming
    decision_interval_s: float
    sees: Mapping[str, tuple[str, ...]]
    halting: bool

    @classmethod
    def of(cls, scenario: Scenario, env_options: Mapping[str, Any]) -> Site:
        """Return the site of a scenario, for a policy that relies on `env_options`.

        Raises:
            OptionError: The policy needs data that no detector measures, or it does not choose
                phases, or the scenario counts vehicles upstream of the lanes at the lights.
        """
        name, hops = env_options.get("observation", "count"), env_options.get("neighbours", 0)
        if name not in _COUNTED:
            seen = "waiting times" if name == "waiting" else repr(name)
            raise OptionError(
                f"the policy observes {seen}, which detectors do not count; in the field: "
                f"{', '.join(_COUNTED)}"
            )
        if env_options.get("signals", "actions") != "actions":
            raise OptionError(
                "the policy leaves the signals to the network's own programme; there is nothing "
                "to decide, so take another one"
            )
        control = scenario.control
        if control.reach_m:
            raise OptionError(
                f"scenario {scenario.id!r} counts vehicles {control.reach_m:g} m upstream of stop "
                "lines (reach), the field loop on the lanes at the lights alone; leave it out, and "
                "take a policy that was trained without it"
            )
        network = Network.read(scenario)
        items = network.intersections
        sees = {
            intersection.id: intersection.incoming_lanes
            if name in _INCOMING_ONLY
            else (*intersection.incoming_lanes, *intersection.outgoing_lanes)
            for intersection in items
        }
        near = within_hops(
            {intersection.id: intersection.neighbours for intersection in items}, hops
        )
        return cls(
            network,
            Observer(network, name, hops, env_options.get("commands", 0)),
            scenario.timing,
            control.decision_interval_s,
            {
                light: _with_those_behind(
                    network, (lane for one in (light, *near[light]) for lane in sees[one])
                )
                for light in sees
            },
            name in _HALTING,
        )

    @cached_property
    def lights(self) -> tuple[str, ...]:
        """The traffic lights, in the order of the observer's agents."""
        return tuple(intersection.id for intersection in self.network.intersections)

    @cached_property
    def capacity(self) -> dict[str, float]:
        """Lane that must be counted to the number of vehicles that fit on it alone."""
        lanes = dict.fromkeys(lane for seen_lanes in self.sees.values() for lane in seen_lanes)
        return {lane: replace(self.network.lanes[lane], room_m=0.0).storage_veh for lane in lanes}

    @cached_property
    def spaces(self) -> dict[str, Discrete]:
        """Agent to its action space, one action per phase."""
        items = zip(self.observer.agents, self.network.intersections, strict=True)
        return {agent: Discrete(len(intersection.phases)) for agent, intersection in items}

    def observe(
        self,
        counts: Mapping[str, LaneCount],
        now_s: float,
        phases: list[int],
        memory: CommandMemory | None = None,
    ) -> dict[str, NDArray[np.float32]]:
        """Return the observations of all agents.

        Args:
            counts: Lane to its trusted count. A lane without a count is taken to be empty. The
                caller must ignore the answers of agents that observe such a lane.
            now_s: Time on the street's clock, s.
            phases: Phase that each light shows or clears towards, in the order of the lights.
            memory: The last commands, for a policy that observes them.
        """
        lanes = self._lanes.ids
        nobody = LaneCount(now_s, 0.0, 0.0)
        rows = [counts.get(lane, nobody) for lane in lanes]
        vehicles = np.array([row.vehicles for row in rows])
        halting = np.array([row.halting for row in rows])
        for place, shares in enumerate(self._lanes.behind.lanes):  # of lanes too short for a car
            for lane, share in shares:
                behind = counts.get(lane, nobody)
                vehicles[place] += share * behind.vehicles
                halting[place] += share * behind.halting
        snapshot = Snapshot(
            time_s=now_s,
            vehicles=vehicles,
            halting=halting,
            mean_speed_mps=np.full(len(lanes), np.nan),  # no observation reads it
            waiting_s=np.empty(0),
            departed=0,
            backlog=0,
        )
        seen = self.observer.observe(snapshot, phases, memory)
        return dict(zip(self.observer.agents, seen, strict=True))

    @cached_property
    def _lanes(self) -> LaneTable:
        return self.network.lane_table()


def _with_those_behind(network: Network, lanes: Iterable[str]) -> tuple[str, ...]:
    """Return lanes, each once, with the upstream lanes that count with short ones.

    Lanes inside of junctions are left out: no detector lies there.
    """
    found = (one for lane in lanes for one in (lane, *network.lanes[lane].behind.lanes))
    return tuple(lane for lane in dict.fromkeys(found) if lane in network.lanes)
