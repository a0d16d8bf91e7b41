"""What stands between a controller's commands and its lights: delay, loss, order, longest green.

An environment has a `Cabinet` only where its scenario lists effects on commands
(`ugat_marl.effects.acting`). It only changes which phase the signal machine is asked for; that
machine keeps minimum green, yellow and all-red whatever it is asked.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import Effect, ExecutionDelay, LostCommands, MaxGreen, PhaseOrder
from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import Intersection, Network, signals
from ugat_marl.seeding import numpy_generator

_INSTANT_S = 1e-6


class Cabinet:
    """Turns what is asked of all lights into what they are made to do.

    Args:
        effects: Effects of the scenario; those that are not on commands do nothing here.
        network: The network.
        timing: Clearance and minimum green.
        decision_interval_s: Seconds between two commands.

    Raises:
        ScenarioError: An order of phases that an intersection's phases do not allow.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        network: Network,
        timing: signals.SignalTiming,
        decision_interval_s: float,
    ) -> None:
        self._lights = network.intersections
        self._timing = timing
        self._interval_s = decision_interval_s
        self._late = 0
        self._loss = 0.0
        self._most_green_s = np.inf
        rule = ""
        for effect in effects:
            if isinstance(effect, ExecutionDelay):
                self._late = round(effect.seconds / decision_interval_s)
            elif isinstance(effect, LostCommands):
                self._loss = effect.share
            elif isinstance(effect, MaxGreen):
                self._most_green_s = effect.seconds
            elif isinstance(effect, PhaseOrder):
                rule = effect.rule
        self._following = [successors(item, rule) for item in self._lights]

    @classmethod
    def of(
        cls,
        effects: Sequence[Effect],
        network: Network,
        timing: signals.SignalTiming,
        decision_interval_s: float,
    ) -> Cabinet | None:
        """The cabinets of a scenario with these effects; None if every command is obeyed."""
        own = (ExecutionDelay, LostCommands, MaxGreen, PhaseOrder)
        if not any(isinstance(effect, own) for effect in effects):
            return None
        return cls(effects, network, timing, decision_interval_s)

    def reset(self, seed: int) -> None:
        """Begins an episode.

        Args:
            seed: Of the episode; decides which commands are lost.
        """
        self._losses = numpy_generator(seed, "cabinet", LostCommands.name)
        # None: no command has been given that could arrive yet.
        self._under_way: deque[list[int] | None] = deque([None] * self._late)

    def obey(self, commands: Sequence[int], states: Sequence[signals.SignalState]) -> list[int]:
        """What the lights are made to show in the next decision interval.

        Args:
            commands: Phase asked for at each intersection, at this decision.
            states: Where each signal machine stands.
        """
        self._under_way.append(list(commands))
        arrived = self._under_way.popleft()
        lost = self._losses.random(len(states)) < self._loss
        return [
            self._obeyed(place, None if arrived is None or lost[place] else arrived[place], state)
            for place, state in enumerate(states)
        ]

    def masks(self, states: Sequence[signals.SignalState]) -> list[NDArray[np.int8]]:
        """Which commands given now would be obeyed, ``(phases,)`` for each intersection.

        A command that is under way for some time meets another state than the present one: the one
        to which those ahead of it lead, if none of them is lost.
        """
        found: list[NDArray[np.int8]] = []
        for place, state in enumerate(states):
            for commands in self._under_way:
                asked = self._obeyed(place, None if commands is None else commands[place], state)
                state, _ = signals.advance(
                    self._lights[place].phases, state, asked, self._interval_s, self._timing
                )
            found.append(self._mask(place, state))
        return found

    def _obeyed(self, place: int, command: int | None, state: signals.SignalState) -> int:
        """The phase one light is made to show; a command that is not obeyed changes nothing."""
        mask = self._mask(place, state)
        if command is not None and mask[command]:
            return command
        if mask[state.phase]:
            return state.phase
        return self._next(place, state.phase)

    def _mask(self, place: int, state: signals.SignalState) -> NDArray[np.int8]:
        phases = len(self._lights[place].phases)
        mask = np.zeros(phases, dtype=np.int8)
        if signals.free_to_change(state, self._timing, self._interval_s):
            mask[self._following[place][state.phase]] = 1
            mask[state.phase] = not self._too_long(state)
        else:
            mask[state.phase] = 1
        return mask

    def _too_long(self, state: signals.SignalState) -> bool:
        """Whether the green would be longer than allowed at the end of another interval."""
        green_s = 0.0 if state.clearing else state.elapsed_s
        if state.clearing:
            green_s = state.elapsed_s - self._timing.clearance_s
        return green_s + self._interval_s > self._most_green_s + _INSTANT_S

    def _next(self, place: int, phase: int) -> int:
        """The phase that follows a green that has lasted too long: the next one in the list."""
        allowed = self._following[place][phase]
        return next((other for other in allowed if other > phase), allowed[0])


def successors(item: Intersection, rule: str = "") -> list[list[int]]:
    """For each phase of an intersection the others that may follow it, by index.

    Without a rule any may follow any. ``"cyclic"``: only the next one in the list of phases. The
    others are those of NEMA controllers, whose barrier separates the phases of one street from
    those of the streets that cross it. Two phases belong to one street if they serve the same
    approach, right turns and permitted left turns apart, or if a chain of such phases joins them.
    On a street any phase may follow any; from one street to another it is

    - ``"barrier-leading"``: only into the phase of the left turns, if the other street has one;
    - ``"barrier-lagging"``: only out of the phase of the through movements, if this one has one;
    - ``"barrier-both"``: only out of the one into the other.

    Args:
        item: The intersection.
        rule: One of `ugat_marl.effects.acting.PHASE_ORDERS`, or "".

    Raises:
        ScenarioError: All phases belong to one street, so that there is no barrier.
    """
    count = len(item.phases)
    if rule == "cyclic":
        return [[(phase + 1) % count] for phase in range(count)]
    if not rule:
        return [[other for other in range(count) if other != phase] for phase in range(count)]
    streets = _streets(item)
    if len(set(streets)) < 2:
        raise ScenarioError(
            f"phase order {rule!r}: the phases of traffic light {item.id!r} have no barrier, since "
            "they all serve the same approaches; use 'cyclic', or other phases"
        )
    enters, leaves = _first_phases(item, streets), _last_phases(item, streets)

    def may_follow(phase: int, other: int) -> bool:
        if streets[phase] == streets[other]:
            return True
        leading, lagging = other in enters, phase in leaves
        return {
            "barrier-leading": leading,
            "barrier-lagging": lagging,
            "barrier-both": leading and lagging,
        }[rule]

    return [
        [other for other in range(count) if other != phase and may_follow(phase, other)]
        for phase in range(count)
    ]


class _Served(NamedTuple):
    """The approaches a phase serves: by through movements, and by protected left turns."""

    through: frozenset[str]
    left: frozenset[str]

    @classmethod
    def by(cls, item: Intersection, phase: str) -> _Served:
        through = {x.from_edge for x in item.links if x.direction == "s" and phase[x.index] in "Gg"}
        left = {x.from_edge for x in item.links if x.direction in "lLt" and phase[x.index] == "G"}
        return cls(frozenset(through), frozenset(left))


def _streets(item: Intersection) -> list[int]:
    """For each phase the number of its street: phases with a common approach have the same."""
    served = [_Served.by(item, phase) for phase in item.phases]
    streets = list(range(len(served)))
    for one, other in itertools.combinations(range(len(served)), 2):
        if (served[one].through | served[one].left) & (served[other].through | served[other].left):
            old, new = streets[other], streets[one]
            streets = [new if street == old else street for street in streets]
    return streets


def _first_phases(item: Intersection, streets: Sequence[int]) -> set[int]:
    """The phases of most left turns and nothing else; where a street has none, all its phases."""
    return _most(
        streets,
        [
            0 if served.through else len(served.left)
            for served in (_Served.by(item, phase) for phase in item.phases)
        ],
    )


def _last_phases(item: Intersection, streets: Sequence[int]) -> set[int]:
    """The phases of most through movements and nothing else, or all of a street that has none."""
    return _most(
        streets,
        [
            0 if served.left else len(served.through)
            for served in (_Served.by(item, phase) for phase in item.phases)
        ],
    )


def _most(streets: Sequence[int], counts: Sequence[int]) -> set[int]:
    """The phases that have the highest count on their street."""
    best = dict.fromkeys(streets, 0)
    for street, count in zip(streets, counts, strict=True):
        best[street] = max(best[street], count)
    return {
        phase
        for phase, (street, count) in enumerate(zip(streets, counts, strict=True))
        if count == best[street]
    }
