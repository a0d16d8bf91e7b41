"""Grades of the first stage alone: what is read off the detectors before any search.

The first stage takes seconds where a diagnosis takes minutes. So many cases can be drawn, also
those with other drivers and traffic, in which detectors are as stated. It opens the labels of all
cases: draw a set for it, and another one for whole diagnoses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from studies.blind.cases import Case, Hidden, chosen, read_label, read_street
from studies.blind.grade import canonical, match
from studies.blind.strengths import ERRORS
from studies.blind.table import wilson
from ugat_marl.diagnosis import DetectorError, DiagnosisConfig, Study
from ugat_marl.progress import Reporter, Silent

Outcome = Literal["invented", "wrong", "one of two", "missed", "right"]
OUTCOMES: tuple[Outcome, ...] = ("invented", "wrong", "one of two", "missed", "right")
"""The outcomes, the worst first."""


@dataclass(frozen=True)
class FirstStage:
    """Grade of the first stage in one case.

    Attributes:
        case: Id of the case.
        scenario: Name of its scenario.
        hidden: Hidden effects, as text.
        erring: True if an error of detectors is among them.
        named: Errors of detectors that were named, as texts of effects.
        outcome: `invented` if an error is named and none is hidden; `wrong` if another one is
            named; `one of two` if the right one is said to look the same; `missed` if nothing is
            named; `right`, also if nothing is hidden and nothing named.
        inside: For each number of an error named at the right place with an interval, True if the
            interval holds the hidden value.
    """

    case: str
    scenario: str
    hidden: str
    erring: bool
    named: tuple[str, ...]
    outcome: Outcome
    inside: tuple[bool, ...] = ()


def first_stages(
    directory: Path, *, only: Sequence[str] = (), seed: int = 0, reporter: Reporter | None = None
) -> tuple[FirstStage, ...]:
    """Read off the errors of detectors in every case, and compare them with the labels.

    Args:
        directory: Directory of a blind test.
        only: Ids of cases; empty for all.
        seed: Seed of the simulated days.
        reporter: Reporter of the progress.

    Raises:
        BlindTestError: The directory holds no blind test, or a label is damaged.
        UnknownNameError: There is no such case.
    """
    cases = chosen(directory, only)
    grades: list[FirstStage] = []
    with (reporter or Silent()).task("looking at the detectors", len(cases)) as advance:
        for case in cases:
            grades.append(graded(directory, case, _errors(directory, case, seed)))
            advance(note=case.case)
    return tuple(grades)


def _errors(directory: Path, case: Case, seed: int) -> tuple[DetectorError, ...]:
    scenario, measured = read_street(case.scenario, directory / case.case / "measured")
    config = DiagnosisConfig(seed=seed, leave_out=case.leave_out)
    return Study.of(scenario, measured, config).detectors_as_they_are(Silent()).detection


def graded(directory: Path, case: Case, errors: Sequence[DetectorError]) -> FirstStage:
    """Compare errors of detectors with the label of a case."""
    label = read_label(directory, case.case)
    truth = canonical([item for item in label.effects if item.name in ERRORS], label)
    named = canonical([Hidden.of(error.effect) for error in errors], label)
    instead = canonical([Hidden.of(error.rival) for error in errors if error.rival], label)
    outcome: Outcome = "right"
    if not truth:
        outcome = "invented" if named else "right"
    elif not named:
        outcome = "missed"
    elif not all(match(item, named) for item in truth) or len(named) > len(truth):
        either = all(match(item, [*named, *instead]) for item in truth)
        outcome = "one of two" if either and len(named) == len(truth) else "wrong"
    inside = [
        abs(found.parameters[key] - value) <= error.margin
        for item in truth
        for error in errors
        if error.margin is not None
        and (found := match(item, canonical([Hidden.of(error.effect)], label))) is not None
        for key, value in item.parameters.items()
    ]
    return FirstStage(
        case.case,
        case.scenario,
        " + ".join(map(_text, label.effects)) or label.hidden,
        bool(truth),
        tuple(str(error.effect) for error in errors),
        outcome,
        tuple(inside),
    )


def _text(item: Hidden) -> str:
    numbers = [f"{value:.4g}" for value in item.parameters.values()]
    return f"{item.name}={','.join(filter(None, [item.place or '', *numbers]))}"


def markdown(grades: Sequence[FirstStage]) -> str:
    """Return the grades as Markdown: shares, then all cases that are not right, the worst first."""
    erring = [x for x in grades if x.erring]
    others = [x for x in grades if not x.erring]
    inside = [value for x in grades for value in x.inside]
    right = sum(x.outcome == "right" for x in erring)
    lines = [
        "| measure | result | 95 % interval |",
        "|---|---:|---|",
        _share("detectors as stated, yet an error named", _count(others, "invented"), len(others)),
        _share("another error named", _count(erring, "wrong"), len(erring)),
        _share("error named, at the right place", right, len(erring)),
        _share("one of two that look the same", _count(erring, "one of two"), len(erring)),
        _share("nothing said", _count(erring, "missed"), len(erring)),
        _share("95 % intervals that hold the value", sum(inside), len(inside)),
        "",
        "| case | network | hidden | named | outcome |",
        "|---|---|---|---|---|",
    ]
    bad = [x for x in grades if x.outcome != "right" or not all(x.inside)]
    for x in sorted(bad, key=lambda x: OUTCOMES.index(x.outcome)):
        named = " ".join(f"`{text}`" for text in x.named) or "nothing"
        outcome = x.outcome if all(x.inside) else f"{x.outcome}, outside its interval"
        lines.append(f"| {x.case} | {x.scenario} | `{x.hidden}` | {named} | {outcome} |")
    return "\n".join(lines)


def _count(grades: Sequence[FirstStage], outcome: Outcome) -> int:
    return sum(x.outcome == outcome for x in grades)


def _share(measure: str, count: int, n: int) -> str:
    if not n:
        return f"| {measure} | no case | |"
    low, high = wilson(count, n)
    return f"| {measure} | {count} of {n} | {100 * low:.0f} to {100 * high:.0f} % |"
