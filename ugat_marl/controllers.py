"""Controllers that follow a rule: what a learned policy has to beat.

The rules read queues and vehicles from the observation `movements`, as a detector would give them;
a rule never looks into the simulator.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.network import Intersection, Network
from ugat_marl.policy import Actions, AnyParallelEnv, Infos, Observations, Policy
from ugat_marl.seeding import numpy_generator
from ugat_marl.signals import GREEN

NAMES = ("fixed-time", "largest-queue", "max-pressure", "programme", "random")
"""The controllers, as `controller_for` spells them."""

DEFAULT_SECONDS: Mapping[str, float] = {"fixed-time": 30, "largest-queue": 20, "max-pressure": 10}
"""What ``name`` without ``:seconds`` means; controllers that are not here take no seconds."""

STANDARD_RULES = (
    *(f"largest-queue:{hold_s}" for hold_s in (10, 20, 30, 40)),
    *(f"max-pressure:{hold_s}" for hold_s in (10, 20, 30)),
    *(f"fixed-time:{green_s}" for green_s in (20, 30, 40)),
    "programme",
)
"""What the search for the best rule of a domain tries."""

MOST_SEARCHED_PHASES = 12
"""Up to so many phases the smallest cover is searched exhaustively; above, greedily."""


@dataclass(frozen=True)
class Streets:
    """What a rule knows about the network it controls.

    Attributes:
        intersections: Agent to intersection.
        capacity: Lane to the number of vehicles that fit on it, the unit of `movements`.
        decision_interval_s: Seconds from one decision to the next.
    """

    intersections: Mapping[str, Intersection]
    capacity: Mapping[str, float]
    decision_interval_s: float

    @classmethod
    def of(cls, env: AnyParallelEnv) -> Streets:
        """The streets below an environment of the suite, wrapped or not."""
        base: Any = env.unwrapped
        network: Network = base.network
        tls_of: Mapping[str, str] = base.intersection_of
        return cls(
            {agent: network.intersection(tls_of[agent]) for agent in base.possible_agents},
            {name: lane.capacity for name, lane in network.lanes.items()},
            base.decision_interval_s,
        )

    def decisions(self, seconds: float) -> int:
        """The fewest decisions that last at least `seconds`."""
        if not 0 < seconds < math.inf:
            raise OptionError(f"a phase cannot be held {seconds} s; give a number above 0")
        return math.ceil(seconds / self.decision_interval_s - 1e-9)


class _Scored:
    """Takes the phase of highest score and holds it for at least `hold_s`.

    The held phase is reconsidered at every decision after that. Between equal scores the phase
    already shown wins, then the one of lower index.
    """

    env_options: Mapping[str, Any] = {"observation": "movements"}

    def __init__(self, streets: Streets, weights: Mapping[str, NDArray[np.float64]], hold_s: float):
        self._weights = weights
        self._hold = streets.decisions(hold_s)
        self._shown: dict[str, int] = {}
        self._age: dict[str, int] = {}

    def reset(self, seed: int) -> None:
        """Forgets which phases are shown and for how long."""
        self._shown, self._age = {}, {}

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """The phase of each intersection by the rule, among those its mask allows."""
        return {
            agent: self._choose(agent, observations[agent], _mask(infos, agent, weights.shape[0]))
            for agent, weights in self._weights.items()
        }

    def scores(self, agent: str, observation: NDArray[np.float32]) -> NDArray[np.float64]:
        """The score of every phase of an agent, ``(phases,)``, in vehicles."""
        weights = self._weights[agent]
        phases, features = weights.shape
        if len(observation) < features + phases:
            raise OptionError(
                f"agent {agent!r} observes {len(observation)} numbers, the rule reads "
                f"{features + phases}; make the environment with observation='movements'"
            )
        return weights @ observation[:features]

    def _choose(
        self, agent: str, observation: NDArray[np.float32], allowed: NDArray[np.bool_]
    ) -> int:
        shown, age = self._shown.get(agent), self._age.get(agent, 0)
        if shown is not None and age < self._hold and allowed[shown]:
            self._age[agent] = age + 1
            return shown
        scores = np.where(allowed, self.scores(agent, observation), -np.inf)
        best = int(scores.argmax())
        if shown is not None and scores[shown] >= scores[best]:
            best = shown
        self._age[agent] = age + 1 if best == shown else 1
        self._shown[agent] = best
        return best


class LargestQueue(_Scored):
    """Serves the phase whose incoming lanes hold the most halting vehicles.

    A phase serves a lane when one of the lane's links is green in it; a lane counts once.

    Args:
        streets: The network.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions.
    """

    def __init__(self, streets: Streets, hold_s: float = 20.0) -> None:
        self.hold_s = hold_s
        weights = {
            agent: _queue_weights(item, streets.capacity)
            for agent, item in streets.intersections.items()
        }
        super().__init__(streets, weights, hold_s)


class MaxPressure(_Scored):
    """Serves the phase of highest pressure (Varaiya 2013).

    The pressure of a phase is the sum over the incoming lanes it serves of the vehicles on the lane
    minus the mean number of vehicles on the lanes its green links lead to. (The mean stands for the
    turning shares, which a controller does not know; where every lane has one link, it is the sum
    over links of upstream minus downstream.)

    Args:
        streets: The network.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions.
    """

    def __init__(self, streets: Streets, hold_s: float = 10.0) -> None:
        self.hold_s = hold_s
        weights = {
            agent: _pressure_weights(item, streets.capacity)
            for agent, item in streets.intersections.items()
        }
        super().__init__(streets, weights, hold_s)


class FixedTime:
    """Equal splits: each phase of a smallest set that serves every link, in turn.

    Args:
        streets: The network.
        green_s: Time from one phase to the next (its clearance included), rounded up to whole
            decisions.
    """

    def __init__(self, streets: Streets, green_s: float = 30.0) -> None:
        self.env_options: Mapping[str, Any] = {}
        self.green_s = green_s
        self._decisions = streets.decisions(green_s)
        self._cycle = {a: covering_phases(item) for a, item in streets.intersections.items()}
        self._phases = {a: len(item.phases) for a, item in streets.intersections.items()}
        self._time = 0

    def reset(self, seed: int) -> None:
        """Starts the cycle again."""
        self._time = 0

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """The phase whose turn it is; where it is masked, the first allowed one."""
        turn = self._time // self._decisions
        self._time += 1
        actions: Actions = {}
        for agent, cycle in self._cycle.items():
            wanted = cycle[turn % len(cycle)]
            allowed = _mask(infos, agent, self._phases[agent])
            actions[agent] = wanted if allowed[wanted] else int(allowed.argmax())
        return actions


class ProgrammeControl:
    """Leaves the signals to the network's own programme; its actions say nothing."""

    def __init__(self, streets: Streets) -> None:
        self.env_options: Mapping[str, Any] = {"signals": "programme"}
        self._agents = tuple(streets.intersections)

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """0 for every agent; the environment ignores it."""
        return dict.fromkeys(self._agents, 0)


class Random:
    """Draws one of the allowed phases, each with equal probability, at every decision."""

    def __init__(self, streets: Streets) -> None:
        self.env_options: Mapping[str, Any] = {}
        self._phases = {a: len(item.phases) for a, item in streets.intersections.items()}
        self._generator = numpy_generator(0, "random-controller")

    def reset(self, seed: int) -> None:
        """Starts the stream of `seed`."""
        self._generator = numpy_generator(seed, "random-controller")

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """A random allowed phase for every agent."""
        return {
            agent: int(self._generator.choice(np.flatnonzero(_mask(infos, agent, phases))))
            for agent, phases in self._phases.items()
        }


def controller_for(spec: str, env: AnyParallelEnv) -> Policy:
    """The controller a spelling such as ``"largest-queue:30"`` names.

    Args:
        spec: A name of `NAMES`, and for those in `DEFAULT_SECONDS` optionally ``:seconds``.
        env: Any environment of the scenario; only its network is read. The controller's
            `env_options` say how the environment it acts in must be made.

    Raises:
        UnknownNameError: No controller of this name.
        OptionError: Seconds that are not a number above 0, or given to a controller without any.
    """
    name, seconds = parse_spec(spec)
    streets = Streets.of(env)
    if name == "fixed-time":
        return FixedTime(streets, seconds)
    if name == "largest-queue":
        return LargestQueue(streets, seconds)
    if name == "max-pressure":
        return MaxPressure(streets, seconds)
    return ProgrammeControl(streets) if name == "programme" else Random(streets)


def parse_spec(spec: str) -> tuple[str, float]:
    """Name and seconds of a controller's spelling (0 seconds for one that takes none).

    Raises:
        UnknownNameError: No controller of this name.
        OptionError: Impossible seconds.
    """
    name, colon, text = spec.partition(":")
    if name not in NAMES:
        raise UnknownNameError("controller", name, NAMES)
    if name not in DEFAULT_SECONDS:
        if colon:
            raise OptionError(f"controller {spec!r}: {name} takes no seconds; write {name!r}")
        return name, 0.0
    try:
        seconds = float(text) if colon else DEFAULT_SECONDS[name]
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise OptionError(
            f"controller {spec!r}: {text!r} is not a number of seconds above 0; write for example "
            f"'{name}:{DEFAULT_SECONDS[name]:g}'"
        )
    return name, seconds


def covering_phases(item: Intersection) -> tuple[int, ...]:
    """The smallest set of phases in which every servable link is green once, ascending.

    Among sets of equal size the one with the fewest green letters in all (least overlap) is taken,
    then the first.
    """
    served = [_green_indices(item, phase) for phase in item.phases]
    wanted = frozenset[int]().union(*served)
    if len(served) > MOST_SEARCHED_PHASES:
        return _greedy_cover(served, wanted)
    for size in range(1, len(served) + 1):
        covers = [
            chosen
            for chosen in combinations(range(len(served)), size)
            if frozenset[int]().union(*(served[i] for i in chosen)) == wanted
        ]
        if covers:
            return min(covers, key=lambda chosen: sum(len(served[i]) for i in chosen))
    raise AssertionError("all phases together serve every servable link")


def _greedy_cover(served: list[frozenset[int]], wanted: frozenset[int]) -> tuple[int, ...]:
    chosen: list[int] = []
    left = wanted
    while left:
        best = max(range(len(served)), key=lambda i: len(served[i] & left))
        chosen.append(best)
        left -= served[best]
    return tuple(sorted(chosen))


def _green_indices(item: Intersection, phase: str) -> frozenset[int]:
    return frozenset(link.index for link in item.links if phase[link.index] in GREEN)


def _queue_weights(item: Intersection, capacity: Mapping[str, float]) -> NDArray[np.float64]:
    """``(phases, 2 * incoming + outgoing)``: halting vehicles that a phase serves, per feature."""
    incoming = list(item.incoming_lanes)
    weights = np.zeros((len(item.phases), 2 * len(incoming) + len(item.outgoing_lanes)))
    for row, phase in enumerate(item.phases):
        green = _green_indices(item, phase)
        for lane in {link.from_lane for link in item.links if link.index in green}:
            weights[row, incoming.index(lane)] = capacity[lane]
    return weights


def _pressure_weights(item: Intersection, capacity: Mapping[str, float]) -> NDArray[np.float64]:
    """``(phases, 2 * incoming + outgoing)``: vehicles upstream minus mean vehicles downstream."""
    incoming, outgoing = list(item.incoming_lanes), list(item.outgoing_lanes)
    weights = np.zeros((len(item.phases), 2 * len(incoming) + len(outgoing)))
    for row, phase in enumerate(item.phases):
        green = _green_indices(item, phase)
        for lane in incoming:
            links = [link for link in item.links if link.from_lane == lane and link.index in green]
            targets = sorted({link.to_lane for link in links})
            if targets:
                weights[row, len(incoming) + incoming.index(lane)] = capacity[lane]
            for target in targets:
                column = 2 * len(incoming) + outgoing.index(target)
                weights[row, column] -= capacity[target] / len(targets)
    return weights


def _mask(infos: Infos, agent: str, phases: int) -> NDArray[np.bool_]:
    mask = infos.get(agent, {}).get("action_mask")
    return np.ones(phases, np.bool_) if mask is None else np.asarray(mask, dtype=np.bool_)
