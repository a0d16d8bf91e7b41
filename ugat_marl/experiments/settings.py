"""Settings: ways to come to a policy."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.files import file_hash
from ugat_marl.grounding import NegativeControl, UgatConfig, require_negative_control
from ugat_marl.policies import (
    SUITE_LEARNERS,
    UNIVERSAL_NAME,
    DQNConfig,
    LearnerFactory,
    baseline_settings,
    is_own,
    is_savable,
    learner_factory,
    learner_library,
    lesson_episodes,
    load_own,
    observed_options,
    own_source,
    own_values,
    require_known_learner,
    suite_config,
)

SEEN_COMMANDS = 4
"""Number of own commands that the agents of `SEEING_ORACLE` see."""

MOST_DELAY_S = 5
"""Longest of the random delays of the recipe "delays", in s."""

CHANGE_COST = 5.0
"""Cost of a change of phase of the recipe "penalty", in halting vehicles."""


Recipe = Literal[
    "direct",
    "grounded",
    "further",
    "scratch",
    "randomised",
    "delays",
    "penalty",
    "untrained",
    "rule",
]
RECIPES: tuple[Recipe, ...] = get_args(Recipe)


@dataclass(frozen=True)
class LearnerSpec:
    """The algorithm that learns, with its settings.

    Attributes:
        name: "universal" or "dqn", the suite's own, the name of a baseline, or ``module:name`` of a
            user's learner.
        settings: Settings of a baseline or of a user's learner as ``NAME=VALUE``.
        dqn: Settings of the suite's own learners. Those that are not given are replaced by the
            learner's own, so that they survive JSON, which does not tell them from given ones.
    """

    name: str = UNIVERSAL_NAME
    settings: tuple[str, ...] = ()
    dqn: DQNConfig = field(default_factory=DQNConfig)

    def __post_init__(self) -> None:
        require_known_learner(self.name)
        if self.name in SUITE_LEARNERS:
            object.__setattr__(self, "dqn", suite_config(self.name, self.dqn))
        elif self.dqn != DQNConfig():
            raise OptionError(
                f"settings dqn are of the learners {' and '.join(SUITE_LEARNERS)}, not of "
                f"{self.name!r}; give those of yours as learner_settings"
            )

    def factory(self, device: str = "cpu") -> LearnerFactory:
        """Return a factory of fresh learners.

        Args:
            device: Device for the updates of the suite's own; baselines stay on the CPU.

        Raises:
            UnknownNameError: A setting does not exist.
            OptionError: A value is impossible, the library is not installed, or the device does
                not exist.
        """
        return learner_factory(self.name, self.settings, self.dqn, device)

    def env_options(self, observation: str | None, **others: Any) -> dict[str, Any]:
        """Return the options of environments in which it learns.

        Args:
            observation: Kind of observation; None for the one that the learner needs, or `count`.
            **others: Options that the learner does not decide.
        """
        needed = observed_options(self.name)
        shown = {} if observation is None else {"observation": observation}
        return {"observation": "count", **needed, **shown, **others}

    @property
    def savable(self) -> bool:
        """True if other trainings can start from what the learner has learnt."""
        return not is_own(self.name) or is_savable(load_own(self.name, "learner"))

    @property
    def identity(self) -> dict[str, Any]:
        """Name and settings of the learner, and the library of a baseline.

        Raises:
            OptionError: The learner's library is not installed, or the file of weights to begin
                with cannot be read.
        """
        if self.name in SUITE_LEARNERS:
            settings = asdict(self.dqn)
            if self.dqn.start is not None:
                settings["start"] = file_hash(Path(self.dqn.start))
            return {"name": self.name, "settings": settings}
        if is_own(self.name):
            source = own_source(self.name)
            identity = {"name": self.name, "settings": list(self.settings), "source": source}
            values = own_values(self.name)
            return {**identity, "values": values} if values else identity
        settings = baseline_settings(self.name, self.settings)
        return {"name": self.name, "settings": settings, "library": learner_library(self.name)}


@dataclass(frozen=True)
class Setting:
    """One way to come to a policy; it can be written as JSON.

    Attributes:
        name: Name of its row in a table. It has no influence on the policy.
        recipe: "direct" (plain training in the simulation), "grounded" (UGAT), "further" (direct
            transfer trained further in `world`), "scratch" (all episodes in `world`), "randomised"
            (all episodes in worlds drawn at random), "delays" (direct transfer trained further in
            `world` while greens begin late by random times), "penalty" (the same while changes of
            phase cost reward), "untrained" (no training episodes), "rule" (the best rule, no
            training).
        world: Domain to train in; None for the job's real domain, or for the simulation if the job
            has no real domain.
        learner: The algorithm that learns.
        ugat: Settings of UGAT; only for "grounded".
        negative_control: A negative control of "grounded": "same-world" records D_real in the
            simulation, "shuffled" permutes the outcomes in D_real, "noise" replaces f by noise.
        episodes: Training episodes after those of direct transfer; None for as many as UGAT has.
        most_delay_s: Longest delay of "delays", in s.
        commands: Number of own commands that agents see in training without grounding; a fitted
            street decides it by itself.
        rules: Rules among which "rule" chooses; empty for all.
        lessons: False if no rule teaches the learner in `world`, where it would play episodes that
            nobody counts.
    """

    name: str
    recipe: Recipe
    world: str | None = None
    learner: LearnerSpec = field(default_factory=LearnerSpec)
    ugat: UgatConfig | None = None
    negative_control: NegativeControl = "none"
    episodes: int | None = None
    most_delay_s: int = MOST_DELAY_S
    commands: int = 0
    rules: tuple[str, ...] = ()
    lessons: bool = True

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise UnknownNameError("recipe", self.recipe, RECIPES)
        if (self.recipe == "grounded") != (self.ugat is not None):
            raise OptionError(
                f"setting {self.name!r} of recipe {self.recipe!r}: give ugat with recipe "
                '"grounded", and with no other'
            )
        require_negative_control(self.negative_control)

    @property
    def knows_target(self) -> bool:
        """True if the policy depends on the real domain in which it is judged."""
        by_world = self.recipe in ("further", "scratch") and self.world is None
        return by_world or self.recipe in ("grounded", "rule")

    @property
    def begins_with_direct(self) -> bool:
        """True if training starts from direct transfer."""
        return self.recipe in ("grounded", "further", "delays", "penalty")

    @property
    def matches(self) -> bool:
        """True if timed grounding matches the rewards of simulation and real domain."""
        return self.ugat is not None and self.ugat.matches

    @property
    def kind(self) -> str:
        """Kind of grounding, or else the recipe: a word for names of folders."""
        return self.ugat.grounding if self.ugat is not None else self.recipe

    @property
    def identity(self) -> dict[str, Any]:
        """Part of a job's identity that the setting decides."""
        if self.recipe == "rule":
            return {"recipe": self.recipe, "rules": self.rules}
        parts: dict[str, Any] = {"recipe": self.recipe, "world": self.world}
        parts |= {"learner": self.learner.identity}
        if self.ugat is not None:
            parts["ugat"] = asdict(self.ugat)
        if self.negative_control != "none":
            parts["negative_control"] = self.negative_control
        if self.recipe == "delays":
            parts["most_delay_s"] = self.most_delay_s
        if self.recipe == "penalty":
            parts["change_cost"] = CHANGE_COST
        if self.commands:
            parts["commands"] = self.commands
        learner = self.learner
        if not self.lessons and (
            self.recipe == "untrained" or lesson_episodes(learner.name, learner.dqn)
        ):
            parts["lessons"] = 0
        return parts
