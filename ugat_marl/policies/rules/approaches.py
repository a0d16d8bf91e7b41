"""Approaches of the controlled intersections, and the traffic that detectors count on them."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import (
    WAITING_SCALE_S,
    Actions,
    AnyParallelEnv,
    Infos,
    Observations,
    as_traffic_env,
)
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import GREEN, Intersection, Link, Network, SignalTiming, free_flow_s

MOST_SEARCHED_PHASES = 12
"""Largest number of phases for an exhaustive search of the smallest cover.

With more phases the search is greedy.
"""


@dataclass(frozen=True)
class ControlledNetwork:
    """Static facts about the network that a rule controls.

    Attributes:
        intersections: Agent to intersection.
        capacity: Lane to the number of vehicles that fit on it. The observation `movements` holds
            vehicles divided by this number.
        free_flow_s: Lane to the seconds that a vehicle needs, at the speed limit, along the length
            on which vehicles are counted.
        decision_interval_s: Seconds from one decision to the next.
        clearance_s: Seconds of yellow and all-red between two greens.
        road_s: Road (SUMO's edge) to the seconds that a vehicle needs along it at the speed limit.
        straight: Road to the road straight ahead of it, where no light is in between.
        min_green_s: Seconds for which a light holds each green.
    """

    intersections: Mapping[str, Intersection]
    capacity: Mapping[str, float]
    free_flow_s: Mapping[str, float]
    decision_interval_s: float
    clearance_s: float
    road_s: Mapping[str, float] = field(default_factory=dict[str, float])
    straight: Mapping[str, str] = field(default_factory=dict[str, str])
    min_green_s: float = 0.0

    @classmethod
    def of(cls, env: AnyParallelEnv) -> ControlledNetwork:
        """Read the network of an environment of the suite, wrapped or not."""
        base = as_traffic_env(env)
        network, tls_of = base.network, base.intersection_of
        return cls.of_network(
            network,
            {agent: network.intersection(tls_of[agent]) for agent in base.possible_agents},
            base.decision_interval_s,
            base.scenario.timing,
        )

    @classmethod
    def of_network(
        cls,
        network: Network,
        intersections: Mapping[str, Intersection],
        decision_interval_s: float,
        timing: SignalTiming,
    ) -> ControlledNetwork:
        """Collect the facts about a network whose intersections have these names."""
        lanes = network.lanes
        return cls(
            intersections,
            {name: lane.storage_veh for name, lane in lanes.items()},
            {name: lane.counted_m / lane.speed_mps for name, lane in lanes.items()},
            decision_interval_s,
            timing.clearance_s,
            free_flow_s(lanes.values()),
            network.straight,
            timing.min_green_s,
        )

    @cached_property
    def approaches(self) -> dict[str, Approach]:
        """Agent to the lanes and phases of its intersection."""
        return {
            agent: Approach.of(intersection, self)
            for agent, intersection in self.intersections.items()
        }

    @cached_property
    def phases(self) -> dict[str, int]:
        """Agent to the number of its phases."""
        return {agent: len(item.phases) for agent, item in self.intersections.items()}

    def decisions(self, seconds: float) -> int:
        """Return the fewest decisions that last at least `seconds`."""
        if not 0 < seconds < math.inf:
            raise OptionError(f"a phase cannot be held {seconds} s; give a number above 0")
        return max(1, math.ceil(seconds / self.decision_interval_s - 1e-9))

    def planned_decisions(self, seconds: float) -> int:
        """Return the fewest decisions of a phase in a plan that lasts at least `seconds`.

        No phase is shorter than clearance and minimum green. The light would hold the one before
        it through its turn, and the plan would skip the same phase in every cycle.
        """
        least = least_decisions(self.clearance_s, self.min_green_s, self.decision_interval_s)
        return max(self.decisions(seconds), least)


def least_decisions(clearance_s: float, min_green_s: float, decision_interval_s: float) -> int:
    """Return the decisions that clearance and minimum green take, at least 1."""
    return max(1, math.ceil((clearance_s + min_green_s) / decision_interval_s - 1e-9))


class EachLight:
    """Base of rules that choose for each light from its own observation.

    Args:
        network: The controlled network.
    """

    def __init__(self, network: ControlledNetwork) -> None:
        self._phases = network.phases

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the phase that the rule chooses for each agent among the allowed ones."""
        return {
            agent: self._choose(agent, observations[agent], allowed_phases(infos, agent, phases))
            for agent, phases in self._phases.items()
        }

    def _choose(
        self, agent: str, observation: NDArray[np.float32], allowed: NDArray[np.bool_]
    ) -> int:
        raise NotImplementedError


class Traffic(NamedTuple):
    """Vehicles counted on the incoming lanes of an intersection, ``(lanes,)`` each.

    Attributes:
        halting: Standing vehicles.
        vehicles: All vehicles, standing or moving.
        shown: Phase that is green; during a clearance, the phase that follows it.
    """

    halting: NDArray[np.float64]
    vehicles: NDArray[np.float64]
    shown: int


@dataclass(frozen=True, eq=False)
class Approach:
    """The incoming lanes of one intersection and the phases that serve them.

    Attributes:
        lanes: The lanes, in the order of the observation.
        outgoing: Number of outgoing lanes.
        capacity: Vehicles that fit on each lane, ``(lanes,)``.
        free_flow_s: Seconds along the counted length of each lane at the speed limit, ``(lanes,)``.
        served: True where a phase shows green to a link for which a lane waits, see
            `awaited_links`, ``(phases, lanes)``.
        cycle: A smallest set of phases that serves every link.
    """

    lanes: tuple[str, ...]
    outgoing: int
    capacity: NDArray[np.float64]
    free_flow_s: NDArray[np.float64]
    served: NDArray[np.bool_]
    cycle: tuple[int, ...]

    @classmethod
    def of(cls, intersection: Intersection, network: ControlledNetwork) -> Approach:
        """Collect the lanes and phases of one intersection."""
        lanes = intersection.incoming_lanes
        awaited = awaited_links(intersection)
        served = np.array(
            [
                [any(phase[link.index] in GREEN for link in awaited[lane]) for lane in lanes]
                for phase in intersection.phases
            ]
        )
        return cls(
            lanes,
            len(intersection.outgoing_lanes),
            np.array([network.capacity[lane] for lane in lanes]),
            np.array([network.free_flow_s[lane] for lane in lanes]),
            served,
            covering_phases(intersection),
        )

    def traffic(self, agent: str, observation: NDArray[np.float32]) -> Traffic:
        """Read the traffic on the incoming lanes from the observation `movements`."""
        lanes, phases = len(self.lanes), len(self.served)
        end = 2 * lanes + self.outgoing
        check_length(agent, observation, end + phases, "movements")
        seen = observation.astype(np.float64)
        return Traffic(
            seen[:lanes] * self.capacity,
            seen[lanes : 2 * lanes] * self.capacity,
            int(observation[end : end + phases].argmax()),
        )

    def waiting_s(self, agent: str, observation: NDArray[np.float32]) -> NDArray[np.float64]:
        """Read vehicle-seconds of waiting, ``(lanes,)``, from the observation `waiting`."""
        lanes = len(self.lanes)
        check_length(agent, observation, lanes + len(self.served), "waiting")
        return observation[:lanes].astype(np.float64) * self.capacity * WAITING_SCALE_S


def check_length(agent: str, observation: NDArray[np.float32], least: int, name: str) -> None:
    """Refuse an observation with fewer numbers than the rule reads."""
    if len(observation) < least:
        raise OptionError(
            f"agent {agent!r} observes {len(observation)} numbers, the rule reads "
            f"{least}; make the environment with observation={name!r}"
        )


def allowed_phases(infos: Infos, agent: str, phases: int) -> NDArray[np.bool_]:
    """Return a mask of the phases that an agent may choose, ``(phases,)``; all without a mask."""
    mask = infos.get(agent, {}).get("action_mask")
    if mask is None:
        return np.ones(phases, np.bool_)
    return np.asarray(mask, dtype=np.bool_)[:phases]  # behind the light's own ones is padding


def permitted(wanted: int, allowed: NDArray[np.bool_]) -> int:
    """Return the wanted phase; if it is masked, the first allowed one."""
    return wanted if allowed[wanted] else int(allowed.argmax())


def permitted_phases(wanted: Mapping[str, int], infos: Infos, phases: Mapping[str, int]) -> Actions:
    """Return the wanted phase of each agent; if it is masked, the first allowed one.

    Args:
        wanted: Phase by agent.
        infos: The infos, with the masks.
        phases: Number of phases by agent.
    """
    return {
        agent: permitted(phase, allowed_phases(infos, agent, phases[agent]))
        for agent, phase in wanted.items()
    }


def green_indices(intersection: Intersection, phase: str) -> frozenset[int]:
    """Return the indices of the links that are green in a phase."""
    return frozenset(link.index for link in intersection.links if phase[link.index] in GREEN)


def awaited_links(intersection: Intersection) -> dict[str, list[Link]]:
    """Return the links of each incoming lane for which its vehicles wait.

    A right turn that every phase of the cycle serves is none of them. On a lane that it shares,
    vehicles that go straight on wait all the same, and others behind them. A lane that has only
    such links keeps them.
    """
    cycle = covering_phases(intersection)
    phases = [intersection.phases[i] for i in cycle] if len(cycle) > 1 else intersection.phases
    always = frozenset.intersection(*(green_indices(intersection, phase) for phase in phases))
    awaited: dict[str, list[Link]] = {}
    for lane in intersection.incoming_lanes:
        links = [link for link in intersection.links if link.from_lane == lane]
        awaited[lane] = [link for link in links if link.index not in always] or links
    return awaited


def covering_phases(intersection: Intersection) -> tuple[int, ...]:
    """Return the smallest set of phases that gives every servable link green, ascending.

    Among sets of equal size, take the one with the fewest green links in all (least overlap). If
    several remain, take the first.
    """
    served = [green_indices(intersection, phase) for phase in intersection.phases]
    covers = smallest_covers(served, MOST_SEARCHED_PHASES)
    return min(covers, key=lambda chosen: sum(len(served[i]) for i in chosen))


def smallest_covers(
    served: Sequence[frozenset[Hashable]], most_searched: int
) -> list[tuple[int, ...]]:
    """Return the smallest sets of phases that serve everything that all phases serve.

    Args:
        served: What each phase serves.
        most_searched: Most phases for an exhaustive search; with more the search is greedy.

    Returns:
        Ascending numbers of phases: all sets of the smallest size, or the one that is found by
        taking the phase that serves most of what is missing.
    """
    wanted = frozenset[Hashable]().union(*served)
    if len(served) <= most_searched:
        for size in range(1, len(served) + 1):
            covers = [
                chosen
                for chosen in combinations(range(len(served)), size)
                if frozenset[Hashable]().union(*(served[i] for i in chosen)) == wanted
            ]
            if covers:
                return covers
    chosen: list[int] = []
    missing = wanted
    while missing:
        best = max(range(len(served)), key=lambda i: len(served[i] & missing))
        chosen.append(best)
        missing -= served[best]
    return [tuple(sorted(chosen))]
