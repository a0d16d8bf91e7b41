"""Verdict of a diagnosis: one of six, with a sentence and the next useful measurement."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from scipy.special import chdtrc

from ugat_marl.diagnosis.features import ALL_FEATURES, DetectorLayout
from ugat_marl.diagnosis.hypotheses import WINDOW, Hypothesis, Members, keys_of
from ugat_marl.diagnosis.measurement import DetectorError
from ugat_marl.diagnosis.places import one_behind_the_other
from ugat_marl.diagnosis.records import (
    Conclusion,
    EffectRecord,
    Fitted,
    Located,
    Parameter,
    Pattern,
    Selected,
    Verified,
)
from ugat_marl.diagnosis.select import Selector
from ugat_marl.diagnosis.study import DiagnosisConfig, Study
from ugat_marl.effects import Effect, NumberParameter, known_effects
from ugat_marl.errors import counted, joined

NOUNS = {"swapped": "swapped detectors", "stuck": "a stuck detector"}
"""Nouns for effects whose names are no nouns, for sentences."""

LEAST_Z = 0.05
"""Smallest standardised difference for which periods are counted: beyond some thousand periods the
number says no more."""

UNEXPLAINED = "Simulation and measurement disagree, and no effect of the library explains it"


def conclude(
    located: Located,
    selection: Selected,
    selector: Selector,
    verification: Verified,
    config: DiagnosisConfig,
    layout: DetectorLayout,
    *,
    held_out: bool = True,
) -> Conclusion:
    """Draw the conclusion of a search.

    Args:
        located: Comparison of the scenario as it is with the data.
        selection: Result of the search.
        selector: The search, which also tests rivals.
        verification: Tests on the held-out periods.
        config: Level of the tests and numbers of the method.
        layout: Lanes and detectors.
        held_out: False if no period is held out, and the fitted ones were tested twice.
    """
    base, best = located.base, selection.best
    alpha, thresholds = config.alpha, config.thresholds
    confirmed = verification.gain >= thresholds.confirmed
    chance = base.residual.p
    if held_out:
        chance = combined(chance, verification.before.p)
    if chance > alpha and not confirmed and selection.complete:
        sentence = (
            f"The fitted periods hint at something (p = {base.residual.p:.2g}), but the held-out "
            f"periods do not: together nothing unusual (p = {chance:.2g})."
        )
        return Conclusion("no_discrepancy", base, (), sentence, "more periods")
    if not selection.complete:
        return unverified(selection, verification)
    if not best.model.members:
        sentence = f"{UNEXPLAINED}; the first places below say where to look."
        return Conclusion("unknown", best, (), sentence, _look_at(selection))
    names = describe_members(best.model.members)
    shrink = verification.shrink if verification.shrink is not None else 0.0
    chance_only = verification.after.p > alpha and best.residual.p > thresholds.fit_level
    if not confirmed:
        sentence = (
            f"The fitted periods hint at {names}, but the held-out periods do not confirm it."
            if held_out
            else f"The periods hint at {names}, but a simulation with that is hardly nearer."
        )
        return Conclusion("unknown", best, (), sentence, "more periods")
    if chance_only:
        return _sufficient(selection, selector, config, layout)
    if shrink >= thresholds.part:
        verb = "explains" if len(best.model.members) == 1 else "explain"
        sentence = (
            f"{capitalised(names)} {verb} {100 * shrink:.0f} % of the gap; "
            "something else remains that the library does not have."
        )
        return Conclusion("partially_explained", best, (), sentence, _look_at(selection))
    return Conclusion("unknown", best, (), f"{UNEXPLAINED}.", _look_at(selection))


def unchallenged(
    study: Study, located: Located, verification: Verified, timing: Sequence[Effect]
) -> Conclusion:
    """Conclude that the scenario as it is could have made the fitted periods.

    If the held-out periods contradict it, the verdict is "unknown".

    Args:
        study: The data, what they cannot show, and the errors of measurement.
        located: Comparison of the scenario as it is with the data.
        verification: Tests on the held-out periods; not used if no period is held out.
        timing: Effects that are read off the signal log.
    """
    ruled_out, detection = study.ruled_out, study.detection
    blind = f"; {counted(len(ruled_out), 'effect')} could not be examined" if ruled_out else ""
    sentence = f"Nothing in the data contradicts the scenario as it is{blind}."
    known = [f"the signal log has {' and '.join(map(str, timing))}"] if timing else []
    known += [describe_errors(detection)] if detection else []
    if known:
        sentence = f"{capitalised('; '.join(known))}; with that, nothing contradicts the scenario."
    p = verification.before.p if study.measured.of("heldout") else 1.0
    if p < study.config.thresholds.fit_level:
        sentence = capitalised(
            "; ".join(
                [
                    *known,
                    "the scenario agrees with the fitted periods, but not with the held-out ones "
                    f"(p = {p:.2g}): did something change between them?",
                ]
            )
        )
        wanted = "what differs between the fitted and the held-out periods"
        return Conclusion("unknown", located.base, (), sentence, wanted)
    if not located.complete:
        sentence += (
            " That is provisional: the budget ended before single effects were looked for. Run the "
            "same command again to go on."
        )
        return Conclusion("provisional", located.base, (), sentence, None)
    verdict = "explained" if timing or detection else "no_discrepancy"
    return Conclusion(verdict, located.base, (), sentence, None)


def unverified(selected: Selected, verified: Verified | None = None) -> Conclusion:
    """Conclude if the budget ended before the search did.

    Args:
        selected: The search so far.
        verified: Tests on the held-out periods; None if there was no budget for them.
    """
    members = selected.best.model.members
    if members:
        shrink = None if verified is None else verified.shrink
        gone = ""
        if shrink is not None and shrink > 0:
            gone = f", which takes off {100 * shrink:.0f} % of the gap"
        elif shrink is not None:
            gone = ", which brings the held-out periods no nearer"
        named = f"{describe_members(members)}{gone}"
        nearest = f"The nearest explanation so far, not verified, is {named}."
    elif any(rival.members for rival in selected.rivals):
        nearest = "No effect that was tried so far explains it."
    else:
        nearest = "No effect has been tried yet."
    sentence = (
        "Simulation and measurement disagree; the budget ended before the search did. "
        f"{nearest} Run the same command again to go on."
    )
    return Conclusion("provisional", selected.best, (), sentence, None)


def _sufficient(
    selection: Selected, selector: Selector, config: DiagnosisConfig, layout: DetectorLayout
) -> Conclusion:
    """Conclude if the selected set of effects leaves no more than chance."""
    best = selection.best
    names = describe_members(best.model.members)
    if ends := _at_an_end(best.model.members):
        sentence = (
            f"With {names} what is left is no more than chance, but {ends} is as far as the "
            "effect goes: something else may be behind it."
        )
        return Conclusion("partially_explained", best, (), sentence, _look_at(selection))
    if counters := one_behind_the_other(best.model.members, layout):
        first, behind = counters
        sentence = f"The data fit {names} and vehicles that leave the road equally well."
        return Conclusion(
            "not_identifiable", best, (), sentence, f"video of {first} and {behind}: do they "
            "miss vehicles, or is there a driveway or car park that the network lacks?",
        )  # fmt: skip
    rivals = _rivals(selection, selector, config)
    if rivals:
        others = "; or ".join(describe_members(rival.members) for rival in rivals)
        sentence = f"The data fit either equally well: {names}; or {others}."
        return Conclusion(
            "not_identifiable",
            best,
            rivals,
            sentence,
            _separating(best.model, rivals[0], selector.held, config.thresholds.deciding_z, layout),
        )
    them = "it" if len(best.model.members) == 1 else "them"
    sentence = f"The street has {names}; with {them}, what is left is no more than chance."
    return Conclusion("explained", best, (), sentence, None)


def combined(one: float, other: float) -> float:
    """Return the p value of two tests (Fisher 1932), taken for independent.

    Fitted and held-out periods are. Both are compared with the same simulated days, whose errors
    they share; these are small beside the noise of a few periods.

    -2 ln(p q) has a chi-square distribution with 4 degrees of freedom.
    """
    product = max(one * other, 1e-300)
    return float(chdtrc(4, -2.0 * math.log(product)))


def _rivals(selection: Selected, selector: Selector, config: DiagnosisConfig) -> tuple[Fitted, ...]:
    """Find other sets of effects, or places, that leave only chance at nearly the same cost."""
    best = selection.best.model
    keys = keys_of(best.members)
    sufficient: list[Fitted] = []
    near = [
        rival
        for rival in selection.rivals
        if len(rival.members) <= len(best.members)
        and not keys_of(rival.members) >= keys
        and selector.worse_by(rival, best) < config.thresholds.indistinct
    ]
    for rival in near[: config.thresholds.rivals_tested]:
        tested = selector.test(rival)
        # Costs of the search are of fewer days; now both models have many.
        near_still = tested.model.cost - best.cost < config.thresholds.indistinct
        if tested.residual.p > config.alpha and near_still:
            sufficient.append(tested.model)
    return tuple(sufficient)


def _at_an_end(members: Members) -> str:
    """Describe values at an end of their plausible range; natural limits such as 0 do not count."""
    texts: list[str] = []
    for hypothesis, values in members:
        ranges = known_effects()[hypothesis.name].ranges
        for name, value in zip(hypothesis.free, values, strict=True):
            natural = {0.0, 1.0} if not ranges[name].unit else {0.0}
            if value in {ranges[name].low, ranges[name].high} - natural:
                texts.append(f"{hypothesis.name.replace('_', ' ')} of {value:g}")
    return " and ".join(texts)


def _look_at(selection: Selected) -> str | None:
    """Suggest a measurement where most is left; None if no statistic of the network is known."""
    z = selection.best.model.distance.z["network"][0]
    strongest = [ALL_FEATURES[int(i)][:2] for i in np.argsort(-np.abs(z))[:3] if z[int(i)]]
    if not strongest:
        return None
    told = ", ".join(f"{statistic(name)} ({regime})" for name, regime in strongest)
    return f"trajectories or video where most is left over: {told}"


_SOURCES = {"volume": "counts", "occupancy": "occupancies", "mean speed": "mean speeds"}
"""Data that hold the statistics of a regime; the others need detections of single vehicles."""


def _separating(
    best: Fitted, rival: Fitted, held: Collection[int], deciding_z: float, layout: DetectorLayout
) -> str:
    """Name the statistic in which two models differ most, and the number of periods to decide.

    A single lane is named if it tells them apart twice as well as the network as a whole.

    Args:
        best: A model.
        rival: Another model.
        held: Indices of the statistics that the data hold.
        deciding_z: Standardised difference that would decide.
        layout: Lanes and detectors.
    """
    largest, index, lane = 0.0, 0, ""
    for name in ("network", "lane"):
        block, other = best.reference.blocks[name], rival.reference.blocks[name]
        difference = np.where(block.used, block.mean - other.mean, 0.0)
        z = np.abs(np.nan_to_num(difference / np.sqrt(block.variance)))
        member, feature = np.unravel_index(int(np.argmax(z)), z.shape)
        if z[member, feature] > 2.0 * largest:  # of many lanes some one differs by chance
            largest, index = float(z[member, feature]), int(feature)
            lane = "" if name == "network" else f" on lane {layout.places[member][2]}"
    if largest < LEAST_Z:
        return "other data: over whole periods no statistic of these detectors tells them apart"
    feature_name, regime, _ = ALL_FEATURES[index]
    periods = int(np.ceil((deciding_z / largest) ** 2))
    many = "one period" if periods == 1 else f"{periods} periods"
    source = "" if index in held else f" of {_SOURCES.get(regime, 'detections of single vehicles')}"
    return (
        f"{statistic(feature_name)} ({regime}){lane} differs most between them: about "
        f"{many}{source} would decide"
    )


def describe_members(members: Members) -> str:
    """Describe effects by name, place, window and values."""
    return joined([describe_effect(hypothesis, values) for hypothesis, values in members])


def describe_effect(hypothesis: Hypothesis, values: tuple[float, ...]) -> str:
    """Describe one effect by name, place, window and values."""
    place, window = place_and_window(hypothesis)
    ranges = known_effects()[hypothesis.name].ranges
    text = NOUNS.get(hypothesis.name, hypothesis.name.replace("_", " "))
    if place and place != "*":
        text += "" if hypothesis.name == "driver_model" else " at"
        text += f" {place.replace('>', ' → ')}"
    if window:
        text += f" from {clock(window[0])} to {clock(window[1])}"
    nominal = hypothesis.nothing or (0.0,) * len(values)
    for name, value, present in zip(hypothesis.free, values, nominal, strict=True):
        text += amount(name, value, ranges[name].unit)
        if present and name not in ("factor", "share"):
            text += f" (scenario: {present:.3g})"
    return text


def describe_errors(errors: Sequence[DetectorError]) -> str:
    """Describe errors of measurement as a part of a sentence, such as ``all detectors ...``."""
    return joined([describe_error(error.effect, error.rival) for error in errors])


def describe_error(error: Effect, rival: Effect | None = None) -> str:
    """Describe one error of measurement, or two that look the same, and the detectors."""
    values = error.record()
    kind, _, edge = str(values["place"]).partition("@")
    noun = {"*": "all detectors"}.get(kind, f"{kind} detectors")
    said = f"{noun}{f' of approach {edge}' if edge else ''} {error.in_words()}"
    return f"{said}, or {rival.in_words()} (here both look the same)" if rival else said


def capitalised(text: str) -> str:
    """Return a text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def place_and_window(
    hypothesis: Hypothesis,
) -> tuple[str | None, tuple[float, float] | None]:
    """Return the place of an effect and its window in s; None if it has none.

    The place joins all fixed texts by ``>``.
    """
    fixed = dict(hypothesis.fixed)
    texts = [value for value in fixed.values() if isinstance(value, str)]
    begin, end = (fixed.get(key) for key in WINDOW)
    window = None if begin is None or end is None else (float(begin), float(end))
    return (">".join(texts) if texts else None), window


def effect_record(
    hypothesis: Hypothesis, values: tuple[float, ...], margins: tuple[float, ...] | None = None
) -> EffectRecord:
    """Return the record of an effect, with 95 % intervals of its values if their margins are given.

    Args:
        hypothesis: The effect with its fixed fields.
        values: Values of its free fields.
        margins: Half widths of the intervals of these values.
    """
    place, window = place_and_window(hypothesis)
    ranges = known_effects()[hypothesis.name].ranges
    parameters: dict[str, Parameter] = {}
    for index, (name, value) in enumerate(zip(hypothesis.free, values, strict=True)):
        margin = None if margins is None else margins[index]
        parameters[name] = parameter(value, margin, ranges[name])
    for name, value in hypothesis.fixed:
        if not isinstance(value, str) and name not in WINDOW:
            parameters[name] = parameter(value, None, ranges[name])
    return EffectRecord(hypothesis.name, place, window, parameters)


def parameter(value: float, margin: float | None, allowed: NumberParameter) -> Parameter:
    """Return the record of a number of an effect, with its 95 % interval within its range.

    Args:
        value: The number.
        margin: Half the width of the interval; None without an interval.
        allowed: Range and unit of the number.
    """
    if margin is None:
        return Parameter(value, None, None, allowed.unit)
    low, high = max(value - margin, allowed.low), min(value + margin, allowed.high)
    return Parameter(value, low, high, allowed.unit)


# --- patterns -------------------------------------------------------------------------------------

_MOVEMENTS = {"s": "through lanes", "l": "left-turn lanes", "r": "right-turn lanes"}


def describe_pattern(pattern: Pattern) -> str:
    """Describe a pattern in what is left as one sentence, without its full stop."""
    where, one = _whereabouts(pattern)
    percent = f"{100 * abs(pattern.change):.0f} %"
    more = pattern.change > 0
    if pattern.quantity == "count":
        kind = f"{pattern.detectors} detectors" if pattern.detectors else "the detectors"
        said = f"{kind} of {where} count {percent} {'more' if more else 'fewer'} vehicles"
    elif pattern.quantity == "free speed":
        who = "long vehicles" if pattern.long_vehicles else "free vehicles"
        said = f"{who} on {where} drive {percent} {'faster' if more else 'slower'}"
    else:
        who = f"long vehicles on {where} discharge"
        who = who if pattern.long_vehicles else f"{where} {'discharges' if one else 'discharge'}"
        said = f"{who} {percent} {'more' if more else 'less'}"
    when = ""
    if pattern.window is not None:
        when = f"from {clock(pattern.window[0])} to {clock(pattern.window[1])}, "
    return capitalised(when + said + _from_to(pattern))


def _whereabouts(pattern: Pattern) -> tuple[str, bool]:
    """Return the place of a pattern in words, and True if it is a single thing."""
    if pattern.movement in ("lane", "exit"):
        behind = " behind the intersection" if pattern.movement == "exit" else ""
        return f"lane {pattern.place}{behind}", True
    if pattern.movement is None:
        return (f"approach {pattern.place}", True) if pattern.place else ("all lanes", False)
    lanes = f"the {_MOVEMENTS.get(pattern.movement, 'lanes')}"
    return (f"{lanes} of {pattern.place}" if pattern.place else lanes), False


def _from_to(pattern: Pattern) -> str:
    """Return the limits of a pattern in the queue and in green as phrases."""
    phrases: list[str] = []
    if pattern.vehicles is not None:
        first, last = pattern.vehicles
        phrases += [f" from vehicle {first:.0f} of the queue on"] if first is not None else []
        phrases += [f" up to vehicle {last:.0f} of the queue"] if last is not None else []
    if pattern.green_s is not None:
        first, last = pattern.green_s
        phrases += [f" after {first:.0f} s of green"] if first is not None else []
        phrases += [f" in the first {last:.0f} s of green"] if last is not None else []
    return "".join(phrases)


# --- words ----------------------------------------------------------------------------------------

STATISTICS = {
    "lost": "green begins until 1st queued vehicle is across",
    "lost_trend": "time to cross of 1st: change over the period",
    "gap2": "gap, 1st to 2nd queued vehicle",
    "gap3": "gap, 2nd to 3rd",
    "gap4-5": "gaps before 4th and 5th",
    "gap6-8": "gaps before 6th to 8th",
    "gap9+": "gaps before 9th and later",
    "gap_spread": "distance of queue gaps from 2 s",
    "gap_short": "share of queue gaps below 1.7 s",
    "gap_long": "share of queue gaps above 2.6 s",
    "gap_permitted": "queue gaps where green yields",
    "speed1": "speed of 1st queued vehicle",
    "speed2": "speed of 2nd queued vehicle",
    "speed3": "speed of 3rd queued vehicle",
    "speed4-5": "speed of 4th and 5th",
    "speed6-8": "speed of 6th to 8th",
    "over1": "time over detector, 1st, from green",
    "over2-3": "time over detector, 2nd and 3rd",
    "over4+": "time over detector, 4th and later",
    "queued": "share of greens that begin with a queue",
    "discharged": "queued vehicles per green",
    "platoon_gap": "gap in moving platoons",
    "platoon_short": "share of platoon gaps below 1.6 s",
    "platoon_middle": "share of platoon gaps below 2.2 s",
    "platoon_time": "time over detector in platoons",
    "free_speed": "free speed",
    "free_speed_spread": "distance of free speeds from the limit",
    "free_fast": "share of free vehicles 5 % above the limit",
    "free_time": "time over detector, free vehicles",
    "red_speed": "speed of those who approach red",
    "red_slow": "share of slow ones who approach red",
    "red_time": "time over detector, approaching red",
    "yellow_crossings": "vehicles per yellow",
    "late_crossings": "vehicles per change, first 2 s of red",
    "red_crossings": "vehicles per change, later in red",
    "last_crossing": "crossings after green: how late",
    "vehicle_length": "length of vehicles",
    "long_vehicles": "share of vehicles above 8 m",
    "occupied_in_red": "advance detector occupied in red",
    "occupied_in_green": "advance detector occupied in green",
    "queue_over": "share of greens with queue on advance detector",
    "count_advance": "flow at advance detectors",
    "count_stop": "flow at stop detectors",
    "count_exit": "flow at exit detectors",
    "kept_to_stop": "vehicles at stop per vehicle at advance",
    "kept_to_exit": "vehicles at exit per vehicle at stop",
    "occupied": "occupied time of advance detector",
    **{
        f"{name}_{kind}": text.format(f"{kind} detectors")
        for kind in ("advance", "stop", "exit")
        for name, text in (
            ("over", "occupied time per vehicle at {}"),
            ("mean_speed", "mean speed at {}"),
            ("busy_count", "vehicles per interval when {} are occupied"),
            ("busy_speed", "mean speed when {} are occupied"),
            ("bunching", "bunching of vehicles at {}"),
        )
    },
}
"""Descriptions of the statistics; names of statistics in bins of time end with " in time"."""


def statistic(name: str) -> str:
    """Return the description of a statistic; its name if there is no description."""
    base = name.removesuffix(" in time")
    return STATISTICS.get(base, base) + (" in some stretch of time" if base != name else "")


def clock(seconds: float) -> str:
    """Return a time of the scenario's clock as h:mm:ss."""
    whole = round(seconds)
    sign, whole = ("-" if whole < 0 else ""), abs(whole)
    return f"{sign}{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def amount(field: str, value: float, unit: str) -> str:
    """Return a value as text behind the name of an effect: `` of 1.4 s``, `` × 0.8``."""
    if field == "factor":
        return f" × {value:.3g}"
    if field == "share":
        return f" of {100 * value:.3g} %"
    text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f" of {text} {unit.replace('^2', '²')}".rstrip()
