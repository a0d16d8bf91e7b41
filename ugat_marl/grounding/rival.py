"""Rivals of a policy that is trained in a fitted street: policies that train with late greens.

Each episode of a fitted street is another simulation, and a few such episodes are hard to learn
from. In the plain simulation a learner often gets farther. A rival trains there, with greens that
are late until the rewards of the street match (`delays`), or by a constant. Worlds of the fitted
street tell which of the policies is best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ugat_marl.data import TransitionLog
from ugat_marl.effects import EVERYWHERE, Effect, LateGreen
from ugat_marl.grounding.delays import episode_rewards, matching_delays
from ugat_marl.grounding.street import Simulation, StreetWorld
from ugat_marl.grounding.worlds import episodes_under_delays, under_each_delay
from ugat_marl.policies import Learner, Policy
from ugat_marl.seeding import derive_seed

LONGEST_S = 5
"""Longest delay of greens that is tried, in s."""

ROLL_OUTS = episodes_under_delays(LONGEST_S)
"""Episodes of the simulation with which rewards are matched, per iteration."""


def judged_as(late_s: float | None) -> tuple[str, str]:
    """Return the name of a rival among the policies that are compared, and its words.

    Args:
        late_s: Constant delay of all greens, in s; None for the delay that rewards ask for.
    """
    if late_s is None:
        return "of_the_rival", "the policy of late greens"
    return f"of_the_rival_{late_s:g}_s_late", f"the policy of greens {late_s:g} s late"


@dataclass
class Rival:
    """Another learner of a training, as a part of a checkpoint.

    Attributes:
        learner: The learner.
        start: File of the learner after plain training, with which it begins.
        late_s: Constant delay of all greens, in s; None for the delay that rewards ask for.
        begun: True once it has begun.
    """

    learner: Learner
    start: Path
    late_s: float | None = None
    begun: bool = False

    @property
    def name(self) -> str:
        """Name in files and metrics."""
        return "rival" if self.late_s is None else f"rival {self.late_s:g} s late"

    @property
    def title(self) -> str:
        """Name in the display of progress."""
        return "late greens" if self.late_s is None else f"late greens of {self.late_s:g} s"

    @property
    def judged(self) -> str:
        """Name among the policies that are compared, see `street_training.JUDGED`."""
        return judged_as(self.late_s)[0]

    def begin(self) -> Learner:
        """Return the learner; it begins with what plain training taught."""
        if not self.begun:
            self.learner.load(self.start)
            self.begun = True
        return self.learner

    def save(self, folder: Path) -> None:
        """Write the learner to a file in a folder; nothing if it has not begun."""
        if self.begun:
            self.learner.save(self._file(folder))

    def load(self, folder: Path) -> None:
        """Restore a file of `save`; without one, the learner has not begun."""
        if (path := self._file(folder)).exists():
            self.learner.load(path)
            self.begun = True

    def _file(self, folder: Path) -> Path:
        return folder / f"{self.name.replace(' ', '-')}.pt"


def matched_delays(
    real: TransitionLog,
    simulation: Simulation,
    policy: Policy,
    seed: int,
    on_done: Callable[[], object],
) -> dict[str, float]:
    """Return how late greens have to be for the policy to get the rewards of the street.

    Whether chance explains the difference is not asked: worlds of the street judge the outcome.

    Args:
        real: Log of the street, in which the policy acted.
        simulation: The simulation.
        policy: The policy.
        seed: Root of the seeds of the episodes.
        on_done: Called after each of the `ROLL_OUTS` episodes.

    Returns:
        Agent to delay in s.
    """
    agents = list(real.provenance.layouts)

    def play(pairs: Sequence[tuple[int, int]]) -> list[TransitionLog]:
        worlds = [StreetWorld(_late({EVERYWHERE: float(late_s)})) for late_s, _ in pairs]
        seeds = [derive_seed(seed, "late greens", *pair) for pair in pairs]
        return simulation.logs(worlds, policy, seeds, None, on_done)

    logs = under_each_delay(LONGEST_S, play)
    simulated = np.array([episode_rewards(log, agents).mean(0) for log in logs])
    delay_s = matching_delays(episode_rewards(real, agents).mean(0), simulated)
    return dict(zip(agents, delay_s.round(1).tolist(), strict=True))


def late_world(delay_s: Mapping[str, float], intersection_of: Mapping[str, str]) -> StreetWorld:
    """Return the simulation with late greens.

    Args:
        delay_s: Agent to delay in s.
        intersection_of: Agent to its traffic light.
    """
    return StreetWorld(_late({intersection_of[agent]: s for agent, s in delay_s.items()}))


def _late(delay_s: Mapping[str, float]) -> tuple[Effect, ...]:
    # 0 s as well: it replaces late greens that the simulation has itself
    return tuple(LateGreen(place, seconds) for place, seconds in delay_s.items())
