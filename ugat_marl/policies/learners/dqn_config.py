"""Settings of the DQN learner; impossible values are refused."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from os import PathLike, fspath
from typing import Any

from ugat_marl.errors import OptionError, require_kinds
from ugat_marl.policies.networks.structure import NetworkName

CEILING_DECISIONS = 1_000
"""Last decisions that a ceiling is measured on.

They are enough for a quantile, and too few to reach back to the exploration at the beginning.
"""


class UsualValue:
    """Default that a preset or a learner replaces, unless the same value is given."""

    __slots__ = ()

    # A cache of defaults, such as the command line's, has to tell it from the value it equals
    def __hash__(self) -> int:
        return hash((type(self), super().__hash__()))


class Usual(UsualValue, int):
    """Default of a whole number."""


class UsualNumber(UsualValue, float):
    """Default of a number that need not be whole."""


class UsualSizes(UsualValue, tuple[int, ...]):
    """Default of sizes."""


class UsualName(UsualValue, str):
    """Default of a name."""

    __slots__ = ()


_MLP: Any = UsualName("mlp")


def _is_size(number: object) -> bool:
    return isinstance(number, Integral) and int(number) >= 1


@dataclass(frozen=True)
class DQNConfig:
    """Settings of DQN.

    Rewards are centred and scaled for each agent: ``(reward - mean) / deviation``. Mean and
    standard deviation are measured once, over the first `warmup_decisions` or, with a teacher, over
    its first lessons, and then kept, in other worlds too. So
    targets are of order one for any traffic. A constant shift of the reward moves all Q-values
    alike in episodes without a natural end, and changes no decision. If an agent terminates, its
    bootstrap value is shifted as well. `reward_scale` replaces the measured scale for all agents,
    with mean 0.

    Each number of an observation is divided by its root mean square over the same decisions; one
    for which it is below 0.01, such as a phase that the teacher never chose, stays as it is. The
    reason is their size: a lane with five vehicles is 0.125 in the observation "count", the current
    phase is 1, and the weights of the lane would grow slowly.

    The defaults were chosen on one network only (Hangzhou, one intersection, 60 episodes of 360
    decisions, one or two seeds each). Longer bouts of exploration, one-step targets and a short
    decay learned faster. Hidden layers of 64 were no better than layers of 48.

    Attributes:
        hidden: Sizes of the hidden layers of every network.
        learning_rate: Step size of Adam.
        discount: Weight of the next decision's value (gamma), 0.95-0.98 in the literature. With
            "universal" it is that of 10 s, so that it looks equally far ahead at any decision
            interval. A value is a sum over decisions all the same: half the interval doubles it.
        steps: Decisions whose rewards a target sums before it takes a value (n-step returns, Sutton
            1988). With "universal" they are decisions of 10 s as well.
        batch_size: Transitions per update and agent.
        replay_capacity: Decisions that the replay memory holds.
        warmup_decisions: Own decisions before the first update; those of a teacher do not count.
        update_every: Decisions from one update to the next.
        target_rate: Share of the online network mixed into the target network at every update.
        epsilon_start: Share of exploratory decisions at the beginning.
        epsilon_end: Share of exploratory decisions after the decay.
        epsilon_decay_decisions: Decisions over which epsilon falls, linearly.
        sticky_decisions: Longest bout of one exploratory action, in decisions; 1 is plain
            epsilon-greedy.
        huber_delta: Errors larger than this (in scaled reward) count linearly.
        reward_scale: Factor on all rewards; None measures it for each agent. With "universal" None
            is 0.05 with mean 0: one network has to value equal states of all intersections alike.
        scale_inputs: Scale observations (those of "frap" and "universal" never).
        shared: One network for all agents instead of one for each. It learns from the transitions
            of all agents and has a bias for each.
        network: Network that computes Q. "mlp": layers over an agent's observation. "frap": phases
            that compete with the demand of their movements (Zheng et al. 2019), one network for all
            intersections; `hidden` is the size of a demand and that of a pair of phases. "colight":
            attention to the neighbours (Wei et al. 2019), one network for all intersections;
            `hidden` is the size of an embedding and that of the layer after the attention.
            "universal": one network for all intersections of any road network; `hidden` is the size
            of a movement's embedding and that of the other hidden layers. Unless given, it is the
            one of the learner: "universal" with "universal", "mlp" with "dqn".
        start: File of weights to begin with, for "universal": a policy of an earlier training, or
            what `studies.pretraining` writes. None draws them.
        ceiling: Quantile at which policies cut each number of an observation. It is measured over
            the last 1000 decisions of training. In a fuller street than in training, a policy then
            acts as in the fullest street it knows. None cuts nothing.
        teacher: Rule that shows the learner its first episodes, such as "max-pressure:20". "best"
            takes the best of the standard rules in the environment of the training, and needs the
            observation "movements". None for none;
            "" for "best" with the learner "universal", and for none with others. After its
            lessons exploration begins at `epsilon_end`.
        lessons: Episodes that the teacher shows.
        lesson_updates: Updates after them, before the learner acts.
        margin: Q of an action that the teacher did not choose should be lower than that of its own
            by this much, in scaled reward (Hester et al. 2018, eq. 1). It counts for decisions that
            the teacher made, and so less and less as the memory fills.
    """

    hidden: tuple[int, ...] = UsualSizes((48, 48))
    learning_rate: float = 1e-3
    discount: float = 0.95
    batch_size: int = 32
    replay_capacity: int = 10_000
    warmup_decisions: int = Usual(200)
    update_every: int = 1
    target_rate: float = 0.01
    epsilon_start: float = 1.0
    epsilon_end: float = 0.05
    epsilon_decay_decisions: int = Usual(3_600)
    sticky_decisions: int = 3
    huber_delta: float = 1.0
    reward_scale: float | None = None
    scale_inputs: bool = True
    shared: bool = False
    network: NetworkName = _MLP
    start: str | None = None
    steps: int = Usual(1)
    ceiling: float | None = None
    teacher: str | None = ""
    lessons: int = 3
    lesson_updates: int = 1_000
    margin: float = 0.2

    def __post_init__(self) -> None:
        # JSON gives a list, which would differ from the tuple of a checkpoint
        if isinstance(self.hidden, list):
            object.__setattr__(self, "hidden", tuple(self.hidden))
        if isinstance(self.start, PathLike):
            object.__setattr__(self, "start", fspath(self.start))
        if isinstance(self.teacher, str) and self.teacher.lower() == "none":
            object.__setattr__(self, "teacher", None)
        for name in (
            "batch_size",
            "replay_capacity",
            "warmup_decisions",
            "update_every",
            "epsilon_decay_decisions",
            "sticky_decisions",
            "steps",
            "lessons",
            "lesson_updates",
        ):
            self._require(name, _is_size(getattr(self, name)), "a whole number of at least 1")
        sizes: Any = self.hidden
        known = isinstance(sizes, tuple) and all(map(_is_size, sizes))
        self._require("hidden", known, "a tuple of whole numbers of at least 1")
        require_kinds(self, "DQNConfig")
        self._require("learning_rate", 0 < self.learning_rate < 1, "between 0 and 1")
        self._require("discount", 0 <= self.discount < 1, "at least 0 and below 1")
        self._require("target_rate", 0 < self.target_rate <= 1, "above 0, at most 1")
        self._require("epsilon_start", 0 <= self.epsilon_start <= 1, "from 0 to 1")
        self._require("epsilon_end", 0 <= self.epsilon_end <= 1, "from 0 to 1")
        self._require("huber_delta", 0 < self.huber_delta < float("inf"), "above 0")
        self._require("margin", 0 <= self.margin < float("inf"), "at least 0")
        scale = self.reward_scale
        self._require("reward_scale", scale is None or 0 < scale < float("inf"), "above 0, or None")
        ceiling = self.ceiling
        self._require("ceiling", ceiling is None or 0 < ceiling <= 1, "above 0, at most 1, or None")
        self._require_network()
        self._require(
            "warmup_decisions",
            self.warmup_decisions <= self.replay_capacity,
            f"at most replay_capacity ({self.replay_capacity})",
        )

    def _require_network(self) -> None:
        if self.network != "mlp":
            two = f"two sizes with network = {self.network!r}"
            self._require("hidden", len(self.hidden) == 2, two)
        alone = f"left away: network = {self.network!r} is one for all agents in any case"
        self._require("shared", self.network == "mlp" or not self.shared, alone)
        # a learner may replace the default, and then checks again
        usual = isinstance(self.network, UsualValue)
        begins = self.start is None or usual or self.network == "universal"
        self._require("start", begins, "left away: only network = 'universal' can begin with it")

    def _require(self, name: str, holds: bool, allowed: str) -> None:
        if not holds:
            raise OptionError(f"DQNConfig.{name} = {getattr(self, name)!r}: must be {allowed}")

    def epsilon(self, decisions: int, *, taught: bool) -> float:
        """Return the share of exploratory decisions.

        Args:
            decisions: Own decisions so far.
            taught: True if a teacher showed episodes before. There may be none for a teacher: rules
                need observations of movements.
        """
        if taught:
            return self.epsilon_end
        progress = min(1.0, decisions / self.epsilon_decay_decisions)
        return self.epsilon_start + progress * (self.epsilon_end - self.epsilon_start)
