"""Parts of effects on controllers: sensors, actuators and costs.

A `Sensor` changes the counts that a controller sees, an `Actuator` its commands; a `Cost` judges an
episode. The environment chains the parts of all effects of its scenario. Each sensor and actuator
draws from its own random stream, which follows from the seed of the episode. So an effect does not
depend on the other effects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Network, SignalState, SignalTiming

Cost = Callable[[Mapping[str, float]], float]
"""Function from the measures of an episode, by name, to its cost."""

Commands = Sequence[int | None]
"""Phase asked for at each intersection; None where no command arrives."""


class Stage(IntEnum):
    """Order in which sensors act, the same as on a street."""

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
        counts: Vehicles, halting vehicles, waiting times in s, vehicles queued upstream, and how
            many m/s the mean speed is below the speed limit, ``(5, lanes)``. An empty lane is 0.
        near: Vehicles, halting vehicles, waiting times and m/s below the speed limit, in the
            detection zones before the stop lines, ``(4, lanes)``; empty if no sensor has a zone.
        mean_left: Field `mean_left` of `ugat_marl.simulation.Snapshot`, ``(lanes,)``; empty if not
            measured.
    """

    counts: NDArray[np.float64]
    near: NDArray[np.float64]
    mean_left: NDArray[np.float64]


def whole_decisions(seconds: float, interval_s: float) -> int:
    """Return a time as a number of decisions, to the nearest; halves are rounded up."""
    return math.floor(seconds / interval_s + 0.5)


class ControllerPart:
    """Change of the link between controllers and their street: an effect, or what was fitted.

    Attributes:
        name: Name of the change; the last one of a name counts for sensors and actuators.
    """

    name: ClassVar[str]

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor | None:
        """Make the sensor that changes the counts of controllers; None without such a change."""
        return None

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> Actuator | None:
        """Make the actuator that changes commands of controllers; None without such a change.

        Raises:
            ScenarioError: The phases of an intersection do not allow it.
        """
        return None

    def service(self) -> Mapping[str, tuple[float, float]]:
        """Return lane to red in its greens, in s: at their beginning, and in each decision."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return the change as values for JSON, to send it to another process."""
        raise NotImplementedError(
            f"{type(self).__name__} has no state_dict(), which vector_env sends to its processes"
        )

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """Restore `state_dict`."""
        return cls(**state)


class Sensor:
    """One step between what is measured and what a controller sees.

    Attributes:
        stage: Place in the chain of sensors.
        zone_m: Length of the detection zones that the simulator has to measure, in m; 0 for none.
    """

    stage: Stage
    zone_m: float = 0.0

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""

    def read(self, reading: Reading) -> Reading:
        """Return the changed reading; `reading` itself does not change."""
        raise NotImplementedError


class Actuator:
    """One step between the commands of a controller and its lights.

    It may delay or lose commands (`send`), and forbid phases (`restrict`). The signal machine
    always keeps minimum green, yellow and all-red.

    Attributes:
        stage: Place in the chain of actuators: commands are late (0), and lost on arrival (1).
    """

    stage: int = 0

    def reset(self, seed: int) -> None:
        """Begin the episode of this seed."""

    def send(self, commands: Commands) -> Commands:
        """Return the commands that arrive at this decision; `commands` are those given now."""
        return commands

    @property
    def under_way(self) -> Sequence[Commands]:
        """Commands that were given but have not arrived, the oldest first."""
        return ()

    def restrict(self, mask: NDArray[np.int8], place: int, state: SignalState) -> None:
        """Forbid phases of a light that is free to change.

        Args:
            mask: 1 for each phase the light may show next, ``(phases,)``; changed in place.
            place: Index of the intersection.
            state: State of its signal machine.
        """
