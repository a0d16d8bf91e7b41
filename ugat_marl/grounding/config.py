"""Settings of UGAT: everything that decides a training across the gap, in one dataclass."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal

from ugat_marl.data import AgentLayout
from ugat_marl.errors import OptionError, UnknownNameError, require_kinds, require_least
from ugat_marl.grounding.fitting import FitConfig
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.gate import GateConfig
from ugat_marl.grounding.inverse import InverseConfig
from ugat_marl.grounding.phase import PhaseTransform
from ugat_marl.grounding.residual import Residual
from ugat_marl.grounding.street import StreetConfig
from ugat_marl.grounding.timed import TimedConfig, TimedTransform
from ugat_marl.grounding.transform import Transform
from ugat_marl.grounding.view import InputsConfig, Neighbours
from ugat_marl.policies import Usual, UsualName, UsualNumber, UsualValue

GROUNDINGS = ("phase", "timed", "street")
_STREET: Any = UsualName("street")


@dataclass(frozen=True)
class UgatConfig:
    """Settings of the algorithm.

    Attributes:
        grounding: Kind of the grounding: "street" leaves actions alone and trains in worlds fitted
            to the street; "phase" grounds an action by another phase, as in the paper; "timed" by
            the policy's own phase with a green that begins later.
        pretrain_episodes: M, episodes in plain sim before the first iteration.
        iterations: I, repetitions of rolling out, fitting and grounded training.
        grounded_episodes: E, episodes of training in the grounded sim per iteration.
        sim_rollouts: Episodes added to D_sim per iteration, with "phase" and "timed".
        real_rollouts: Episodes added to D_real per iteration.
        rollout_epsilon: Chance of a random phase in these roll-outs.
        least_accuracy: Smallest held-out accuracy of h with which grounded actions are taken at an
            intersection. With "timed": the share by which h must beat a guess. f and h must also
            be better than trivial answers, such as "no change" or the most frequent phase; 0
            requires only this. None takes grounded actions from the start, as the paper does.
        inputs: Inputs of f and h beside the intersection's own state and action.
        forward: Shape of f; with "street", as the next three, only that of a residual.
        inverse: Shape of h.
        fit: Settings of the training of f and h.
        gate: Settings of alpha.
        timed: Settings of the delays, with "timed".
        street: Settings of the fit, with "street".
    """

    grounding: Literal["phase", "timed", "street"] = _STREET
    pretrain_episodes: int = Usual(20)
    iterations: int = Usual(2)
    grounded_episodes: int = Usual(10)
    sim_rollouts: int = Usual(3)
    real_rollouts: int = Usual(2)
    rollout_epsilon: float = UsualNumber(0.3)
    least_accuracy: float | None = UsualNumber(0.0)
    inputs: InputsConfig = field(default_factory=InputsConfig)
    forward: ForwardConfig = field(default_factory=ForwardConfig)
    inverse: InverseConfig = field(default_factory=InverseConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    timed: TimedConfig = field(default_factory=TimedConfig)
    street: StreetConfig = field(default_factory=StreetConfig)

    @property
    def used(self) -> frozenset[str]:
        """Names of the settings among `WITH` that this grounding, or its residual, uses."""
        fitted = self.grounding == "street"
        acting = self.street.residual.kind if fitted else self.grounding
        models = frozenset() if acting == "none" else _OF_MODELS
        return models | {acting} & {"timed"} | {"street" if fitted else "sim_rollouts"}

    @property
    def most_delay_s(self) -> int:
        """Longest random delay in the roll-outs for D_sim, in s; 0 for none."""
        return self.timed.most_s if self.grounding == "timed" else 0

    @property
    def matches(self) -> bool:
        """True if the delays are chosen so that rewards match those of the real domain."""
        return self.grounding == "timed" and self.timed.match

    @property
    def residual_delay_s(self) -> int:
        """Longest random delay in the roll-outs of a fitted street, in s; 0 for none."""
        timed = self.grounding == "street" and self.street.residual.kind == "timed"
        return self.timed.most_s if timed else 0

    def residual(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        neighbours: Neighbours | None = None,
    ) -> Residual | None:
        """Return unfitted f, h and gate on top of a fitted street; None if there are none.

        The arguments are those of `transform`.
        """
        own = self.street.residual
        if self.grounding != "street" or own.kind == "none":
            return None
        other = own.kind == "phase"  # the phase of s' tells which request the street obeyed
        # With a history of delayed greens, a lost time was found between `sim` and itself.
        history = max(self.inputs.history, own.history) if other else self.inputs.history
        base = replace(
            self,
            grounding=own.kind,
            inputs=replace(self.inputs, history=history),
            forward=replace(self.forward, members=own.members, include_phase=other),
            inverse=replace(self.inverse, include_phase=other),
            timed=replace(self.timed, match=False),
        )
        return Residual(base.transform(layouts, seed, neighbours), own, self.least_accuracy)

    def transform(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        neighbours: Neighbours | None = None,
    ) -> Transform:
        """Return unfitted models and gate for these agents.

        Args:
            layouts: Agent to the division of its observation.
            seed: Seed of the initial weights.
            neighbours: Agent to the agents one road away (`grounding.view.neighbours_of`); needed
                for inputs with hops.

        Raises:
            OptionError: The grounding is "street", which changes no actions.
        """
        if self.grounding == "street":
            raise OptionError('grounding "street" changes the simulation and has no transform')
        if self.grounding == "timed":
            return TimedTransform(
                layouts,
                seed,
                forward=self.forward,
                inverse=self.inverse,
                gate=self.gate,
                timed=self.timed,
                inputs=self.inputs,
                neighbours=neighbours,
            )
        return PhaseTransform(
            layouts,
            seed,
            forward=self.forward,
            inverse=self.inverse,
            gate=self.gate,
            inputs=self.inputs,
            neighbours=neighbours,
        )

    def __post_init__(self) -> None:
        if self.grounding not in GROUNDINGS:
            raise UnknownNameError("grounding", self.grounding, GROUNDINGS)
        require_kinds(self, "training:")
        require_least(0, pretrain_episodes=self.pretrain_episodes, iterations=self.iterations)
        require_least(1, grounded_episodes=self.grounded_episodes)
        require_least(1, sim_rollouts=self.sim_rollouts, real_rollouts=self.real_rollouts)
        for name in ("rollout_epsilon", "least_accuracy"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise OptionError(f"{name} = {value}: must be from 0 to 1")


_OF_MODELS = frozenset(("least_accuracy", "inputs", "forward", "inverse", "fit", "gate"))
_RESIDUAL = ", or with such a residual of a fitted street"
WITH: Mapping[str, str] = {
    **dict.fromkeys(sorted(_OF_MODELS), f"phase or timed{_RESIDUAL}"),
    "timed": f"timed{_RESIDUAL}",
    "sim_rollouts": "phase or timed",
    "street": "street",
}
"""Settings that some groundings do not use, and with which they count."""


def refuse_unused(config: UgatConfig, used: Collection[str]) -> None:
    """Refuse settings that would do nothing.

    Args:
        config: The settings.
        used: Names of those among `WITH` that are used.

    Raises:
        OptionError: One that is not used differs from its default.
    """
    usual = UgatConfig()
    for name, value, _ in _others(config, usual, usual):
        part = name.partition(".")[0]
        if part in WITH and part not in used:
            raise OptionError(
                f"{name} = {value} counts with the grounding {WITH[part]}; leave it out, or ask "
                "for another grounding"
            )


COUNTS: Mapping[str, int] = {
    "pretrain_episodes": 60,
    "iterations": 4,
    "grounded_episodes": 10,
    "sim_rollouts": 3,
    "real_rollouts": 3,
}
"""Settings that Algorithm 1 leaves open: numbers of episodes and iterations, for `as_published`."""

PUBLISHED_EPOCHS = 300
"""Epochs of the fits in the paper."""


def require_preset(name: str | None) -> None:
    """Refuse a preset that does not exist.

    Raises:
        UnknownNameError: It is neither None nor "paper".
    """
    if name not in (None, "paper"):
        raise UnknownNameError("preset", name, ("paper",))


def as_published(config: UgatConfig) -> UgatConfig:
    """Return Algorithm 1 of the paper without departures, with these numbers of episodes.

    Every departure, its reason and what it changes: docs/explanation/departures.md. Numbers of
    episodes that were not given become those of `COUNTS`: a learner that begins with nothing needs
    more of them.

    Raises:
        OptionError: Another setting than a number of episodes was changed.
    """
    given: dict[str, Any] = {name: getattr(config, name) for name in COUNTS}
    counts: dict[str, Any] = {
        name: COUNTS[name] if isinstance(value, Usual) else value for name, value in given.items()
    }
    published = UgatConfig(
        **counts,
        grounding="phase",
        rollout_epsilon=0.0,
        least_accuracy=None,
        forward=ForwardConfig(include_phase=True),
        inverse=InverseConfig(include_phase=True),
        fit=FitConfig(
            epochs=PUBLISHED_EPOCHS,
            patience=PUBLISHED_EPOCHS,
            kl_weight=1.0,
            off_data_weight=0.0,
        ),
        gate=GateConfig(scope="pooled", window_epochs=counts["grounded_episodes"]),
    )
    for name, value, wanted in _others(config, UgatConfig(**given), published):
        raise OptionError(
            'the preset "paper" decides all settings of the algorithm but the numbers of episodes '
            f"({', '.join(COUNTS)}), and has {name} = {wanted}, not {value}; leave it out, or, to "
            "change one of its settings, leave out the preset and give the others one by one "
            "(docs/tutorials/student.md)"
        )
    return published


def _others(given: Any, usual: Any, wanted: Any, of: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield name, value and wanted value of settings that were given and are not the wanted ones.

    A default that a preset replaces is a `UsualValue`, and so differs from the same value given.
    """
    for part in fields(wanted):
        name = f"{of}{part.name}"
        own, default, needed = (getattr(one, part.name) for one in (given, usual, wanted))
        if is_dataclass(needed):
            yield from _others(own, default, needed, f"{name}.")
            continue
        untouched = isinstance(own, UsualValue) or not isinstance(default, UsualValue)
        if own != needed and not (own == default and untouched):
            yield name, own, needed


USUAL_REWARD: str = UsualName("total-queue")
"""Default reward of a training."""


def published_reward(reward: str) -> str:
    """Return the reward of Algorithm 1 as published, in place of the default.

    Raises:
        OptionError: Another reward was given.
    """
    if reward != "queue" and not isinstance(reward, UsualName):
        raise OptionError(f"preset paper trains with the reward 'queue', not {reward!r}")
    return "queue"
