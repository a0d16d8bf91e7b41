"""Observations: from a snapshot to one vector per intersection, with its space.

Every vector is ``features | own phase one-hot | context``. Features are measured at the
intersection. The context holds features and phases of neighbours and, at its end, the agent's own
last commands with the age of its green (`CommandMemory`); it is empty by default.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from ugat_marl.data import AgentLayout
from ugat_marl.envs.commands import CommandMemory, memory_size
from ugat_marl.envs.rewards import IntersectionView, IntersectionViews
from ugat_marl.errors import LogError, OptionError, UnknownNameError
from ugat_marl.scenarios import Intersection, Network, group_names, member_names, within_hops
from ugat_marl.simulation import Snapshot

ObservationName = Literal["count", "queue", "pressure", "waiting", "density", "movements"]

ObservationFunction = Callable[[IntersectionView], Any]
"""Function from the view of an intersection to its features, a row of numbers."""

COUNT_SCALE = 40.0
"""Number of vehicles for a count of 1; about as many fit on a lane of 300 m."""

WAITING_SCALE_S = 100.0
"""Mean waiting time per storage place that makes `waiting` 1."""

OBSERVATION_UNITS: dict[str, str] = {
    "count": "vehicles per incoming lane / 40",
    "queue": "halting vehicles per incoming lane / 40",
    "pressure": "vehicles / lane capacity, incoming lane minus mean of the lanes its links lead to",
    "waiting": "waiting time summed over the lane's vehicles / (lane capacity * 100 s)",
    "density": "vehicles per incoming lane / lane capacity (lane length / 7.5 m)",
    "movements": "halting per incoming, vehicles per incoming, vehicles per outgoing lane; "
    "each / lane capacity",
}  # fmt: skip
"""Meaning and unit of one feature of each observation. All are clipped to [0, 1] (pressure: [-1,
1])."""


class Observer:
    """Computes the observations of all intersections at once.

    Args:
        network: The network.
        observation: One of `ObservationName`, or a function of an `IntersectionView` that returns
            the features of an intersection. ``"count"`` is the observation of the UGAT paper.
        neighbours: Distance in roads up to which features and phases of others are included.
        commands: Number of own last commands that are included, with the age of the green.

    Attributes:
        layouts: Sizes of the parts of each intersection's vector, in the network's order.
        spaces: A float32 `Box` for each intersection; one object for equal ones.
        groups: Group to the positions of its intersections. Intersections of a group have equal
            numbers of lanes and phases, so their spaces are equal under every observation, and
            the names of agents do not depend on the observation.
        agents: Name ``<group>_<n>`` of each intersection.
        commands: Number of own last commands that are included.
        near: For each intersection the positions of the others that are included.
        feature_names: For each intersection lane and meaning of its features.
    """

    def __init__(
        self,
        network: Network,
        observation: str | ObservationFunction = "count",
        neighbours: int = 0,
        commands: int = 0,
    ) -> None:
        name = "function" if callable(observation) else str(observation)
        self._function = observation if callable(observation) else None
        if self._function is None and name not in get_args(ObservationName):
            raise UnknownNameError(
                "observation", name, get_args(ObservationName), "A function works as well."
            )
        if neighbours < 0:
            raise OptionError(f"neighbours = {neighbours}: must be 0 or a number of roads")
        self.name = name
        self.commands = commands
        self._lanes = network.lane_table()
        items = network.intersections
        columns = [self._lanes.indices(intersection.incoming_lanes) for intersection in items]
        self._incoming = np.concatenate(columns)
        self._downstream = _downstream_matrix(network) if name == "pressure" else None
        if name == "movements":
            columns = _movement_positions(network)
            self._movements = np.concatenate(columns)
        sizes = [len(column) for column in columns]
        if self._function is not None:
            self._views = IntersectionViews(network)
            idle = Snapshot.idle(len(self._lanes.ids))
            sizes = [len(self._features(view)) for view in self._views(idle)]
        self._sizes = sizes
        self._phases = [len(intersection.phases) for intersection in items]
        self.near = _within(network, neighbours)
        self.feature_names = [
            _feature_names(item, name, size)
            for item, size in zip(network.intersections, sizes, strict=True)
        ]
        contexts = [
            sum(sizes[j] + self._phases[j] for j in near) + memory_size(phases, commands)
            for phases, near in zip(self._phases, self.near, strict=True)
        ]
        try:
            self.layouts = [*map(AgentLayout, sizes, self._phases, contexts)]
        except LogError as error:
            given = f"commands = {commands}, neighbours = {neighbours}"
            raise OptionError(f"{given}: {error}") from None
        sizes_of = [(len(i.incoming_lanes), len(i.outgoing_lanes), len(i.phases)) for i in items]
        kinds = [
            (sizes_of[index], *(sizes_of[j] for j in near)) for index, near in enumerate(self.near)
        ]
        self.groups = group_names(kinds)
        self.agents = member_names(self.groups)
        low, high = {"pressure": (-1.0, 1.0), "function": (-np.inf, np.inf)}.get(name, (0.0, 1.0))
        spaces = {
            members[0]: self._space(members[0], low, high) for members in self.groups.values()
        }
        first = {place: members[0] for members in self.groups.values() for place in members}
        self.spaces = [spaces[first[index]] for index in range(len(items))]
        self._place()

    @property
    def needs_waiting(self) -> bool:
        """True if snapshots must hold waiting times."""
        return self.name == "waiting" or self._function is not None

    @property
    def needs_upstream(self) -> bool:
        """True if snapshots must hold the vehicles that queue upstream of lanes."""
        return self._function is not None

    @property
    def recorded(self) -> list[AgentLayout]:
        """Layouts of the vectors without the memory of commands, as logs record them."""
        return [
            replace(layout, context=layout.context - memory_size(layout.phases, self.commands))
            for layout in self.layouts
        ]

    def memory(self, interval_s: float) -> CommandMemory | None:
        """Return an empty memory of commands for `observe`; None if none are included."""
        return CommandMemory(self._phases, self.commands, interval_s) if self.commands else None

    def observe(
        self, snapshot: Snapshot, phases: Sequence[int], memory: CommandMemory | None = None
    ) -> list[NDArray[np.float32]]:
        """Return the vectors of all intersections.

        Args:
            snapshot: Measured lanes.
            phases: Phase of each intersection that is green or about to be; -1 for none.
            memory: The last commands, for an observer that includes them.

        Returns:
            For each intersection float32 ``(layout.size,)``, in fresh memory.
        """
        vector = np.zeros(self._length, dtype=np.float32)
        vector[self._feature_places] = self._flat(snapshot)
        places = np.array(phases)
        vector[(self._first_phases + places)[places >= 0]] = 1.0
        seen = vector if self._context is None else vector[self._context]
        rows = [seen[part] for part in self._parts]
        if memory is None:
            return rows
        return [np.concatenate(both) for both in zip(rows, memory.vectors(), strict=True)]

    def _place(self) -> None:
        """Compute the places of all numbers in one row, and the places that each agent sees.

        The row holds ``features | phases`` of all intersections. `observe` then needs three
        assignments for any number of intersections.
        """
        features = [layout.features for layout in self.layouts]
        widths = [f + phases for f, phases in zip(features, self._phases, strict=True)]
        slices = _slices(widths)
        starts = np.array([part.start for part in slices])
        self._length = sum(widths)
        self._first_phases = starts + np.array(features)
        self._feature_places = np.concatenate(
            [
                np.arange(part.start, part.start + f)
                for part, f in zip(slices, features, strict=True)
            ]
        )
        self._context: NDArray[np.int64] | None = None
        self._parts = slices
        if any(self.near):
            places = np.arange(self._length)
            seen = [
                np.concatenate([places[slices[j]] for j in (index, *near)])
                for index, near in enumerate(self.near)
            ]
            self._context = np.concatenate(seen)
            self._parts = _slices([len(part) for part in seen])

    def _flat(self, snapshot: Snapshot) -> NDArray[np.floating]:
        if self._function is not None:
            rows = [self._features(view) for view in self._views(snapshot)]
            for row, layout in zip(rows, self.layouts, strict=True):
                if len(row) != layout.features:
                    raise OptionError(
                        f"observation: the function returned {len(row)} numbers for an "
                        f"intersection for which it returned {layout.features} before; it must "
                        "return always as many"
                    )
            return np.concatenate(rows)
        capacity = self._lanes.storage_veh
        if self.name == "count":
            values = snapshot.vehicles[self._incoming] / COUNT_SCALE
        elif self.name == "queue":
            values = snapshot.halting[self._incoming] / COUNT_SCALE
        elif self.name == "density":
            values = (snapshot.vehicles / capacity)[self._incoming]
        elif self.name == "waiting":
            values = (snapshot.waiting_s / capacity)[self._incoming] / WAITING_SCALE_S
        elif self.name == "pressure":
            assert self._downstream is not None
            filled = snapshot.vehicles / capacity
            return np.clip(filled[self._incoming] - self._downstream @ filled, -1.0, 1.0)
        else:
            both = np.concatenate((snapshot.halting / capacity, snapshot.vehicles / capacity))
            values = both[self._movements]
        return np.minimum(values, 1.0)

    def _features(self, view: IntersectionView) -> NDArray[np.float32]:
        """Return the features that the user's function makes of an intersection."""
        assert self._function is not None
        given = self._function(view)
        try:
            if given is None:  # which NumPy takes for a number that is not finite
                raise TypeError
            with np.errstate(over="ignore"):  # what float32 cannot hold is infinite, and refused
                values = np.asarray(given, dtype=np.float64).astype(np.float32)
        except (TypeError, ValueError):
            raise OptionError(
                f"observation: the function returned {str(given)[:80]!r} ({type(given).__name__}); "
                "it must return one row of finite numbers"
            ) from None
        if values.ndim != 1 or not values.size or not np.isfinite(values).all():
            raise OptionError(
                f"observation: the function returned an array of shape {values.shape}"
                f"{'' if np.isfinite(values).all() else ' that is not finite'}; it must return one "
                "row of finite numbers, always as many for an intersection"
            )
        return values

    def _space(self, index: int, low: float, high: float) -> Box:
        lows: list[NDArray[np.float64]] = []
        highs: list[NDArray[np.float64]] = []
        for j in (index, *self.near[index]):
            lows += [np.full(self._sizes[j], low), np.zeros(self._phases[j])]
            highs += [np.full(self._sizes[j], high), np.ones(self._phases[j])]
        memory = memory_size(self._phases[index], self.commands)
        least = np.concatenate([*lows, np.zeros(memory)]).astype(np.float32)
        most = np.concatenate([*highs, np.ones(memory)]).astype(np.float32)
        return Box(least, most, dtype=np.float32)


def _feature_names(item: Intersection, name: str, size: int) -> list[tuple[str, str]]:
    """Return lane and meaning of each feature of an intersection."""
    if name == "function":
        return [("", f"number {place} of the function") for place in range(size)]
    if name != "movements":
        return [(lane, name) for lane in item.incoming_lanes]
    halting = [(lane, "halting vehicles") for lane in item.incoming_lanes]
    incoming = [(lane, "vehicles, incoming") for lane in item.incoming_lanes]
    return halting + incoming + [(lane, "vehicles, outgoing") for lane in item.outgoing_lanes]


def joint_space(spaces: Sequence[Box]) -> Box:
    """Return the space of concatenated vectors, with the dtype of the first space."""
    low = np.concatenate([space.low for space in spaces])
    high = np.concatenate([space.high for space in spaces])
    return Box(low, high, dtype=spaces[0].low.dtype.type)


def _movement_positions(network: Network) -> list[NDArray[np.int64]]:
    """Return the positions of each intersection's `movements` in (halting | vehicles)."""
    lanes = network.lane_table()
    count = len(lanes.ids)
    positions: list[NDArray[np.int64]] = []
    for intersection in network.intersections:
        incoming = lanes.indices(intersection.incoming_lanes)
        outgoing = lanes.indices(intersection.outgoing_lanes)
        positions.append(np.concatenate((incoming, incoming + count, outgoing + count)))
    return positions


def _downstream_matrix(network: Network) -> NDArray[np.float64]:
    """Return a matrix whose rows average, for each incoming lane, the lanes its links lead to."""
    lanes = network.lane_table()
    rows: list[NDArray[np.float64]] = []
    for intersection in network.intersections:
        for lane in intersection.incoming_lanes:
            row = np.zeros(len(lanes.ids))
            for to_lane in {link.to_lane for link in intersection.links if link.from_lane == lane}:
                row[lanes.indices([to_lane])] = 1.0
            rows.append(row / row.sum())
    return np.stack(rows)


def _within(network: Network, hops: int) -> list[list[int]]:
    """Return, for each intersection, the others at most `hops` roads away, nearest first."""
    position = {intersection.id: index for index, intersection in enumerate(network.intersections)}
    near = within_hops(
        {intersection.id: intersection.neighbours for intersection in network.intersections}, hops
    )
    return [[position[name] for name in others] for others in near.values()]


def _slices(sizes: Sequence[int]) -> list[slice]:
    ends = np.cumsum(sizes)
    return [slice(int(end - size), int(end)) for end, size in zip(ends, sizes, strict=True)]
