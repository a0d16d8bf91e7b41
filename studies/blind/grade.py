"""Grades of diagnosed cases against their labels (docs/explanation/blind-tests.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from studies.blind.cases import (
    DIAGNOSIS,
    GRADES,
    RUN,
    SCHEMA,
    VISIBLE,
    Hidden,
    Label,
    read_json,
    read_label,
    read_plan,
)
from studies.blind.strengths import ALL_KINDS, ERRORS
from studies.errors import BlindTestError
from ugat_marl.diagnosis import (
    Alternative,
    Diagnosis,
    EffectRecord,
    LogGrounds,
    NamedEffect,
    PolicyGap,
    Verdict,
)
from ugat_marl.effects import EVERYWHERE
from ugat_marl.files import write_whole

GradedVerdict = Verdict | Literal["failed"]
Outcome = Literal["right", "missed", "wrong", "abstained", "failed"]

SEEN = 3.2
"""Standard deviations of a visible effect: a two-sided level of 5 % shared by 32 effects."""

NAMING: frozenset[GradedVerdict] = frozenset({"explained", "partially_explained"})
"""Verdicts that name the effects."""

OPTIONAL = frozenset({"emergency_deceleration"})
"""Hidden effects that need not be named, because usual driving does not show them."""

WEAK_STARTUP_S = 0.5
"""Below this, a start-up delay beside other effects need not be named (V3 has 0.25 s)."""

WHOLE = 0.95
"""Share of the period from which on a window counts as the whole period."""


@dataclass(frozen=True)
class Estimate:
    """One parameter of an effect that was named at the right place.

    Attributes:
        effect: Name of the effect.
        parameter: Field of the effect.
        true: Hidden value.
        value: Value that the diagnosis found.
        relative: ``|value - true| / |true|``; None if the hidden value is 0.
        of_effect: ``|value - true| / |true - nominal|``; None without a different nominal value.
        inside: True if the interval holds the hidden value; None without an interval.
    """

    effect: str
    parameter: str
    true: float
    value: float
    relative: float | None
    of_effect: float | None
    inside: bool | None


@dataclass(frozen=True)
class Grade:
    """Grade of one diagnosed case.

    Attributes:
        case: Id of the case.
        scenario: Name of the scenario.
        group: Group of the hidden effects.
        hidden: Name of the hidden effects.
        strength: Strength of the hidden effects.
        periods: Number of periods.
        speeds: True if speeds were measured.
        lights: Number of traffic lights.
        verdict: Verdict of the diagnosis.
        named: Effects that the diagnosis names.
        outcome: Judgement of the diagnosis: right, wrong, missed, abstained or failed.
        among: True if the right names are among alternatives that the diagnosis cannot tell apart.
        found: Share of the hidden effects that the diagnosis names.
        confident_wrong: True if the verdict is "explained" but a name or place is wrong.
        place_right: True if all places are right; None without places, or if a name is wrong.
        window_iou: Intersection of the windows over their union; None without windows, or if a name
            is wrong.
        estimates: Parameters of effects named at the right place.
        shrink: Share of the held-out gap that the diagnosis removes.
        policy_shrink: Share of the policy gap that the diagnosis removes.
        wall_s: Wall seconds of the diagnosis.
        visible: True if a test that knows the effect sees it, or the log of the signals shows it;
            None if this was not tested.
        blamed: Effects on traffic or signals that are named, though only detectors are wrong.
        day_to_day: Variation of the demand from day to day, as a share.
    """

    case: str
    scenario: str
    group: str
    hidden: str
    strength: str
    periods: int
    speeds: bool
    lights: int
    verdict: GradedVerdict
    named: tuple[str, ...]
    outcome: Outcome
    among: bool
    found: float
    confident_wrong: bool
    place_right: bool | None
    window_iou: float | None
    estimates: tuple[Estimate, ...]
    shrink: float | None
    policy_shrink: float | None
    wall_s: float | None
    visible: bool | None = None
    blamed: tuple[str, ...] = ()
    day_to_day: float = 0.0

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Grade:
        """Read from JSON."""
        values = dict(raw)
        values["named"] = tuple(raw["named"])
        values["blamed"] = tuple(raw.get("blamed", ()))
        values["estimates"] = tuple(Estimate(**item) for item in raw["estimates"])
        return cls(**values)


def grade_cases(directory: Path) -> tuple[Grade, ...]:
    """Grade every case with a finished or failed diagnosis, and write the grades.

    The labels of other cases are not read.

    Raises:
        BlindTestError: The directory holds no blind test, or a diagnosis is damaged.
    """
    grades: list[Grade] = []
    seen = directory / VISIBLE
    judged = read_json(seen)["cases"] if seen.exists() else {}
    for case in read_plan(directory):
        folder = directory / case.case
        run = read_json(folder / RUN) if (folder / RUN).exists() else {}
        if (folder / DIAGNOSIS).exists():
            diagnosis = _read_diagnosis(folder)
        elif run.get("error"):
            diagnosis = None
        else:
            continue
        graded = grade(read_label(directory, case.case), diagnosis, run.get("wall_s"))
        if case.case in judged:
            deviations = _number(judged[case.case])
            graded = replace(graded, visible=deviations is None or deviations >= SEEN)
        grades.append(graded)
    content = {"schema": SCHEMA, "grades": [asdict(each) for each in grades]}
    write_whole(directory / GRADES, json.dumps(content, indent=1, allow_nan=False) + "\n")
    return tuple(grades)


def _read_diagnosis(folder: Path) -> Diagnosis:
    try:
        return Diagnosis.read(folder)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise BlindTestError(f"{folder / DIAGNOSIS}: not a diagnosis ({reason})") from None


def read_grades(directory: Path) -> tuple[Grade, ...]:
    """Read the grades of a blind test.

    Raises:
        BlindTestError: The file is missing or damaged.
    """
    path = directory / GRADES
    try:
        return tuple(Grade.from_dict(item) for item in read_json(path)["grades"])
    except (KeyError, TypeError) as error:
        raise BlindTestError(
            f"{path}: not grades ({error}); run python -m studies.blind grade"
        ) from None


def grade(label: Label, diagnosis: Diagnosis | None, wall_s: float | None = None) -> Grade:
    """Compare a diagnosis with the truth.

    Args:
        label: Truth about the case.
        diagnosis: The diagnosis; None if it failed.
        wall_s: Wall seconds of the diagnosis.
    """
    verdict: GradedVerdict = "failed" if diagnosis is None else diagnosis.verdict
    effects = () if diagnosis is None else diagnosis.effects
    named = canonical(map(hidden_of, effects), label)
    truth = canonical(label.effects, label)
    others = [
        canonical(map(hidden_of, other.effects), label)
        for other in (() if diagnosis is None else _as_near(diagnosis))
    ]
    sets = [{effect.name for effect in answer} for answer in (named, *others)]
    sets += _with_rivals(sets[0], effects)
    required, allowed = required_and_allowed(label, truth)
    fits = [required <= names <= allowed for names in sets]
    outcome = _outcome(label, verdict, sets, fits)
    hidden = label.group not in ("none", "outside")
    names_right = hidden and verdict in NAMING and fits[0]
    matched = [(x, match(x, named)) for x in truth] if names_right else []
    place_right, window_iou = _where(matched, named, truth)
    return Grade(
        case=label.case,
        scenario=label.scenario,
        group=label.group,
        hidden=label.hidden,
        strength=label.strength,
        periods=label.periods,
        speeds=label.speeds,
        lights=len(label.lights),
        verdict=verdict,
        named=tuple(sorted(sets[0])) if verdict not in ("no_discrepancy", "failed") else (),
        outcome=outcome,
        among=outcome == "abstained" and hidden and any(fits),
        found=len(required & sets[0]) / len(required) if required and verdict in NAMING else 0.0,
        confident_wrong=verdict == "explained" and (outcome == "wrong" or place_right is False),
        place_right=place_right,
        window_iou=window_iou,
        estimates=tuple(
            estimate
            for true, same in matched
            if same is not None
            for estimate in _estimates(true, effects, same, label)
        ),
        shrink=None if diagnosis is None or diagnosis.heldout is None else diagnosis.heldout.shrink,
        policy_shrink=None if diagnosis is None else _policy_shrink(diagnosis.policy_gap or {}),
        wall_s=_number(wall_s),
        blamed=_blamed(label, verdict, sets),
        day_to_day=label.day_to_day,
    )


def _as_near(diagnosis: Diagnosis) -> list[Alternative]:
    """Return the alternatives that a diagnosis cannot tell from what it names.

    The others, and those of other verdicts, were tried and not named.
    """
    if diagnosis.verdict != "not_identifiable":
        return []
    return [other for other in diagnosis.alternatives if other.indistinct]


def _with_rivals(names: set[str], effects: Sequence[NamedEffect]) -> list[set[str]]:
    """Return the names with another error of detectors that is said to look the same."""
    rivals = [
        (effect.name, effect.evidence.rival.partition("=")[0])
        for effect in effects
        if isinstance(effect.evidence, LogGrounds) and effect.evidence.rival is not None
    ]
    return [(names - {name}) | {rival} for name, rival in rivals]


def _blamed(label: Label, verdict: GradedVerdict, sets: Sequence[set[str]]) -> tuple[str, ...]:
    """Return what is named beside detectors where nothing but a measurement is wrong."""
    if label.group != "measurement" or verdict in ("no_discrepancy", "failed"):
        return ()
    of_detectors = {name for name, kind in ALL_KINDS.items() if kind.family == "detectors"}
    return tuple(sorted(set().union(*sets) - of_detectors - set(ERRORS)))


def _outcome(
    label: Label,
    verdict: GradedVerdict,
    sets: Sequence[set[str]],
    fits: Sequence[bool],
) -> Outcome:
    if verdict == "failed":
        return "failed"
    if label.group == "none":
        if verdict == "no_discrepancy":
            return "right"
        return "wrong" if any(sets) or verdict == "explained" else "abstained"
    if verdict == "no_discrepancy":
        return "missed"
    if label.group == "outside":
        return "wrong" if verdict == "explained" else "abstained"
    if verdict not in NAMING:
        return "abstained"
    if fits[0]:
        return "right"
    return "abstained" if any(fits) else "wrong"


def _where(
    matched: Sequence[tuple[Hidden, Hidden | None]],
    named: Sequence[Hidden],
    truth: Sequence[Hidden],
) -> tuple[bool | None, float | None]:
    """Return whether all places are right and no other is named, and the overlap of windows."""
    windows = [
        _overlap(item.window, other.window)
        for item, same in matched
        if item.window is not None and (other := same or same_name(item.name, named)) is not None
    ]
    place_right = None
    if any(item.place for item, _ in matched):
        extra = any(match(item, truth) is None for item in named)
        place_right = not extra and all(same is not None for item, same in matched if item.place)
    return place_right, sum(windows) / len(windows) if windows else None


def _overlap(one: tuple[float, float] | None, two: tuple[float, float] | None) -> float:
    """Return the intersection over union of two windows."""
    if one is None or two is None:
        return 0.0
    inside = max(min(one[1], two[1]) - max(one[0], two[0]), 0.0)
    return inside / (max(one[1], two[1]) - min(one[0], two[0]))


def _estimates(
    truth: Hidden, effects: Sequence[EffectRecord], same: Hidden, label: Label
) -> list[Estimate]:
    spelled = (x.parameters for x in effects if canonical_effect(hidden_of(x), label) == same)
    numbers = next(spelled, {})
    estimates: list[Estimate] = []
    for key, true in truth.parameters.items():
        if key not in same.parameters:
            continue
        value = same.parameters[key]
        nominal = truth.nominal.get(key)
        low, high = (numbers[key].low, numbers[key].high) if key in numbers else (None, None)
        estimates.append(
            Estimate(
                truth.name,
                key,
                true,
                value,
                abs(value - true) / abs(true) if true else None,
                abs(value - true) / abs(true - nominal)
                if nominal is not None and true != nominal
                else None,
                low <= true <= high if low is not None and high is not None else None,
            )
        )
    return estimates


def _policy_shrink(gaps: Mapping[str, PolicyGap]) -> float | None:
    """Return the share of the policy gap that the diagnosis removes, ``1 - |after| / |before|``.

    The mean is over trained policies (names with ``.pt`` or ``trained``); without any, over all
    policies.
    """
    visible = {policy: gap for policy, gap in gaps.items() if gap.before}
    trained = {k: v for k, v in visible.items() if ".pt" in k or "trained" in k}
    shrinks = [1 - abs(gap.after) / abs(gap.before) for gap in (trained or visible).values()]
    return sum(shrinks) / len(shrinks) if shrinks else None


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def required_and_allowed(
    label: Label, truth: Sequence[Hidden]
) -> tuple[frozenset[str], frozenset[str]]:
    """Return the names that a diagnosis must give, and those that it may give."""
    allowed = frozenset(item.name for item in truth)
    if label.group == "outside":
        return frozenset(), allowed
    required = allowed - OPTIONAL
    if label.group == "setting":
        weak = {
            item.name
            for item in truth
            if item.name == "startup_delay" and item.parameters["seconds"] < WEAK_STARTUP_S
        }
        required -= weak
    return required, allowed


def canonical(effects: Iterable[Hidden], label: Label) -> list[Hidden]:
    """Return effects in one spelling, so that descriptions of the same effect are equal."""
    found = [canonical_effect(item, label) for item in effects]
    kept: list[Hidden] = []
    for item in found:
        kind = ALL_KINDS.get(item.name)
        if kind is not None and kind.where == "light" and len(label.lights) > 1:
            same = [x for x in found if x.name == item.name]
            if {x.place for x in same} == set(label.lights):  # all lights are everywhere
                keys = item.parameters
                mean = {k: sum(x.parameters[k] for x in same) / len(same) for k in keys}
                item = replace(item, place=EVERYWHERE, parameters=mean)
        if item not in kept:
            kept.append(item)
    return kept


def canonical_effect(item: Hidden, label: Label) -> Hidden:
    """Return an effect in the spelling of `canonical`."""
    name, place, window, parameters = item.name, item.place, item.window, dict(item.parameters)
    if name == "demand_surge" and window is not None and _covers(window, label):
        name, window = "demand_level", None
    kind = ALL_KINDS.get(name)
    where = kind.where if kind else "everywhere"
    if where == "everywhere" and place in (None, EVERYWHERE):
        place = None
    if where in ("light", "origin", "detector") and place is None:
        place = EVERYWHERE
    if where == "light" and len(label.lights) == 1 and place == label.lights[0]:
        place = EVERYWHERE
    if where == "pair" and place is not None:
        place = ">".join(sorted(place.split(">")))
    return Hidden(name, place, window, parameters, item.nominal)


def _covers(window: tuple[float, float], label: Label) -> bool:
    inside = min(window[1], label.end_s) - max(window[0], label.begin_s)
    return inside >= WHOLE * (label.end_s - label.begin_s)


def hidden_of(effect: EffectRecord) -> Hidden:
    """Return an effect of a diagnosis in the form of a label, without intervals."""
    values = {name: parameter.value for name, parameter in effect.parameters.items()}
    return Hidden(effect.name, effect.place, effect.window, values, {})


def match(item: Hidden, others: Sequence[Hidden]) -> Hidden | None:
    """Return the effect of the same name at the same place."""
    return next((x for x in others if x.name == item.name and _same_place(x, item)), None)


def _same_place(one: Hidden, other: Hidden) -> bool:
    """Return True for equal places; a form that is said to be unknown contradicts no other one."""
    if one.place == other.place:
        return True
    parts = [item.place.rpartition(">") if item.place else ("", "", "") for item in (one, other)]
    return parts[0][0] == parts[1][0] and "unknown" in {form for _, _, form in parts}


def same_name(name: str, others: Sequence[Hidden]) -> Hidden | None:
    """Return the first effect of this name, at any place."""
    return next((x for x in others if x.name == name), None)
