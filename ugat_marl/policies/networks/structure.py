"""Facts about intersections for networks with structure: movements and phases, or neighbours.

The facts are plain numbers, so a saved policy needs neither network file nor environment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

from pydantic import TypeAdapter

from ugat_marl.data import AgentLayout
from ugat_marl.envs import COUNT_SCALE, AgentSet, AnyParallelEnv, as_traffic_env, memory_size
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import GREEN, Intersection, LaneTable, Link, Network, turn_of

NetworkName = Literal["mlp", "frap", "colight", "universal"]
"""Names of the networks that `q_network` builds."""

MOST_NEIGHBOURS = 5
"""Largest number of neighbours of an intersection in CoLight."""

Places = tuple[int, ...]
"""Places in an observation whose numbers are summed, or positions of agents."""


@dataclass(frozen=True)
class Junction:
    """Movements and phases of one agent's intersection.

    Attributes:
        movements: For each movement and each kind of number, the places in the observation. The
            kinds are halting vehicles, vehicles, and vehicles on the outgoing lanes for the
            observation `movements`, and one kind for the others.
        greens: For each phase, the share of each movement's links that it gives green.
        first_phase: Place in the observation at which the one-hot of the current phase begins.
        vehicles: For each feature of the observation, the number of vehicles that makes it 1; empty
            if features are not numbers of vehicles.
        commands: Places at which the one-hots of the last own commands begin, the latest first.
        age: Place of the age of the green; None if the observation does not hold it.
        interval_s: Seconds from one decision to the next.
        clearance_s: Seconds from the end of a green to the beginning of the next.
    """

    movements: tuple[tuple[Places, ...], ...]
    greens: tuple[tuple[float, ...], ...]
    first_phase: int
    vehicles: tuple[float, ...] = ()
    commands: Places = ()
    age: int | None = None
    interval_s: float = 0.0
    clearance_s: float = 0.0


@dataclass(frozen=True)
class Structure:
    """Name of a network, and the facts about intersections that it needs.

    Attributes:
        network: "frap", "universal" or "colight"; "mlp" needs no structure.
        junctions: For "frap" and "universal", the intersection of each agent, in the order of the
            agents.
        neighbours: For "colight", the positions of each agent's neighbours among the agents.
    """

    network: NetworkName
    junctions: tuple[Junction, ...] = ()
    neighbours: tuple[Places, ...] = ()

    @classmethod
    def of(cls, env: AnyParallelEnv, network: NetworkName) -> Structure | None:
        """Read the intersections of an environment of the suite; return None for "mlp".

        Raises:
            OptionError: The environment is not of the suite, or a wrapper has changed the
                observations in which "frap" and "universal" look for movements.
        """
        if network == "mlp":
            return None
        base = as_traffic_env(env)
        roads, observation = getattr(base, "network", None), getattr(base, "env_options", {})
        if not isinstance(roads, Network) or "observation" not in observation:
            raise OptionError(
                f"network {network!r} reads {_READ[network]} from the road network, which "
                f"{base} does not have; use an environment of ugat_marl.parallel_env, or the "
                "network 'mlp'"
            )
        agents = AgentSet.of(env)
        if network == "colight":
            return cls(network, neighbours=_neighbours(agents, base.intersection_of, roads))
        if callable(observation["observation"]):
            raise OptionError(
                f"network {network!r} cannot tell what the numbers of an observation function are; "
                "use an observation of the suite, or the network 'mlp'"
            )
        agent_layouts = [base.layouts.get(name) for name in agents.names]
        for name, size, layout in zip(
            agents.names, agents.observation_sizes, agent_layouts, strict=True
        ):
            if layout is None or layout.size != size:
                raise OptionError(
                    f"the observation of agent {name!r} has {size} numbers, its intersection's has "
                    f"{layout.size if layout else 0}: network {network!r} cannot tell what they "
                    "are; leave out wrappers of observations, or use the network 'mlp'"
                )
        kind, commands = str(observation["observation"]), int(observation.get("commands", 0))
        junctions: list[Junction] = []
        lanes = roads.lane_table()
        for intersection, layout in zip(roads.intersections, agent_layouts, strict=True):
            assert layout is not None
            junction = _junction(intersection, layout, kind == "movements")
            if network == "universal":
                junction = replace(
                    _with_memory(junction, layout, commands),
                    vehicles=_vehicles(intersection, lanes, kind),
                    interval_s=base.decision_interval_s,
                    clearance_s=base.scenario.timing.clearance_s,
                )
            junctions.append(junction)
        return cls(network, tuple(junctions))

    def checked(self, agents: AgentSet) -> Structure:
        """Return the structure itself if it fits the agents.

        Raises:
            ValueError: It belongs to other agents.
        """
        if self.network == "mlp" or (self.junctions and self.neighbours):
            raise ValueError(f"network {self.network!r} with movements or neighbours it has not")
        if self.network == "colight":
            self._check_neighbours(len(agents))
        else:
            self._check_junctions(agents)
        return self

    def _check_neighbours(self, agents: int) -> None:
        if len(self.neighbours) != agents:
            raise ValueError(f"neighbours of {len(self.neighbours)} agents for {agents}")
        for position, near in enumerate(self.neighbours):
            if len({position, *near}) != 1 + len(near) or not {*near} <= {*range(agents)}:
                raise ValueError(f"agent {position} of {agents} has the neighbours {near}")

    def _check_junctions(self, agents: AgentSet) -> None:
        if len(self.junctions) != len(agents):
            raise ValueError(f"{len(self.junctions)} intersections for {len(agents)} agents")
        kinds = {len(kinds) for junction in self.junctions for kinds in junction.movements}
        if len(kinds) != 1:
            raise ValueError(f"movements with {sorted(kinds)} kinds of numbers")
        if len({len(junction.commands) for junction in self.junctions}) > 1:
            raise ValueError("junctions that show different numbers of commands")
        sizes = zip(self.junctions, agents.observation_sizes, agents.action_counts, strict=True)
        for junction, size, actions in sizes:
            places = [at for kinds in junction.movements for kind in kinds for at in kind]
            places += [] if junction.age is None else [junction.age]
            for first in (junction.first_phase, *junction.commands):
                places += [first, first + actions - 1]
            shares = [share for row in junction.greens for share in row]
            widths = {len(row) for row in junction.greens}
            if (
                not all(0 <= at < size for at in places)
                or len(junction.greens) != actions
                or widths != {len(junction.movements)}
                or not all(0 <= share <= 1 for share in shares)
                or len(junction.vehicles) not in (0, junction.first_phase)
                or min(junction.interval_s, junction.clearance_s) < 0
            ):
                raise ValueError(f"{junction} is none of {size} numbers and {actions} phases")

    @property
    def places(self) -> tuple[Any, ...]:
        """Movements, phases and neighbours, without times and sizes of lanes."""
        junctions = tuple(
            (each.movements, each.greens, each.first_phase, each.commands, each.age)
            for each in self.junctions
        )
        return junctions, self.neighbours

    def written(self) -> dict[str, Any]:
        """Return the structure as a dictionary of plain values, for a checkpoint."""
        return asdict(self)


_READER = TypeAdapter(Structure)
_READ: Mapping[NetworkName, str] = {
    "frap": "movements and phases",
    "universal": "movements and phases",
    "colight": "neighbours",
}


def structure_in(content: Mapping[str, Any], agents: AgentSet) -> Structure | None:
    """Read the structure in a checkpoint; return None if it holds none.

    Raises:
        ValueError: The structure is broken, or belongs to other agents.
    """
    if "structure" not in content:
        return None
    return _READER.validate_python(content["structure"]).checked(agents)


def _neighbours(
    agents: AgentSet, light_of: Mapping[str, str], roads: Network
) -> tuple[Places, ...]:
    """Return each agent's neighbours, one road away, as positions of agents, nearest first."""
    if {*light_of} != {*agents.names}:
        raise OptionError(
            f"network 'colight' does not know the intersections of {', '.join(agents.names[:4])}; "
            "leave out wrappers that rename agents, or use the network 'mlp'"
        )
    at = {light_of[name]: position for position, name in enumerate(agents.names)}
    items = [roads.intersection(light_of[name]) for name in agents.names]

    def metres(intersection: Intersection, other: int) -> float:
        return math.dist(intersection.position, items[other].position)

    return tuple(
        tuple(
            sorted((at[n] for n in intersection.neighbours), key=partial(metres, intersection))[
                :MOST_NEIGHBOURS
            ]
        )
        for intersection in items
    )


def _junction(intersection: Intersection, layout: AgentLayout, halves: bool) -> Junction:
    """Return movements and phases of an intersection.

    Args:
        intersection: The intersection.
        layout: Order of the numbers in its observation.
        halves: True if the observation holds halting vehicles, vehicles and outgoing lanes apart.
    """
    movements: dict[tuple[str, str], list[Link]] = {}
    for link in intersection.links:
        movements.setdefault((link.from_edge, turn_of(link)), []).append(link)
    greens = {
        name: tuple(
            sum(phase[link.index] in GREEN for link in links) / len(links)
            for phase in intersection.phases
        )
        for name, links in movements.items()
    }
    # a movement that every phase treats alike (a right turn that is always green) cannot compete
    told = [name for name, shares in greens.items() if len(set(shares)) > 1] or list(greens)
    return Junction(
        movements=tuple(_places(intersection, movements[name], halves) for name in told),
        greens=tuple(zip(*(greens[name] for name in told), strict=True)),
        first_phase=layout.features,
    )


def _places(intersection: Intersection, links: Sequence[Link], halves: bool) -> tuple[Places, ...]:
    """Return the places of a movement's lanes in the observation, one tuple for each kind."""
    incoming = tuple(sorted({intersection.incoming_lanes.index(link.from_lane) for link in links}))
    if not halves:
        return (incoming,)
    outgoing = sorted({intersection.outgoing_lanes.index(link.to_lane) for link in links})
    count = len(intersection.incoming_lanes)
    return (
        incoming,
        tuple(at + count for at in incoming),
        tuple(at + 2 * count for at in outgoing),
    )


def _with_memory(junction: Junction, layout: AgentLayout, commands: int) -> Junction:
    """Return a junction with the places of the last own commands and of the age of the green."""
    if not commands:
        return junction
    first = layout.size - memory_size(layout.phases, commands)
    places = tuple(first + lag * layout.phases for lag in range(commands))
    return replace(junction, commands=places, age=layout.size - 1)


def _vehicles(intersection: Intersection, lanes: LaneTable, observation: str) -> tuple[float, ...]:
    """Return the number of vehicles that makes each feature 1; empty if it has none."""
    if observation in ("count", "queue"):
        return (COUNT_SCALE,) * len(intersection.incoming_lanes)
    if observation == "density":
        return tuple(lanes.storage_veh[lanes.indices(intersection.incoming_lanes)].tolist())
    if observation == "movements":
        incoming = lanes.storage_veh[lanes.indices(intersection.incoming_lanes)].tolist()
        outgoing = lanes.storage_veh[lanes.indices(intersection.outgoing_lanes)].tolist()
        return (*incoming, *incoming, *outgoing)
    return ()
