"""Layout of observations."""

from __future__ import annotations

from dataclasses import dataclass

from ugat_marl.errors import LogError

MOST_NUMBERS = 32_767
"""Most numbers of an observation, the largest that a log can count: it stores phases in 16 bits."""


@dataclass(frozen=True)
class AgentLayout:
    """Layout of an agent's observation vector: features | phase one-hot | context.

    Attributes:
        features: Count of traffic numbers of the intersection itself. The forward model predicts
            them and the inverse model compares them.
        phases: Number of green phases, the size of the action space and of the one-hot part.
        context: Count of numbers about the neighbours and the own last commands; may be 0.
    """

    features: int
    phases: int
    context: int = 0

    def __post_init__(self) -> None:
        if self.features < 1 or self.phases < 1 or self.context < 0:
            raise LogError(f"{self}: needs features >= 1, phases >= 1 and context >= 0")
        if self.size > MOST_NUMBERS:
            raise LogError(f"{self}: an observation has at most {MOST_NUMBERS} numbers")

    @property
    def size(self) -> int:
        """Length of the observation vector."""
        return self.features + self.phases + self.context
