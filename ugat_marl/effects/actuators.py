"""Effects on the commands of controllers: the action gap.

Each effect but `MinGreen` makes an `Actuator`, which changes the phase that the signal machine is
asked for. The machine always keeps minimum green, yellow and all-red.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects.base import (
    ControllerEffect,
    DelayEffect,
    Effect,
    NumberParameter,
    TextParameter,
)
from ugat_marl.effects.controllers import Actuator, Commands, whole_decisions
from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import (
    Intersection,
    Network,
    Scenario,
    SignalState,
    SignalTiming,
    kerb_turn_of,
)
from ugat_marl.seeding import numpy_generator

PHASE_ORDERS = ("cyclic", "barrier-leading", "barrier-lagging", "barrier-both")
"""Rules for the order of phases, see `successors`."""

_INSTANT_S = 1e-6


@dataclass(frozen=True)
class ExecutionDelay(DelayEffect):
    """Commands take effect after `seconds`, rounded to decisions; until then the light stays."""

    name: ClassVar[str] = "execution_delay"

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> Actuator:
        """Make an actuator that delays commands by whole decisions."""
        nothing = (None,) * len(network.intersections)
        return _Late(nothing, whole_decisions(self.seconds, decision_interval_s))


class _Late(Actuator):
    def __init__(self, nothing: Commands, decisions: int) -> None:
        self._nothing = nothing
        self._decisions = decisions

    def reset(self, seed: int) -> None:
        self._under_way: deque[Commands] = deque([self._nothing] * self._decisions)

    def send(self, commands: Commands) -> Commands:
        self._under_way.append(commands)
        return self._under_way.popleft()

    @property
    def under_way(self) -> Sequence[Commands]:
        return self._under_way


@dataclass(frozen=True)
class LostCommands(ControllerEffect):
    """A command to one light is lost with this chance; the light then stays."""

    name: ClassVar[str] = "lost_commands"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    share: float

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> Actuator:
        """Make an actuator that loses commands, independently for each light."""
        return _Lossy(self.share)


class _Lossy(Actuator):
    stage = 1

    def __init__(self, share: float) -> None:
        self._share = share

    def reset(self, seed: int) -> None:
        self._random = numpy_generator(seed, "cabinet", LostCommands.name)

    def send(self, commands: Commands) -> Commands:
        lost = self._random.random(len(commands)) < self._share
        return [None if gone else phase for gone, phase in zip(lost, commands, strict=True)]


@dataclass(frozen=True)
class PhaseOrder(ControllerEffect):
    """Only some phases may follow a phase; a command for another one is not obeyed."""

    name: ClassVar[str] = "phase_order"
    texts: ClassVar[dict[str, TextParameter]] = {
        "rule": TextParameter("phase order", allowed=PHASE_ORDERS)
    }
    rule: str

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> Actuator:
        """Make an actuator that forbids phases out of order.

        Raises:
            ScenarioError: The phases of an intersection have no barrier.
        """
        return _Ordered(
            [successors(intersection, self.rule) for intersection in network.intersections]
        )


class _Ordered(Actuator):
    def __init__(self, following: Sequence[Sequence[Sequence[int]]]) -> None:
        self._following = following

    def restrict(self, mask: NDArray[np.int8], place: int, state: SignalState) -> None:
        allowed = {state.phase, *self._following[place][state.phase]}
        mask[[phase for phase in range(len(mask)) if phase not in allowed]] = 0


@dataclass(frozen=True)
class MaxGreen(ControllerEffect):
    """No green lasts longer than `seconds`, in whole decisions; then the next phase follows."""

    name: ClassVar[str] = "max_green"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 10.0, 600.0)}
    seconds: float

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> Actuator:
        """Make an actuator that ends greens before they are too long.

        Raises:
            ScenarioError: The minimum green is longer, or that of one decision is.
        """
        if timing.min_green_s > self.seconds:
            raise ScenarioError(
                f"max_green={self.seconds:g}: the minimum green is {timing.min_green_s:g} s; give "
                "at least as many"
            )
        if (least_s := decision_interval_s - timing.clearance_s) > self.seconds:
            raise ScenarioError(
                f"max_green={self.seconds:g}: a green of one decision is {least_s:g} s; give at "
                "least as many, or a shorter control.decision_interval_s"
            )
        return _Bounded(self.seconds, timing.clearance_s, decision_interval_s)


class _Bounded(Actuator):
    def __init__(self, most_green_s: float, clearance_s: float, interval_s: float) -> None:
        self._most_green_s = most_green_s
        self._clearance_s = clearance_s
        self._interval_s = interval_s

    def restrict(self, mask: NDArray[np.int8], place: int, state: SignalState) -> None:
        green_s = state.elapsed_s - self._clearance_s if state.clearing else state.elapsed_s
        if green_s + self._interval_s > self._most_green_s + _INSTANT_S:
            mask[state.phase] = 0


@dataclass(frozen=True)
class MinGreen(Effect):
    """Greens of controlled signals last at least `seconds`, in whole simulation steps."""

    name: ClassVar[str] = "min_green"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 120.0)}
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set `control.min_green_s`."""
        step = scenario.settings.step_length_s
        steps = math.ceil(self.seconds / step - 1e-9)
        changed = scenario.with_control(min_green_s=steps * step)
        return replace(changed, applied=(*scenario.applied, str(self)))


ACTING: tuple[type[Effect], ...] = (ExecutionDelay, LostCommands, PhaseOrder, MaxGreen, MinGreen)
"""Effects on commands."""


def successors(intersection: Intersection, rule: str = "") -> list[list[int]]:
    """Return, for each phase of an intersection, the other phases that may follow it, by index.

    Without a rule, any phase may follow any other. With ``"cyclic"``, only the next one in the list
    of phases follows. The other rules are those of NEMA controllers: a barrier separates the phases
    of one street from those of the streets that cross it. Two phases belong to one street if they
    serve a common approach, or if a chain of such phases joins them; right turns and permitted left
    turns do not count. On one street, any phase may follow any other. Across the barrier:

    - ``"barrier-leading"``: only into the left-turn phase of the other street, if it has one;
    - ``"barrier-lagging"``: only out of the through phase of this street, if it has one;
    - ``"barrier-both"``: both rules hold.

    Args:
        intersection: The intersection.
        rule: One of `PHASE_ORDERS`, or "".

    Raises:
        ScenarioError: All phases belong to one street, so there is no barrier.
    """
    count = len(intersection.phases)
    if rule == "cyclic":
        return [[(phase + 1) % count] for phase in range(count)]
    if not rule:
        return [[other for other in range(count) if other != phase] for phase in range(count)]
    streets = _streets(intersection)
    if len(set(streets)) < 2:
        raise ScenarioError(
            f"phase order {rule!r}: the phases of traffic light {intersection.id!r} have no "
            "barrier, since they all serve the same approaches; use 'cyclic', or other phases"
        )
    enters, leaves = _first_phases(intersection, streets), _last_phases(intersection, streets)

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
    """Approaches that a phase serves with through movements, and with protected left turns.

    In left-hand traffic the turns across the opposite traffic are right turns; these count.
    """

    through: frozenset[str]
    left: frozenset[str]

    @classmethod
    def by(cls, intersection: Intersection, phase: str) -> _Served:
        through = {
            x.from_edge for x in intersection.links if x.direction == "s" and phase[x.index] in "Gg"
        }
        left = {
            x.from_edge
            for x in intersection.links
            if kerb_turn_of(x) == "l" and phase[x.index] == "G"
        }
        return cls(frozenset(through), frozenset(left))


def _streets(intersection: Intersection) -> list[int]:
    """Return the street of each phase, by number; phases with a common approach share it."""
    served = [_Served.by(intersection, phase) for phase in intersection.phases]
    streets = list(range(len(served)))
    for one, other in itertools.combinations(range(len(served)), 2):
        if (served[one].through | served[one].left) & (served[other].through | served[other].left):
            old, new = streets[other], streets[one]
            streets = [new if street == old else street for street in streets]
    return streets


def _first_phases(intersection: Intersection, streets: Sequence[int]) -> set[int]:
    """Return, of each street, the phases with the most left turns and no through movements.

    A street without such a phase keeps all its phases.
    """
    return _most(
        streets,
        [
            0 if served.through else len(served.left)
            for served in (_Served.by(intersection, phase) for phase in intersection.phases)
        ],
    )


def _last_phases(intersection: Intersection, streets: Sequence[int]) -> set[int]:
    """Return, of each street, the phases with the most through movements and no left turns.

    A street without such a phase keeps all its phases.
    """
    return _most(
        streets,
        [
            0 if served.left else len(served.through)
            for served in (_Served.by(intersection, phase) for phase in intersection.phases)
        ],
    )


def _most(streets: Sequence[int], counts: Sequence[int]) -> set[int]:
    """Return the phases that have the highest count on their street."""
    best = dict.fromkeys(streets, 0)
    for street, count in zip(streets, counts, strict=True):
        best[street] = max(best[street], count)
    return {
        phase
        for phase, (street, count) in enumerate(zip(streets, counts, strict=True))
        if count == best[street]
    }
