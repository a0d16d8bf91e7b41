"""The words and numbers of a diagnosis, for its page and for the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from ugat_marl.diagnosis import (
    WINDOW,
    ApproachRow,
    CriteriaRow,
    DetectionLimit,
    Diagnosis,
    Disagreement,
    EffectRecord,
    Parameter,
    Sides,
    Thresholds,
    Verdict,
    clock,
    ordered,
)
from ugat_marl.effects import EVERYWHERE, Effect, known_effects
from ugat_marl.reporting.formats import chance, fixed, number, share
from ugat_marl.reporting.light_names import LightNames

UNTRIED = 8
"""Most effects that are named as not examined; of more, the text gives their number."""

VERDICTS: dict[Verdict, str] = {
    "no_discrepancy": "no discrepancy",
    "explained": "explained",
    "not_identifiable": "not identifiable",
    "partially_explained": "partially explained",
    "provisional": "provisional",
    "unknown": "unknown",
}

MEANINGS: dict[Verdict, str] = {
    "no_discrepancy": "The scenario as it is could have made these data. That does not say that it "
    "is right in what the data do not show.",
    "explained": "With these effects the simulation could have made the data they were judged "
    "on, and no other explanation of the library comes close.",
    "not_identifiable": "Several explanations fit equally well. Which one is true takes another "
    "measurement.",
    "partially_explained": "These effects take off most of the gap, and yet they are not the whole "
    "explanation. What is missing may bend their values.",
    "provisional": "The search has not ended. What is listed here comes nearest so far and is not "
    "verified.",
    "unknown": "Simulation and measurement disagree, and nothing in the library accounts for it. "
    "Any name would be a guess.",
}

LIMITS = (
    "With an effect of these values on the whole network, at least four of five data sets like the "
    "fitted periods would have contradicted the verdict. Nearer to the usual value it may be there "
    "and unseen."
)
"""Meaning of the detection limits."""

AT_AN_END = (
    "With these effects the simulation could have made the data they were judged on. But a value "
    "at the end of what is plausible often stands for something else."
)
"""Meaning of "partially_explained" where what is left is no more than chance."""


def meaning(diagnosis: Diagnosis) -> str:
    """Return the meaning of the verdict; "" if the search is not complete."""
    if not diagnosis.complete:
        return ""
    if diagnosis.verdict == "partially_explained" and _only_chance_is_left(diagnosis):
        return AT_AN_END
    text = MEANINGS[diagnosis.verdict]
    if diagnosis.verdict == "unknown" and diagnosis.effects:
        text += " What is listed here is read off the signals and detections themselves."
    if diagnosis.verdict == "not_identifiable" and diagnosis.corrected:
        text += " The corrected scenario holds the one listed here."
    return text


def _only_chance_is_left(diagnosis: Diagnosis) -> bool:
    """Return True if neither the fitted nor the held-out periods contradict the effects named."""
    fitted = None if diagnosis.evidence is None else diagnosis.evidence.p_fit_after
    heldout = None if diagnosis.heldout is None else diagnosis.heldout.p_after
    if fitted is None or heldout is None:
        return False
    return heldout > diagnosis.alpha and fitted > Thresholds().fit_level


def effect_name(effect: EffectRecord) -> str:
    """Return the name of an effect with spaces."""
    return effect.name.replace("_", " ")


def place(effect: EffectRecord, names: LightNames) -> str:
    """Return the place of an effect; a light with its agent."""
    where = effect.place
    if where in (None, "*", ""):
        return "everywhere"
    parts = ("everywhere" if part == "*" else names.text(part) for part in where.split(">"))
    return " → ".join(parts)


def window(span: tuple[float, float] | None) -> str:
    """Return start and end of a window on the scenario's clock; "" for None."""
    return "" if span is None else f"{clock(span[0])} – {clock(span[1])}"


def values(effect: EffectRecord, *, intervals: bool = True) -> str:
    """Return the parameters of an effect, with their intervals if wanted."""
    texts = [_parameter(name, value, intervals) for name, value in effect.parameters.items()]
    return "; ".join(texts) or "as such"


def has_interval(effect: EffectRecord) -> bool:
    """Return True if `values` shows an interval; an effect that was not tested has none."""
    return values(effect) != values(effect, intervals=False)


def as_domain(effects: Iterable[EffectRecord]) -> str:
    """Return effects as ``--domain`` takes them, such as ``headway=1.451+late_green=*,2``.

    They stand in the order in which a corrected scenario has them. Errors of detectors, which no
    agent sees, and effects of another version are left out.
    """
    kinds = known_effects()
    made = [_effect_of(kinds[effect.name], effect) for effect in effects if effect.name in kinds]
    return "+".join(map(str, ordered([effect for effect in made if not effect.on_detectors])))


def _effect_of(kind: type[Effect], effect: EffectRecord) -> Effect:
    """Return an effect with four digits of its values."""
    texts = dict(zip(kind.texts, (effect.place or EVERYWHERE).split(">"), strict=False))
    numbers: dict[str, float] = {}
    numbers.update(zip(WINDOW, effect.window or (), strict=False))
    for name, limits in kind.ranges.items():
        if name in effect.parameters:
            numbers[name] = limits.nearest(float(f"{effect.parameters[name].value:.4g}"))
    return kind(**texts, **numbers)


def _parameter(name: str, parameter: Parameter, intervals: bool) -> str:
    value, low, high = parameter.value, parameter.low, parameter.high
    unit = parameter.unit.replace("^2", "²")
    text = f"{name.removesuffix('_s').replace('_', ' ')} "
    text = "" if unit and name in ("seconds", "metres", "mps2", "seconds_per_hour") else text
    if not intervals or low is None or high is None or low == high:
        return f"{text}{number(value)} {unit}".rstrip()
    middle, low, high = (_rounded(x, high - low) for x in (value, low, high))
    return f"{text}{middle} {unit}".rstrip() + f" ({low} to {high})"


def _rounded(value: float, width: float) -> str:
    """Return a number rounded to two digits of its interval's width."""
    decimals = min(max(1 - math.floor(math.log10(max(width, 1e-9))), 0), 4)
    return f"{value:.{decimals}f}".replace("-", "−")


def limit_rows(limits: Sequence[DetectionLimit]) -> list[tuple[str, str, str]]:
    """Return effect, usual value, and where the data would show it; those that hide come first."""
    of_effects: dict[str, list[DetectionLimit]] = {}
    for limit in limits:
        of_effects.setdefault(limit.name, []).append(limit)

    def shown(sides: Sequence[DetectionLimit]) -> int:
        return sum(side.shown is not None for side in sides)

    rows: list[tuple[str, str, str]] = []
    for name, sides in sorted(of_effects.items(), key=lambda one: shown(one[1])):
        usual = f"{number(sides[0].usual)} {sides[0].unit.replace('^2', '²')}".rstrip()
        rows.append((name.replace("_", " "), usual, "; ".join(map(_limit, sides))))
    return rows


def _limit(side: DetectionLimit) -> str:
    """Return where an effect would show on one side of its usual value."""
    if side.shown is None:
        return f"not even {number(side.hidden)}"
    return f"{number(side.shown)} or {'less' if side.shown < side.usual else 'more'}"


def disagreement_place(disagreement: Disagreement, names: LightNames) -> str:
    """Return the narrowest known place of a disagreement: lane, approach or traffic light."""
    places = (disagreement.lane, disagreement.approach, disagreement.tls)
    return next((names.text(name) for name in places if name is not None), "all of the network")


def strongest(diagnosis: Diagnosis, count: int) -> list[Disagreement]:
    """Return the strongest disagreements, one per statistic."""
    first: dict[str, Disagreement] = {}
    ranked = sorted(diagnosis.where, key=lambda each: -abs(each.z))
    for disagreement in ranked:
        first.setdefault(disagreement.statistic, disagreement)
    return list(first.values())[:count]


def partial(diagnosis: Diagnosis) -> str | None:
    """Return the warning that a diagnosis is not complete; None if it is."""
    if diagnosis.complete:
        return None
    untried = diagnosis.untried
    more = f", … ({len(untried)} in all)" if len(untried) > UNTRIED else ""
    left = f" Not examined yet: {joined(untried[:UNTRIED])}{more}." if untried else ""
    return (
        f"Partial result: the budget of {diagnosis.ended_budget_in_words} ended before the search "
        f"did.{left} The same command goes on where this one stopped."
    )


TRAFFIC: tuple[tuple[str, Callable[[ApproachRow], Sides]], ...] = (
    ("capacity, veh/h per lane in green", lambda row: row.capacity),
    ("queue when green begins, vehicles", lambda row: row.queue),
    ("delay between the detectors, s", lambda row: row.delay),
)
"""Numbers of traffic of an approach, and how to find them in its row."""


def traffic_rows(
    rows: Iterable[ApproachRow], *, corrected: bool
) -> list[tuple[str, str, str, str, str]]:
    """Return approach, name, measured and simulated values of each number of traffic.

    Args:
        rows: Rows of the approaches.
        corrected: True if the corrected model is told too.
    """
    return [
        (
            row.approach,
            name,
            number(sides.measured),
            number(sides.before),
            number(sides.after) if corrected else "",
        )
        for row in rows
        for name, value in TRAFFIC
        if (sides := value(row)).measured is not None
    ]


def slowest(diagnosis: Diagnosis) -> list[ApproachRow]:
    """Return the approach whose measured delay differs most from the scenario as it is."""

    def apart(row: ApproachRow) -> float:
        measured, before = row.delay.measured, row.delay.before
        return -1.0 if measured is None or before is None else abs(measured - before)

    return sorted(diagnosis.approaches, key=apart)[-1:]


def traffic_check_line(diagnosis: Diagnosis) -> str | None:
    """Return a sentence on the check of held-out traffic; None without one."""
    check = diagnosis.traffic_check
    if check is None:
        return None
    nearer = "nearer" if check.better else "no nearer"
    if check.undecided:
        nearer = "nearer by no more than chance could do"
    unfitted = check.measure == "travel time and queue"
    apart = "that no fit used" if unfitted else "of periods that no fit used"
    if diagnosis.verified_on_fitted_periods:
        apart = "of the fitted periods, as none is held out"
    # The same decimals as in `not_corrected`, which may stand beside this.
    before, after = (fixed(100 * error, 1) for error in (check.error_before, check.error_after))
    what = "the unnamed correction" if diagnosis.unnamed else "the effects named"
    return (
        f"Simulated {check.measure} against data {apart}: sum of relative errors"
        f"{check.days_in_words} {before} % before {what} and {after} % after, {nearer}."
    )


def judged(diagnosis: Diagnosis) -> str:
    """Return the word for the periods on which the diagnosis is judged."""
    return "fitted" if diagnosis.verified_on_fitted_periods else "held-out"


def criteria_line(diagnosis: Diagnosis) -> str | None:
    """Return the usual criteria for the model as it is, beside our own; None without counts."""
    criteria, heldout = diagnosis.criteria, diagnosis.heldout
    if criteria is None or criteria.before.geh_below_5 is None:
        return None
    texts = [f"As it is, {judged(diagnosis)} periods: {_usual(criteria.before)}"]
    p_after = heldout.p_after if heldout is not None and heldout.shrink is not None else None
    if heldout is not None:
        texts[0] += f"; our test {_ours(heldout.p_before)}"
    if p_after is not None:
        texts.append(f"Corrected: {_usual(criteria.after)}; our test {_ours(p_after)}")
    contradicted = heldout is not None and heldout.p_before < OUR_LEAST_P
    if contradicted and criteria.before.geh_below_5 >= GEH_SHARE:
        texts.append("GEH does not see this gap")
    sides = [(criteria.before, heldout.p_before)] if heldout is not None else []
    if p_after is not None:
        sides.append((criteria.after, p_after))
    failed_alone = any(p >= OUR_LEAST_P and not all(_fhwa(row)) for row, p in sides)
    return f"{'. '.join(texts)}. {STRICTER}{f' {ONE_DAY}' if failed_alone else ''}"


GEH_SHARE = 0.85
"""Share of counts that should have a GEH below 5 (UK TAG unit M3.1)."""
OUR_LEAST_P = 0.01
"""Least chance of a difference as large as the measured one: the noise floor of a diagnosis."""
STRICTER = (
    "Ours is stricter than GEH, which sees how many vehicles pass, and drivers and signals hardly "
    "change that; ours also sees when they pass, in queues and from the stop line on."
)
ONE_DAY = (
    "FHWA holds the mean simulated day against the most typical measured one, whose own chance can "
    "fail a model; ours holds all days against it."
)


def _usual(row: CriteriaRow) -> str:
    """Return GEH and the number of FHWA's four criteria that are met."""
    below = row.geh_below_5
    text = f"GEH < 5 on {share(below)} of counts"
    if below is not None and below < GEH_SHARE and share(below) == share(GEH_SHARE):
        text = f"GEH < 5 on {100 * below:.2f} % of counts"
    if below is not None:
        text += f" ({'met' if below >= GEH_SHARE else 'not met'}, usual: {share(GEH_SHARE)})"
    met = _fhwa(row)
    if not met:
        return f"{text}, FHWA not known (it needs three whole days of counts at one time of day)"
    return f"{text}, FHWA {sum(met)} of {len(met)} criteria met"


def _fhwa(row: CriteriaRow) -> list[bool]:
    """Return which of FHWA's four criteria are met; empty if one is not known."""
    limits = (
        (row.within_2_sigma, 0.95),
        (row.within_1_sigma, 2 / 3),
        (row.absolute_error, 1.0),
        (row.systematic_error, 1.0),
    )
    met = [value >= least for value, least in limits if value is not None]
    return met if len(met) == len(limits) else []


def _ours(p: float) -> str:
    return f"{'met' if p >= OUR_LEAST_P else 'not met'}, p = {chance(p)}".replace("= <", "<")


def joined(names: Iterable[str]) -> str:
    """Return names as a list in a sentence."""
    return ", ".join(name.replace("_", " ") for name in names)
