"""Safety under any request of a policy: signal machines, a fixed-time plan, and trust.

This module reads nothing, writes nothing and has no clock. The signal machine is that of the
environments (`ugat_marl.scenarios.signals`). Here it can also begin from any state that a light
shows when it is taken over.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import OptionError
from ugat_marl.policies import ControlledNetwork, FixedTime
from ugat_marl.scenarios import Network, Segment, SignalState, SignalTiming, signals

_ENDING = frozenset("yYoO")
"""Yellow and off. Traffic may be in the junction, so the light shows a full yellow (again)."""
_CLEARING = str.maketrans("YoOu", "yyyr")
_NOT_GREEN = str.maketrans("yYoOu", "rrrrr")


class Light:
    """Signal machine of one traffic light.

    Args:
        phases: The green phases that the light may show, in SUMO's letters.
        timing: Minimum green and clearance, s.
        shown: State of the light when it is taken over, in SUMO's letters. A state that is none of
            the phases is held for the minimum green, because its start is unknown. Then it is
            cleared like a phase.

    Raises:
        OptionError: `shown` does not fit the phases, so it belongs to another light.
    """

    def __init__(self, phases: Sequence[str], timing: SignalTiming, shown: str) -> None:
        if len(shown) != len(phases[0]) or not set(shown) <= signals.SIGNAL_LETTERS:
            raise OptionError(
                f"the light shows {shown!r}, its phases are like {phases[0]!r}; the street must "
                "be the scenario's own network"
            )
        self.phases = tuple(phases)
        self._timing = timing
        self._ending_s = timing.yellow_s if set(shown) & _ENDING else 0.0
        self._ending = shown.translate(_CLEARING)
        held = shown.translate(_NOT_GREEN)
        self._all = self.phases if held in self.phases else (*self.phases, held)
        index = self._all.index(held)
        self._state = SignalState(index, index, 0.0)

    @property
    def taken_over(self) -> bool:
        """True once the light shows one of its phases or clears towards one."""
        return self._state.phase < len(self.phases)

    @property
    def phase(self) -> int:
        """The phase that the light shows or clears towards; 0 until it is taken over."""
        return self._state.phase if self.taken_over else 0

    def free(self, within_s: float) -> NDArray[np.int8]:
        """Return 1 for every phase that can begin within `within_s` seconds, else 0.

        Returns:
            int8, ``(phases,)``.
        """
        left = within_s - self._ending_s
        free = not self.taken_over or signals.free_to_change(self._state, self._timing, left)
        return signals.phase_mask(len(self.phases), self.phase, free=free)

    def advance(self, requested: int, seconds: float) -> list[Segment]:
        """Return the segments of the next `seconds`, if phase `requested` is asked for now."""
        shown: list[Segment] = []
        if self._ending_s > 0:
            part = min(self._ending_s, seconds)
            shown, self._ending_s = [(part, self._ending)], self._ending_s - part
            seconds -= part
        if seconds > 0:
            self._state, rest = signals.advance(
                self._all, self._state, requested, seconds, self._timing
            )
            shown += rest
        return shown


class PolicyTrust:
    """Trust in the policy, per light: lost at a fault, regained after some good decisions.

    Args:
        lights: Names of the traffic lights.
        return_after: Number of good decisions in a row that a light spends on the plan after a
            fault.
    """

    def __init__(self, lights: Iterable[str], return_after: int) -> None:
        self._return_after = return_after
        self._good = dict.fromkeys(lights, math.inf)
        self._last: dict[str, str] = {}

    def judge(self, faults: Mapping[str, str]) -> dict[str, str]:
        """Return light to reason, for the lights that follow the plan in this decision.

        Args:
            faults: Light to the fault of its data or of the policy, ``<kind>: <details>``.
        """
        reasons: dict[str, str] = {}
        for light, good in self._good.items():
            if light in faults:
                self._good[light] = 0
                self._last[light] = reasons[light] = faults[light]
            elif good < self._return_after:
                self._good[light] = good + 1
                reasons[light] = (
                    f"returning: {good + 1:g} of {self._return_after} good decisions after "
                    f"{self._last[light]}"
                )
        return reasons


def fixed_time(
    network: Network, decision_interval_s: float, timing: SignalTiming, green_s: float
) -> FixedTime:
    """Return the fallback plan: a smallest set of phases that serves every link, in turn.

    The plan answers by traffic light. One clock drives all lights, so a light that joins later
    follows the same plan.

    Args:
        network: The network.
        decision_interval_s: Time between decisions, s.
        timing: Minimum green and clearance, s.
        green_s: Time of a phase, s, its clearance included.
    """
    intersections = {intersection.id: intersection for intersection in network.intersections}
    streets = ControlledNetwork.of_network(network, intersections, decision_interval_s, timing)
    return FixedTime(streets, green_s)
