"""Path of commands to the lights, through the actuators of a scenario's effects.

An environment has `Actuators` only if its scenario lists effects on commands.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import Actuator, ControllerPart
from ugat_marl.scenarios import Network, SignalState, SignalTiming, signals


class Actuators:
    """The chain of actuators of all lights of a network.

    Args:
        chain: Actuators of the effects.
        network: The network.
        timing: Clearance and minimum green.
        decision_interval_s: Seconds between two commands.
    """

    def __init__(
        self,
        chain: Sequence[Actuator],
        network: Network,
        timing: SignalTiming,
        decision_interval_s: float,
    ) -> None:
        self._chain = sorted(chain, key=lambda actuator: actuator.stage)
        self._lights = network.intersections
        self._timing = timing
        self._interval_s = decision_interval_s

    @classmethod
    def of(
        cls,
        effects: Sequence[ControllerPart],
        network: Network,
        timing: SignalTiming,
        decision_interval_s: float,
    ) -> Actuators | None:
        """Return the actuators of a scenario with these effects; None if there are none.

        Raises:
            ScenarioError: The phases of an intersection do not allow the order of phases.
        """
        latest = {effect.name: effect for effect in effects}  # the last of a name counts
        made = (e.actuator(network, timing, decision_interval_s) for e in latest.values())
        chain = [actuator for actuator in made if actuator is not None]
        return cls(chain, network, timing, decision_interval_s) if chain else None

    def reset(self, seed: int) -> None:
        """Begin an episode; `seed` decides all random draws."""
        for actuator in self._chain:
            actuator.reset(seed)

    def obey(self, commands: Sequence[int], states: Sequence[SignalState]) -> list[int]:
        """Return the phases that signal machines are asked for in the next decision interval.

        Args:
            commands: Phase that the agent of each intersection chose at this decision.
            states: State of each signal machine.
        """
        arrived: Sequence[int | None] = list(commands)
        for actuator in self._chain:
            arrived = actuator.send(arrived)
        return [
            self._obeyed(place, command, state)
            for place, (command, state) in enumerate(zip(arrived, states, strict=True))
        ]

    def masks(self, states: Sequence[SignalState]) -> list[NDArray[np.int8]]:
        """Return masks of commands that would be obeyed if given now, ``(phases,)`` per light.

        A delayed command arrives in a later state of the light. This state follows from the
        commands ahead of it, if none of them is lost.
        """
        # what is in the last part of the chain arrives first
        ahead = [commands for part in reversed(self._chain) for commands in part.under_way]
        masks: list[NDArray[np.int8]] = []
        for place, state in enumerate(states):
            for commands in ahead:
                phase = self._obeyed(place, commands[place], state)
                state, _ = signals.advance(
                    self._lights[place].phases, state, phase, self._interval_s, self._timing
                )
            masks.append(self._mask(place, state))
        return masks

    def _obeyed(self, place: int, command: int | None, state: SignalState) -> int:
        """Return the phase a light is asked for.

        A command that is not obeyed keeps the phase; if that must end, the next phase follows.
        """
        mask = self._mask(place, state)
        if command is not None and mask[command]:
            return command
        if mask[state.phase]:
            return state.phase
        allowed = np.flatnonzero(mask).tolist()  # the green ends: the next phase in the list
        return next((phase for phase in allowed if phase > state.phase), allowed[0])

    def _mask(self, place: int, state: SignalState) -> NDArray[np.int8]:
        phases = len(self._lights[place].phases)
        free = signals.free_to_change(state, self._timing, self._interval_s)
        mask = signals.phase_mask(phases, state.phase, free=free)
        if free:
            for actuator in self._chain:
                actuator.restrict(mask, place, state)
        return mask
