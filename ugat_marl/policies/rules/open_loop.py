"""Rules without an observation: fixed time, the programme of the network, random phases."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ugat_marl.envs import Actions, Infos, Observations
from ugat_marl.policies.rules.approaches import (
    ControlledNetwork,
    allowed_phases,
    permitted_phases,
)
from ugat_marl.seeding import numpy_generator


class FixedTime:
    """Show each phase of a smallest cover in turn, all for the same time.

    Args:
        network: The controlled network.
        green_s: Time from one phase to the next (clearance included), rounded up to whole
            decisions; at least clearance and minimum green.
    """

    def __init__(self, network: ControlledNetwork, green_s: float = 30.0) -> None:
        self.env_options: Mapping[str, Any] = {}
        self.green_s = green_s
        self._decisions = network.planned_decisions(green_s)
        self._cycle = {a: w.cycle for a, w in network.approaches.items()}
        self._phases = network.phases
        self._time = 0

    def reset(self, seed: int) -> None:
        """Start the cycle again."""
        self._time = 0

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the phase whose turn it is; if it is masked, the first allowed one."""
        turn = self._time // self._decisions
        self._time += 1
        wanted = {agent: cycle[turn % len(cycle)] for agent, cycle in self._cycle.items()}
        return permitted_phases(wanted, infos, self._phases)


class ProgrammeControl:
    """Leave the signals to the programme of the network file; actions are ignored."""

    def __init__(self, network: ControlledNetwork) -> None:
        self.env_options: Mapping[str, Any] = {"signals": "programme"}
        self._agents = tuple(network.intersections)

    def reset(self, seed: int) -> None:
        """Do nothing: the rule has no memory."""

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return 0 for every agent; the environment ignores it."""
        return dict.fromkeys(self._agents, 0)


class Random:
    """Draw one of the allowed phases, each with equal probability, at every decision."""

    def __init__(self, network: ControlledNetwork) -> None:
        self.env_options: Mapping[str, Any] = {}
        self._phases = network.phases
        self._generator = numpy_generator(0, "random-controller")

    def reset(self, seed: int) -> None:
        """Start the random stream of `seed`."""
        self._generator = numpy_generator(seed, "random-controller")

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Draw an allowed phase for every agent."""
        return {
            agent: int(self._generator.choice(np.flatnonzero(allowed_phases(infos, agent, phases))))
            for agent, phases in self._phases.items()
        }
