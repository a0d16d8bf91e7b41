"""What can be said: one of five verdicts, in a sentence, with what would decide between rivals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ugat_marl.diagnosis.faults import one_behind_the_other
from ugat_marl.diagnosis.features import FEATURES
from ugat_marl.diagnosis.fit import Fitted, Members
from ugat_marl.diagnosis.hypotheses import WINDOW, Hypothesis
from ugat_marl.diagnosis.intervals import HALF_INTERVAL
from ugat_marl.diagnosis.residual import Tested
from ugat_marl.diagnosis.select import Selection, Selector
from ugat_marl.diagnosis.site import Site
from ugat_marl.diagnosis.verify import Verification
from ugat_marl.diagnosis.wording import amount, clock, listed, statistic
from ugat_marl.effects import known_effects

Verdict = Literal[
    "no_discrepancy", "explained", "not_identifiable", "partially_explained", "unknown"
]

INDISTINCT = 25.0
"""Models whose distances differ by less fit equally well: a likelihood ratio above e^12 either way
would be needed to drop one."""
RIVALS_TESTED = 2
FIT_LEVEL = 0.01
"""The fitted periods must not contradict the model more than this; the held-out ones decide."""
PART = 0.5
NOUNS = {"swapped": "swapped detectors", "stuck": "a stuck detector"}
"""Effects whose names are no nouns, in a sentence."""
CONFIRMED = 10.0
"""What the effects must take off the distance of the held-out periods."""


@dataclass(frozen=True, eq=False)
class Conclusion:
    """A verdict with its grounds.

    Attributes:
        verdict: Which.
        best: The model it speaks of.
        indistinct: Other models that fit as well.
        sentence: The verdict for people.
        next_measurement: What would tell the rivals apart, or show what is missing.
    """

    verdict: Verdict
    best: Tested
    indistinct: tuple[Fitted, ...]
    sentence: str
    next_measurement: str | None


def conclude(
    base: Tested,
    selection: Selection,
    selector: Selector,
    verification: Verification,
    alpha: float,
    site: Site,
) -> Conclusion:
    """Draws the conclusion of a search.

    Args:
        base: The test of the scenario as it is.
        selection: What was found.
        selector: Tests rivals.
        verification: The held-out periods.
        alpha: Level of the tests.
        site: Lanes and detectors.
    """
    best = selection.best
    confirmed = verification.before.distance - verification.after.distance >= CONFIRMED
    chance = combined(base.residual.p, verification.before.p)
    if chance > alpha and not confirmed and selection.complete:
        sentence = (
            f"The fitted periods hint at something (p = {base.residual.p:.2g}), but the held-out "
            f"periods do not: together nothing unusual (p = {chance:.2g})."
        )
        return Conclusion("no_discrepancy", base, (), sentence, "more periods")
    if not best.model.members:
        sentence = _unexplained(selection) + "; the first places below say where to look."
        return Conclusion("unknown", best, (), sentence, _look_at(selection))
    names = describe_members(best.model.members)
    shrink = verification.shrink if verification.shrink is not None else 0.0
    chance_only = verification.after.p > alpha and best.residual.p > FIT_LEVEL
    if not confirmed:
        sentence = (
            f"The fitted periods hint at {names}, but the held-out periods do not confirm it."
        )
        return Conclusion("unknown", best, (), sentence, "more periods")
    if chance_only and selection.complete:
        return _sufficient(selection, selector, alpha, site)
    if shrink >= PART:
        verb = "explains" if len(best.model.members) == 1 else "explain"
        sentence = f"{names[:1].upper()}{names[1:]} {verb} {100 * shrink:.0f} % of the gap; " + (
            "something else remains that the library does not have."
            if selection.complete
            else "the budget ended before the rest was examined."
        )
        return Conclusion("partially_explained", best, (), sentence, _look_at(selection))
    return Conclusion("unknown", best, (), _unexplained(selection) + ".", _look_at(selection))


def _sufficient(selection: Selection, selector: Selector, alpha: float, site: Site) -> Conclusion:
    """The conclusion where a set of effects leaves no more than chance."""
    best = selection.best
    names = describe_members(best.model.members)
    if ends := _at_an_end(best.model.members):
        sentence = (
            f"With {names} what is left is no more than chance, but {ends} is as far as the "
            "effect goes: something else may be behind it."
        )
        return Conclusion("partially_explained", best, (), sentence, _look_at(selection))
    if counters := one_behind_the_other(best.model.members, site):
        first, behind = counters
        sentence = f"The data fit {names} and vehicles that leave the road equally well."
        return Conclusion(
            "not_identifiable", best, (), sentence, f"video of {first} and {behind}: do they "
            "miss vehicles, or is there a driveway or car park that the network lacks?",
        )  # fmt: skip
    rivals = _rivals(selection, selector, alpha)
    if rivals:
        others = "; or ".join(describe_members(rival.members) for rival in rivals)
        sentence = f"The data fit either equally well: {names}; or {others}."
        return Conclusion(
            "not_identifiable", best, rivals, sentence, _separating(best.model, rivals[0])
        )
    them = "it" if len(best.model.members) == 1 else "them"
    sentence = f"The street has {names}; with {them}, what is left is no more than chance."
    return Conclusion("explained", best, (), sentence, None)


def _unexplained(selection: Selection) -> str:
    """That nothing was found, which only a search that came to its end says of the library."""
    if selection.complete:
        return "Simulation and measurement disagree, and no effect of the library explains it"
    return (
        "Simulation and measurement disagree; the budget ended before all effects were examined, "
        "and none so far explains it"
    )


def combined(one: float, other: float) -> float:
    """Chance of two independent tests as a whole (Fisher 1932)."""
    product = max(one * other, 1e-300)
    return product * (1.0 - math.log(product))


def _rivals(selection: Selection, selector: Selector, alpha: float) -> tuple[Fitted, ...]:
    """Other sets of effects that leave no more than chance and are hardly farther away."""
    best = selection.best.model
    names = _kinds(best.members)
    found: list[Fitted] = []
    near = [
        rival
        for rival in selection.rivals
        if len(rival.members) <= len(best.members)
        and not _kinds(rival.members) >= names
        and rival.cost - best.cost < INDISTINCT
    ]
    for rival in near[:RIVALS_TESTED]:
        tested = selector.test(rival)
        if tested.residual.p > alpha:
            found.append(rival)
    return tuple(found)


def _at_an_end(members: Members) -> str:
    """Values at an end of their range that is a bound of plausibility, not of the definition."""
    found: list[str] = []
    for hypothesis, values in members:
        ranges = known_effects()[hypothesis.name].ranges
        for name, value in zip(hypothesis.free, values, strict=True):
            natural = {0.0, 1.0} if not ranges[name].unit else {0.0}
            if value in {ranges[name].low, ranges[name].high} - natural:
                found.append(f"{hypothesis.name.replace('_', ' ')} of {value:g}")
    return " and ".join(found)


def _kinds(members: Members) -> set[str]:
    return {hypothesis.name for hypothesis, _ in members}


def _look_at(selection: Selection) -> str | None:
    """The regime in which most is left; as long as more time may explain it, no measurement."""
    if not selection.complete:
        return None
    z = selection.best.model.distance.z["network"][0]
    strongest = [FEATURES[int(i)][:2] for i in np.argsort(-np.abs(z))[:3] if z[int(i)]]
    told = ", ".join(f"{statistic(name)} ({regime})" for name, regime in strongest)
    return f"trajectories or video where most is left over: {told}"


def _separating(best: Fitted, rival: Fitted) -> str:
    """The statistic in which two models differ most, and how many periods would decide."""
    block, other = best.reference.blocks["network"], rival.reference.blocks["network"]
    difference = (block.mean - other.mean)[0]
    deviation = np.sqrt(block.variance[0])
    z = np.where(block.used[0], difference / deviation, 0.0)
    index = int(np.argmax(np.abs(z)))
    name, regime, _ = FEATURES[index]
    periods = int(np.ceil((5.0 / max(abs(float(z[index])), 0.05)) ** 2))
    many = "one period" if periods == 1 else f"{periods} periods"
    return f"{statistic(name)} ({regime}) differs most between them: about {many} would decide"


def describe_members(members: Members) -> str:
    """Effects in words: name, place, window, values."""
    return listed([describe_effect(hypothesis, values) for hypothesis, values in members])


def describe_effect(hypothesis: Hypothesis, values: tuple[float, ...]) -> str:
    """One effect in words."""
    place, window = place_and_window(hypothesis)
    ranges = known_effects()[hypothesis.name].ranges
    text = NOUNS.get(hypothesis.name, hypothesis.name.replace("_", " "))
    if place and place != "*":
        text += "" if hypothesis.name == "driver_model" else " at"
        text += f" {place.replace('>', ' → ')}"
    if window:
        text += f" from {clock(window[0])} to {clock(window[1])}"
    nominal = hypothesis.nominal or (0.0,) * len(values)
    for name, value, own in zip(hypothesis.free, values, nominal, strict=True):
        text += amount(name, value, ranges[name].unit)
        if own and name not in ("factor", "share"):
            text += f" (scenario: {own:.3g})"
    return text


def place_and_window(hypothesis: Hypothesis) -> tuple[str | None, list[float] | None]:
    """The texts of an effect joined, and its window."""
    fixed = dict(hypothesis.fixed)
    texts = [value for value in fixed.values() if isinstance(value, str)]
    window = [float(fixed[key]) for key in WINDOW] if set(WINDOW) <= set(fixed) else None
    return (">".join(texts) if texts else None), window


def effect_record(
    hypothesis: Hypothesis, values: tuple[float, ...], errors: tuple[float, ...]
) -> dict[str, Any]:
    """An effect for ``diagnosis.json``, with 95 % intervals of its numbers."""
    place, window = place_and_window(hypothesis)
    ranges = known_effects()[hypothesis.name].ranges
    parameters: dict[str, Any] = {}
    for name, value, error in zip(hypothesis.free, values, errors, strict=True):
        allowed = ranges[name]
        parameters[name] = {
            "value": value,
            "low": max(value - HALF_INTERVAL * error, allowed.low),
            "high": min(value + HALF_INTERVAL * error, allowed.high),
            "unit": allowed.unit,
        }
    for name, value in hypothesis.fixed:
        if not isinstance(value, str) and name not in WINDOW:
            unit = ranges[name].unit
            parameters[name] = {"value": value, "low": None, "high": None, "unit": unit}
    return {"name": hypothesis.name, "place": place, "window": window, "parameters": parameters}
