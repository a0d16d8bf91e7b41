"""Memory of commands: what an agent asked for last, and how long its green has lasted.

On a street commands may be late or lost. An agent that sees its own last commands knows what is
under way; with the observation alone, such a domain is no Markov decision process (Katsikopoulos
and Engelbrecht 2003).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

AGE_SCALE_S = 60.0
"""Age of a green, in s, that is shown as 1; older greens are shown as 1, too."""


class CommandMemory:
    """Last commands of all intersections, as the last numbers of their observations.

    Args:
        phases: Number of phases of each intersection.
        length: Number of commands that are remembered, at least 1.
        interval_s: Seconds from one decision to the next.
    """

    def __init__(self, phases: Sequence[int], length: int, interval_s: float) -> None:
        self._phases = tuple(phases)
        self._length = length
        self._interval_s = interval_s
        self.reset([0] * len(phases))

    def reset(self, running: Sequence[int]) -> None:
        """Begin an episode; nothing has been asked for.

        Args:
            running: Phase of each intersection.
        """
        self._asked: list[Sequence[int]] = []
        self._running = list(running)
        self._since = [0] * len(self._phases)

    def add(self, asked: Sequence[int], running: Sequence[int]) -> None:
        """Remember a decision.

        Args:
            asked: Phase that each agent asked for.
            running: Phase of each intersection after the decision's interval.
        """
        self._asked = [list(asked), *self._asked][: self._length]
        for place, (before, now) in enumerate(zip(self._running, running, strict=True)):
            self._since[place] = 1 if now != before else self._since[place] + 1
        self._running = list(running)

    def vectors(self) -> list[NDArray[np.float32]]:
        """Return the numbers of each intersection, float32 ``(memory_size(phases, length),)``.

        They are one one-hot per command, the latest first, with zeros for commands before the
        first, and then the age of the green (or of the clearance to it) divided by `AGE_SCALE_S`.
        """
        rows: list[NDArray[np.float32]] = []
        for place, phases in enumerate(self._phases):
            row = np.zeros(memory_size(phases, self._length), dtype=np.float32)
            for lag, asked in enumerate(self._asked):
                row[lag * phases + asked[place]] = 1.0
            row[-1] = min(self._since[place] * self._interval_s / AGE_SCALE_S, 1.0)
            rows.append(row)
        return rows


def memory_size(phases: int, length: int) -> int:
    """Return how many numbers the memory of `length` commands adds to an observation."""
    return length * phases + 1 if length else 0
