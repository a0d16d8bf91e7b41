"""Parts between a controller and the street: what effects on controllers are made of.

An effect makes a `Sensor` (what the controller sees), an `Actuator` (what becomes of its commands)
or a `Cost` (what it is judged by). The environment chains those of all effects of its scenario.
Sensors and actuators work on numpy arrays and draw from the seed of the episode, each from a stream
of its own, so that an effect does the same whatever other effects are there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import SignalState

Cost = Callable[[Mapping[str, float]], float]
"""Cost of an episode, from its measures by name."""

Commands = Sequence[int | None]
"""Phase asked for at each intersection; None where no command arrives."""


class Stage(IntEnum):
    """Order in which sensors act, as it is on the street."""

    ZONE = 1
    NOISE = 2
    ERROR = 3
    ROUNDING = 4
    FAILURE = 5
    LOSS = 6
    DELAY = 7


@dataclass(frozen=True)
class Reading:
    """Measured lanes at one decision, on the way to a controller.

    Attributes:
        counts: Vehicles, halting vehicles and waiting times in s, ``(3, lanes)``.
        near: The same in the detection zones before the stop lines, ``(3, lanes)``; empty unless a
            sensor asks for a zone.
        mean_left: As in `ugat_marl.simulation.Snapshot`, ``(lanes,)``; empty if not measured.
    """

    counts: NDArray[np.float64]
    near: NDArray[np.float64]
    mean_left: NDArray[np.float64]


class Sensor:
    """One step between what is measured and what a controller sees.

    Attributes:
        stage: Place in the chain of sensors.
        zone_m: Length of the detection zones the simulator has to measure apart, in m; 0 for none.
    """

    stage: Stage
    zone_m: float = 0.0

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""

    def read(self, reading: Reading) -> Reading:
        """Return what is passed on; `reading` itself does not change."""
        raise NotImplementedError


class Actuator:
    """One step between the commands of a controller and its lights.

    It may change when or whether commands arrive (`send`), and which phases a light may show next
    (`restrict`). The signal machine keeps minimum green, yellow and all-red in any case.

    Attributes:
        stage: Place in the chain of actuators: commands are late (0), and lost on arrival (1).
    """

    stage: int = 0

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""

    def send(self, commands: Commands) -> Commands:
        """Return the commands that arrive at this decision; `commands` are given at it."""
        return commands

    @property
    def under_way(self) -> Sequence[Commands]:
        """Commands that have been given and not arrived, the oldest first."""
        return ()

    def restrict(self, mask: NDArray[np.int8], place: int, state: SignalState) -> None:
        """Forbid phases of a light that is free to change.

        Args:
            mask: 1 for each phase the light may show next, ``(phases,)``; changed in place.
            place: Index of the intersection.
            state: State of its signal machine.
        """
