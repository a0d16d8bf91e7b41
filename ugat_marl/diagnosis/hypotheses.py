"""Library of the effects that may be missing, with the strengths of their first simulations."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from statistics import fmean
from typing import Any, TypeVar

from ugat_marl.effects import (
    EVERYWHERE,
    NO_SOFTER,
    Effect,
    ExaminedStrengths,
    known_effects,
    measurement_effects,
    type_numbers,
    type_values,
)
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Scenario

WINDOW = ("begin_s", "end_s")
"""Names of the fields of an effect's window."""
WINDOWS_IN_THE_LOG = frozenset({"dropout", "stuck"})
"""Effects whose window is exact: single events of a detector say when it began and ended."""
ORDER = (
    "local_speed", "demand_level", "demand_surge", "demand_timing", "turning", "lane_closure",
    "parking",
)  # fmt: skip
"""Effects on roads and demand, which `ordered` puts first; see there for the rest."""


@dataclass(frozen=True)
class Hypothesis:
    """An effect with unknown values.

    Attributes:
        name: Name of the effect.
        fixed: Names and values of the known fields: places, windows, driver models.
        free: Names of the fields to fit.
        levels: Values of the free fields in the first simulations.
        nominal: Values of the free fields in the scenario, the mean if its vehicle types disagree;
            None if there are none.
        least: Distance from nominal below which the effect does not matter, in the field's unit.
        step: Grid of the values, in the field's unit; 0 for no grid.
        both: True if the effect below nominal is the opposite of the effect above.
        extreme: Members of `levels` that are simulated but too strong for a plausible world.
        neutral: True if nominal changes nothing. An effect gives all vehicle types one number, so
            it changes something at their mean.
    """

    name: str
    fixed: tuple[tuple[str, Any], ...]
    free: tuple[str, ...]
    levels: tuple[tuple[float, ...], ...]
    nominal: tuple[float, ...] | None
    least: float = 0.0
    step: float = 0.0
    both: bool = False
    extreme: tuple[tuple[float, ...], ...] = ()
    neutral: bool = True

    @property
    def key(self) -> tuple[Any, ...]:
        """Name and place: a model holds each such pair once."""
        return (self.name, tuple(field for field in self.fixed if isinstance(field[1], str)))

    @property
    def nothing(self) -> tuple[float, ...] | None:
        """Values of the free fields that change nothing; None if there are none."""
        return self.nominal if self.neutral else None

    def effect(self, values: Sequence[float]) -> Effect:
        """Make the effect with these values of the free fields, clipped to their ranges."""
        given = dict(self.fixed)
        given |= dict(zip(self.free, self.clipped(values), strict=True))
        return known_effects()[self.name](**given)

    def clipped(self, values: Sequence[float]) -> tuple[float, ...]:
        """Return the values on the grid of the effect, clipped to their plausible ranges."""
        ranges = known_effects()[self.name].ranges
        clipped: list[float] = []
        for name, value in zip(self.free, values, strict=True):
            low, high = ranges[name].low, ranges[name].high
            if self.step:
                value = self.step * round(value / self.step)
            clipped.append(round(min(max(float(value), low), high), 4))
        return tuple(clipped)

    def matters(self, values: Sequence[float]) -> bool:
        """Return True if the effect is strong enough to be named."""
        if not self.free or self.nothing is None:
            return True
        return abs(values[0] - self.nothing[0]) >= self.least

    def is_nothing(self, values: tuple[float, ...]) -> bool:
        """Return True if values on the effect's grid change nothing."""
        return self.nothing is not None and values == self.clipped(self.nothing)


_T = TypeVar("_T")
Members = tuple[tuple[Hypothesis, tuple[float, ...]], ...]
"""A set of effects: hypotheses and the values of their free fields."""

GLOBAL = (
    "acceleration", "deceleration", "emergency_deceleration", "startup_delay", "headway", "min_gap",
    "imperfection", "desired_speed", "speed_spread", "reaction_step", "yellow_running",
    "red_running", "gap_acceptance", "lane_discipline", "heavy_share", "late_green", "signal_clock",
    "clock_drift", "undercount", "demand_level", "demand_timing",
)  # fmt: skip
"""Effects with one number for the whole network, in the order in which they are simulated."""

LOCAL = frozenset(
    {
        "demand_surge", "turning", "lane_closure", "parking", "local_speed", "stuck", "dropout",
        "swapped",
    }
)  # fmt: skip
"""Effects that need a place, and some a window: see `places`."""

NEAR_ITS_BOUND = 1.3
"""Emergency deceleration that is tried, as a multiple of the model's usual one. By hand. Halved: no
emergency deceleration is so small."""

CAUTION = {"acceleration": -1, "deceleration": -1, "startup_delay": 1}
"""Properties of drivers that change together, and in which direction, for `cautious_drivers`."""

MODELS = ("IDM", "EIDM", "W99")
"""Driver models that are examined."""


def library(without: Collection[str] = ()) -> frozenset[str]:
    """Return the names of all effects that are examined.

    Raises:
        UnknownNameError: A name in `without` is not in the library.
    """
    names = frozenset(GLOBAL) | LOCAL | {"driver_model"}
    for name in without:
        if name not in (known := {**known_effects(), **measurement_effects()}):
            raise UnknownNameError("effect of the library", name, known)
    return names - frozenset(without)


def global_hypotheses(scenario: Scenario, allowed: Collection[str]) -> list[Hypothesis]:
    """Make the hypotheses about the whole network.

    Args:
        scenario: The scenario as it is; its vehicle types give the nominal values.
        allowed: Names of effects to examine.
    """
    hypotheses: list[Hypothesis] = []
    for name in GLOBAL:
        if name not in allowed:
            continue
        kind = known_effects()[name]
        entry, numbers = _examined_in(scenario, name)
        nominal = fmean(numbers)
        extreme = tuple((level,) for level in entry.extreme)
        hypothesis = Hypothesis(
            name,
            tuple((place, EVERYWHERE) for place in kind.texts),
            tuple(kind.ranges),
            (),
            (nominal,),
            entry.least,
            entry.step,
            entry.both,
            extreme,
            neutral=len(numbers) == 1,
        )
        levels = (hypothesis.clipped((level,)) for level in entry.levels)
        apart = tuple(level for level in levels if abs(level[0] - nominal) > entry.least)
        hypotheses.append(replace(hypothesis, levels=apart + extreme))
    if "driver_model" in allowed:
        usual = scenario.settings.sumo.get("default.carfollowmodel", "")
        now = type_values(scenario, "carFollowModel", usual)
        hypotheses += [
            Hypothesis("driver_model", (("model", model),), (), ((),), None)
            for model in MODELS
            if now != {model}
        ]
    return hypotheses


def _examined_in(scenario: Scenario, name: str) -> tuple[ExaminedStrengths, list[float]]:
    """Return the strengths of an effect of `GLOBAL`, and its numbers in a scenario's types."""
    entry, attribute = examined(name), known_effects()[name].attribute
    if name != "reaction_step":
        return entry, type_numbers(scenario, attribute, entry.nominal)
    # By default drivers decide in each step of the simulation, and none decides more often.
    step_s = scenario.settings.step_length_s
    usual_s = float(scenario.settings.sumo.get("default.action-step-length", step_s))
    numbers = sorted({max(each, step_s) for each in type_numbers(scenario, attribute, usual_s)})
    levels = tuple(max(level, 2.0 * fmean(numbers)) for level in entry.levels)
    return replace(entry, levels=levels, step=step_s), numbers


def cautious_drivers(hypotheses: Sequence[Hypothesis]) -> list[Members]:
    """Return sets of several properties of drivers as starting points of a fit.

    In bad weather drivers start later, and speed up and brake more gently, all at once. Single
    effects do not lead there. The strengths are those at which the library examines each effect
    alone: the mildest together, and the strongest together. Where drivers are so cautious already
    that a property has none, there is no set.

    Args:
        hypotheses: Hypotheses about the whole network.
    """
    known = {hypothesis.name: hypothesis for hypothesis in hypotheses}
    mild: list[tuple[Hypothesis, tuple[float, ...]]] = []
    strong: list[tuple[Hypothesis, tuple[float, ...]]] = []
    for name, sign in CAUTION.items():
        if name not in known:
            return []
        hypothesis = known[name]
        assert hypothesis.nominal is not None
        (usual,) = hypothesis.nominal
        plausible = (level for level in hypothesis.levels if level not in hypothesis.extreme)
        cautious = [level for level in plausible if sign * (level[0] - usual) > 0]
        if not cautious:
            return []
        cautious.sort(reverse=sign < 0)
        mild.append((hypothesis, cautious[0]))
        strong.append((hypothesis, cautious[-1]))
    return [tuple(mild), tuple(strong)]


def ordered(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return effects in the order of their application: roads and demand first, detectors last.

    The order matters: trucks come after effects on drivers and so keep their own acceleration.
    """

    def rank(effect: Effect) -> tuple[int, str]:
        if effect.on_detectors:
            return (4, str(effect))
        if effect.name in ORDER:
            return (0, str(effect))
        if effect.name == "driver_model":
            return (1, str(effect))
        return (3 if effect.name == "heavy_share" else 2, str(effect))

    return tuple(sorted(effects, key=rank))


def examined(name: str) -> ExaminedStrengths:
    """Return the strengths of the first simulations of an effect of `GLOBAL`."""
    strengths = known_effects()[name].examined
    assert strengths is not None, name
    return strengths


def free_values(effect: Effect, hypothesis: Hypothesis) -> tuple[float, ...]:
    """Return the values of the free fields in an effect."""
    known = {field.name for field in fields(effect)}
    if missing := [name for name in hypothesis.free if name not in known]:
        raise OptionError(f"effect {effect.name!r} has no {missing[0]!r}")
    return tuple(float(getattr(effect, name)) for name in hypothesis.free)


def both_ways(
    hypothesis: Hypothesis, values: tuple[float, ...], farther: float
) -> list[tuple[Hypothesis, tuple[float, ...], tuple[float, ...]]]:
    """Return two changes of an effect of the model: to nominal, and farther from it.

    Args:
        hypothesis: The effect.
        values: Its present values.
        farther: Share of the distance from nominal that the second change adds.

    Returns:
        Hypothesis, changed values, present values.
    """
    if not values or hypothesis.nominal is None:
        return []
    away = tuple(
        (1.0 + farther) * v - farther * n for v, n in zip(values, hypothesis.nominal, strict=True)
    )
    less = hypothesis.clipped(hypothesis.nominal)
    changes = [(hypothesis, level, values) for level in (less, hypothesis.clipped(away))]
    return [change for change in changes if change[1] != values]


def a_few(hypothesis: Hypothesis, members: Members = ()) -> tuple[tuple[float, ...], ...]:
    """Return one strength on each side of nominal, enough for rounds after the first.

    An emergency deceleration changes little until it comes near the usual one. Where the model has
    a usual one, a strength near it is added.

    Args:
        hypothesis: The hypothesis.
        members: Members of the model.
    """
    levels, nominal = hypothesis.levels, hypothesis.nominal
    if nominal is None or len(levels) < 2:
        return levels
    low = [level for level in levels if level < nominal]
    high = [level for level in levels if level > nominal]
    few = tuple(side[len(side) // 2] for side in (low, high) if side)
    bound = [values for other, values in members if other.name == NO_SOFTER.get(hypothesis.name)]
    return few + tuple((NEAR_ITS_BOUND * value,) for (value,) in bound)


def effects_of(members: Members) -> tuple[Effect, ...]:
    """Return the effects of a set, in order."""
    return ordered([hypothesis.effect(values) for hypothesis, values in members])


def keys_of(members: Members) -> set[tuple[Any, ...]]:
    """Return names and places of the effects of a model."""
    return {hypothesis.key for hypothesis, _ in members}


def each_left_out(members: Sequence[_T]) -> list[tuple[_T, ...]]:
    """Return the sets that lack one member each."""
    return [(*members[:index], *members[index + 1 :]) for index in range(len(members))]


def merged(members: Members, new: Members) -> Members:
    """Return a model with further effects or other values, without those that change nothing."""
    by_key = {hypothesis.key: (hypothesis, values) for hypothesis, values in members}
    for hypothesis, values in new:
        by_key[hypothesis.key] = (hypothesis, values)
    return tuple(
        (hypothesis, values)
        for hypothesis, values in by_key.values()
        if not hypothesis.is_nothing(values)
    )


def title_of(members: Members) -> str:
    """Return the names of the effects, for progress and notes."""
    return "+".join(hypothesis.name for hypothesis, _ in members)
