"""Settings of the DQN learner, checked when made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from ugat_marl.errors import OptionError
from ugat_marl.policies.networks.structure import NetworkName

CEILING_DECISIONS = 1_000
"""How far back a ceiling looks: long enough for a quantile, too short for early exploration."""


@dataclass(frozen=True)
class DQNConfig:
    """Settings of DQN.

    Rewards are centred and scaled per agent before learning: the mean and the standard deviation
    of each agent's rewards over the first `warmup_decisions` are measured once and then frozen, so
    that targets are of order one whatever the traffic. In episodes without a natural end a constant
    shift of the reward moves all Q-values alike and changes no decision; where an agent does
    terminate, the bootstrap value is shifted along. `reward_scale` replaces the measured scale (and
    the centre, by 0) for all agents.

    Observations are divided, number by number, by the root mean square of what stood there in those
    decisions: a lane with five vehicles is 0.125 in the observation "count", beside a phase that is
    1, and its weights would need long to grow.

    The defaults were chosen on one network only (Hangzhou, one intersection, 60 episodes of 360
    decisions, one or two seeds each): longer bouts of exploration, one-step targets and a short
    decay learned faster; hidden layers of 64 were no better than of 48.

    Attributes:
        hidden: Sizes of the hidden layers of every network.
        learning_rate: Step size of Adam.
        discount: Weight of the next decision's value (gamma), 0.95-0.98 in the literature.
        batch_size: Transitions per update and agent.
        replay_capacity: Decisions remembered.
        warmup_decisions: Decisions before the first update.
        update_every: Decisions from one update to the next.
        target_rate: Share of the online network mixed into the target network at every update.
        epsilon_start: Share of exploratory decisions at the beginning.
        epsilon_end: Share of exploratory decisions after the decay.
        epsilon_decay_decisions: Decisions over which epsilon falls, linearly.
        sticky_decisions: Longest bout of one exploratory action, in decisions; 1 is plain
            epsilon-greedy.
        huber_delta: Errors beyond this (in scaled reward) count linearly.
        reward_scale: Factor on all rewards; None measures it per agent.
        scale_inputs: Whether observations are scaled; not those of "frap".
        shared: One network for all agents, told for which of them it computes, instead of one for
            each; it learns from the transitions of all.
        network: What computes Q. "mlp": layers over an agent's observation. "frap": phases that
            compete with the demand of their movements (Zheng et al. 2019), one network for all
            intersections; `hidden` is the size of a demand and that of a pair of phases. "colight":
            attention to the neighbours (Wei et al. 2019), one network for all intersections;
            `hidden` is the size of an embedding and that of the layer after the attention.
        ceiling: Quantile of each number of an observation, over the last `CEILING_DECISIONS`
            decisions in training, below which policies hold it: they act in a fuller street than
            they know as in the fullest they know, and not by what a network makes of numbers it
            has never had. None gives policies observations as they are.
    """

    hidden: tuple[int, ...] = (48, 48)
    learning_rate: float = 1e-3
    discount: float = 0.95
    batch_size: int = 32
    replay_capacity: int = 10_000
    warmup_decisions: int = 200
    update_every: int = 1
    target_rate: float = 0.01
    epsilon_start: float = 1.0
    epsilon_end: float = 0.05
    epsilon_decay_decisions: int = 3_600
    sticky_decisions: int = 3
    huber_delta: float = 1.0
    reward_scale: float | None = None
    scale_inputs: bool = True
    shared: bool = False
    network: NetworkName = "mlp"
    ceiling: float | None = None

    def __post_init__(self) -> None:
        # a list, as JSON has it, would differ from the tuple of a checkpoint
        object.__setattr__(self, "hidden", tuple(self.hidden))
        for name in (
            "batch_size",
            "replay_capacity",
            "warmup_decisions",
            "update_every",
            "epsilon_decay_decisions",
            "sticky_decisions",
        ):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        self._require("hidden", all(width >= 1 for width in self.hidden), "sizes of at least 1")
        self._require("learning_rate", 0 < self.learning_rate < 1, "between 0 and 1")
        self._require("discount", 0 <= self.discount < 1, "at least 0 and below 1")
        self._require("target_rate", 0 < self.target_rate <= 1, "above 0, at most 1")
        self._require("epsilon_start", 0 <= self.epsilon_start <= 1, "from 0 to 1")
        self._require("epsilon_end", 0 <= self.epsilon_end <= 1, "from 0 to 1")
        self._require("huber_delta", 0 < self.huber_delta < float("inf"), "above 0")
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
        known = get_args(NetworkName)
        self._require("network", self.network in known, f"one of {', '.join(known)}")
        if self.network != "mlp":
            two = f"two sizes with network = {self.network!r}"
            self._require("hidden", len(self.hidden) == 2, two)
        alone = f"left away: network = {self.network!r} is one for all agents in any case"
        self._require("shared", self.network == "mlp" or not self.shared, alone)

    def _require(self, name: str, holds: bool, allowed: str) -> None:
        if not holds:
            raise OptionError(f"DQNConfig.{name} = {getattr(self, name)!r}: must be {allowed}")

    def epsilon(self, decisions: int) -> float:
        """Share of exploratory decisions after `decisions` decisions."""
        progress = min(1.0, decisions / self.epsilon_decay_decisions)
        return self.epsilon_start + progress * (self.epsilon_end - self.epsilon_start)
