"""Actuated rules: a cycle of phases, each extended while traffic uses its green."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.policies.rules.approaches import (
    Approach,
    ControlledNetwork,
    EachLight,
    permitted,
)


class _Extended(EachLight):
    """Show the phases of a smallest cover in turn; extend each up to a longest green.

    A phase lasts at least one decision. It goes on while its lanes still use it, and ends at the
    longest green if another phase is called. A phase without a call is skipped. Without any call,
    the light keeps its phase.
    """

    env_options: Mapping[str, Any] = {"observation": "movements"}

    def __init__(self, network: ControlledNetwork, longest_s: float) -> None:
        super().__init__(network)
        self._approaches = network.approaches
        self._longest = network.decisions(longest_s)
        self._place: dict[str, int] = {}
        self._age: dict[str, int] = {}

    def reset(self, seed: int) -> None:
        """Forget the place in the cycle."""
        self._place, self._age = {}, {}

    def _demand(
        self, agent: str, approach: Approach, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return two masks ``(lanes,)``: lanes that use their green, lanes that call for one."""
        raise NotImplementedError

    def _choose(
        self, agent: str, observation: NDArray[np.float32], allowed: NDArray[np.bool_]
    ) -> int:
        approach = self._approaches[agent]
        used, calling = self._demand(agent, approach, observation)
        cycle, served = approach.cycle, approach.served
        place = self._place.get(agent, -1)
        age = self._age.get(agent, 0)
        if place >= 0:
            lanes = served[cycle[place]]
            goes_on = age < self._longest and bool((used & lanes).any())
            calling = calling & ~lanes
        else:
            goes_on = False
        turns = ((place + step) % len(cycle) for step in range(1, len(cycle) + 1))
        following = [
            turn
            for turn in turns
            if turn != place and allowed[cycle[turn]] and (calling & served[cycle[turn]]).any()
        ]
        if goes_on or not following:
            following = [max(place, 0)]
        chosen = following[0]
        self._age[agent] = age + 1 if chosen == place else 1
        self._place[agent] = chosen
        return permitted(cycle[chosen], allowed)


class Actuated(_Extended):
    """Gap-out control: extend a green until a gap opens in the stream on every lane it serves.

    A controller in the field measures gaps at the stop line. Here the observation gives one count
    per lane, so the rule uses the mean gap: a stream at the speed limit with a headway of `gap_s`
    puts ``free-flow time / gap_s`` vehicles on a lane. A lane with as many vehicles, or with a
    standing vehicle, still uses its green. A vehicle anywhere on the lanes of a phase calls it.

    Args:
        network: The controlled network.
        longest_s: Longest time from one phase to the next while another one is called (clearance
            included), rounded up to whole decisions.
        gap_s: Headway in seconds at which a green ends.
    """

    def __init__(
        self, network: ControlledNetwork, longest_s: float = 40.0, gap_s: float = 3.0
    ) -> None:
        super().__init__(network, longest_s)
        self.longest_s, self.gap_s = longest_s, gap_s

    def _demand(
        self, agent: str, approach: Approach, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        seen = approach.traffic(agent, observation)
        stream = np.maximum(approach.free_flow_s / self.gap_s, 1.0)
        return (seen.halting > 0.5) | (seen.vehicles > stream - 0.5), seen.vehicles > 0.5


class DelayActuated(_Extended):
    """Delay-based control: extend a green until the vehicles that waited for it are moving.

    A lane uses its green, and calls for one, while its vehicles have waited more than
    `most_waiting_s` vehicle-seconds in all.

    The rule follows Oertel and Wagner 2011. Their controller knows the delay of each vehicle. Here
    a vehicle that moves again no longer counts, so greens end earlier.

    Args:
        network: The controlled network.
        longest_s: Longest time from one phase to the next while another one is called (clearance
            included), rounded up to whole decisions.
        most_waiting_s: Vehicle-seconds on a lane that neither extend nor call a green.
    """

    env_options: Mapping[str, Any] = {"observation": "waiting"}

    def __init__(
        self, network: ControlledNetwork, longest_s: float = 40.0, most_waiting_s: float = 10.0
    ) -> None:
        super().__init__(network, longest_s)
        self.longest_s, self.most_waiting_s = longest_s, most_waiting_s

    def _demand(
        self, agent: str, approach: Approach, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        waits = approach.waiting_s(agent, observation) > self.most_waiting_s
        return waits, waits
