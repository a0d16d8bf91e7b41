"""What stands in the rows of a table: ways to come to a policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from ugat_marl.effects import describe, scenario_of
from ugat_marl.errors import OptionError
from ugat_marl.experiments.transfers import (
    CONTROL,
    DIRECT,
    FINE_TUNED,
    ORACLE,
    RANDOM_DELAY,
    RANDOMISED,
    TIMED,
    UGAT,
)
from ugat_marl.grounding import FitConfig, GateConfig, UgatConfig

Kind = Literal["direct", "grounded", "further", "scratch", "randomised", "delays", "rule"]

RULE = "best rule, tuned there"

TABLES = ("main", "ablation", "alpha", "uncertainty", "gap")
GROUNDED_NAME = {"phase": UGAT, "timed": TIMED}


@dataclass(frozen=True)
class Setting:
    """One way to come to a policy.

    Attributes:
        name: What it is called in the table.
        kind: "direct" (plain training), "grounded" (UGAT), "further" (direct transfer trained on
            in `world`), "scratch" (all episodes in `world`), "randomised" (all episodes in worlds
            drawn at random), "delays" (direct transfer trained on under random delays), "rule".
        world: Domain to train in; None for the real domain of the column.
        ugat: Of UGAT, for "grounded".
        episodes: Of training beyond, or instead of, the plain ones; None for as many as UGAT has.
    """

    name: str
    kind: Kind
    world: str | None = None
    ugat: UgatConfig = field(default_factory=UgatConfig)
    episodes: int | None = None

    @property
    def knows_target(self) -> bool:
        """Whether the policy depends on the real domain it is judged in."""
        by_world = self.kind in ("further", "scratch") and self.world is None
        return by_world or self.kind in ("grounded", "rule")


def settings_of(
    table: str,
    ugat: UgatConfig,
    sim: str,
    groundings: Sequence[str] = ("phase", "timed"),
    constants: Sequence[int] = (1, 2, 3, 4, 5),
) -> list[Setting]:
    """The rows of a table.

    Args:
        table: One of `TABLES`.
        ugat: Settings that the rows share.
        sim: The simulation.
        groundings: Which kinds of grounding to try: "phase", "timed".
        constants: Constant delays in s that "main" sweeps.

    Raises:
        OptionError: A grounding, delay or table that does not exist.
    """
    for grounding in groundings:
        if grounding not in GROUNDED_NAME:
            raise OptionError(f"grounding {grounding!r}: allowed are phase and timed")
    if not groundings:
        raise OptionError("groundings is empty; name phase, timed, or both")
    if wrong := [seconds for seconds in constants if seconds < 1]:
        raise OptionError(f"constants holds {wrong[0]}: delays are whole seconds, at least 1")
    # The paper's grounding obeys its models from the start.
    least = {"phase": None, "timed": ugat.least_accuracy}
    alone = replace(ugat, timed=replace(ugat.timed, match=False))  # matching is a row of its own
    bases = {g: replace(alone, grounding=g, least_accuracy=least[g]) for g in groundings}
    direct, rule = Setting(DIRECT, "direct"), Setting(RULE, "rule")
    if table == "main":
        return [direct, *_grounded(bases), *_controls(ugat, sim, constants), rule]
    if table == "ablation":
        rows = [direct, Setting(CONTROL, "further", sim)]
        return rows + [row for name, base in bases.items() for row in _ablated(name, base)]
    if table == "alpha":
        return [direct] + [row for name, base in bases.items() for row in _alphas(name, base)]
    if table == "uncertainty":
        return [direct] + [row for name, base in bases.items() for row in _methods(name, base)]
    if table == "gap":
        return [direct, rule]
    raise OptionError(f"table {table!r}: allowed are {', '.join(TABLES)}")


def constant_name(seconds: int) -> str:
    """The row of a constant delay."""
    return f"constant delay {seconds} s"


def matched_name(grounding: str) -> str:
    """The row of a grounding that matches rewards."""
    return f"{GROUNDED_NAME[grounding]}: rewards matched"


def late_in(sim: str, seconds: int) -> str:
    """The simulation with every green late by so many seconds.

    Raises:
        OptionError: It is a scenario of its own, to which no effect can be added by name.
    """
    if scenario_of(sim) is not None:
        raise OptionError(
            f"sim = {sim!r} is a scenario of its own, in which no greens can be delayed: give "
            "--constants without any number"
        )
    late = f"late_green=*,{seconds}"
    return late if describe(sim) == "sim" else f"{describe(sim)}+{late}"


def _grounded(bases: dict[str, UgatConfig]) -> list[Setting]:
    rows = [Setting(GROUNDED_NAME[name], "grounded", ugat=base) for name, base in bases.items()]
    return rows + [row for name, base in bases.items() for row in _matching(name, base)]


def _matching(name: str, base: UgatConfig) -> list[Setting]:
    """Timed grounding that matches rewards; nothing for the phase's, which cannot."""
    ugat = replace(base, timed=replace(base.timed, match=True))
    row = Setting(matched_name(name), "grounded", ugat=ugat)
    return [row] * ugat.matches


def _controls(ugat: UgatConfig, sim: str, constants: Sequence[int]) -> list[Setting]:
    seen = ugat.iterations * ugat.real_rollouts
    return [
        Setting(CONTROL, "further", sim),
        Setting(RANDOMISED, "randomised"),
        Setting(RANDOM_DELAY, "delays", sim),
        *(Setting(constant_name(s), "further", late_in(sim, s)) for s in constants),
        Setting(FINE_TUNED, "further", episodes=seen),
        Setting(ORACLE, "scratch"),
    ]


def _ablated(name: str, base: UgatConfig) -> list[Setting]:
    """Table 3 of the paper: static threshold, no uncertainty; and every other part alone."""
    full = GROUNDED_NAME[name]
    static = replace(base, gate=replace(base.gate, mode="static", static_alpha=0.5))
    ungated = replace(base, gate=replace(base.gate, mode="infinite"))
    fitted = replace(base, gate=replace(base.gate, start="fitted"))
    plain = replace(ungated, fit=replace(base.fit, uncertainty="none"))
    proven = replace(base, least_accuracy=0.0)
    return [
        Setting(full, "grounded", ugat=base),
        Setting(f"{full}: α = 0.5", "grounded", ugat=static),
        Setting(f"{full}: α from the first fit on", "grounded", ugat=fitted),
        Setting(f"{full}: no gate", "grounded", ugat=ungated),
        Setting(f"{full}: no uncertainty (GAT)", "grounded", ugat=plain),
        *(
            [Setting(f"{full}: where f and h are proven", "grounded", ugat=proven)]
            * (base != proven)
        ),
        *_other_answers(name, base),
        *_matching(name, base),
    ]


def _other_answers(name: str, base: UgatConfig) -> list[Setting]:
    """Another h: of the phase's one that is trained on means, of the timed one none at all."""
    full = GROUNDED_NAME[name]
    if name == "phase":
        smoothed = replace(base, fit=replace(base.fit, pairs="smoothed"))
        return [Setting(f"{full}: h on smoothed pairs", "grounded", ugat=smoothed)]
    constants = replace(base, timed=replace(base.timed, answer="constant"))
    return [Setting(f"{full}: lost times without h", "grounded", ugat=constants)]


def _alphas(name: str, base: UgatConfig) -> list[Setting]:
    full = GROUNDED_NAME[name]
    static = [
        Setting(f"{full}: α = {alpha}", "grounded", ugat=replace(base, gate=_static(base, alpha)))
        for alpha in (0.2, 0.4, 0.5, 0.6, 0.8)
    ]
    pooled = replace(base, gate=replace(base.gate, scope="pooled"))
    rows = [*static, Setting(full, "grounded", ugat=base)]
    return [*rows, Setting(f"{full}: α pooled over the network", "grounded", ugat=pooled)]


def _static(base: UgatConfig, alpha: float) -> GateConfig:
    return replace(base.gate, mode="static", static_alpha=alpha)


def _methods(name: str, base: UgatConfig) -> list[Setting]:
    full = GROUNDED_NAME[name]
    methods: dict[str, FitConfig] = {
        "evidential": replace(base.fit, uncertainty="edl"),
        "Concrete Dropout": replace(base.fit, uncertainty="dropout"),
        "Deep Ensembles": replace(base.fit, uncertainty="ensemble"),
        "none (GAT)": replace(base.fit, uncertainty="none"),
    }
    return [
        Setting(f"{full}: {method}", "grounded", ugat=replace(base, fit=fit))
        for method, fit in methods.items()
    ]
