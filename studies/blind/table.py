"""Sum up grades: one row per measure with its interval, and the confusions of effects."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from studies.blind.cases import SCHEMA
from studies.blind.generate import VARIATIONS
from studies.blind.grade import Grade
from studies.blind.sampling import UNKNOWN
from ugat_marl.files import write_whole

TRIO = frozenset({"acceleration", "startup_delay", "headway"})
"""Effects that all make queues discharge slowly, so that a diagnosis confuses them."""

MANY = 5
"""Number of periods for the goal of the first row."""

AIMS = {
    "single effect, medium or large, named (5 periods, speeds)": "98 %",
    "the same from one period": "92 %",
    "acceleration, start-up delay, headway kept apart (medium or large)": "99 %",
    "nothing hidden, yet something named": "1 %",
    "effect outside the library called explained": "2 %",
    "confident and wrong": "0.5 %",
    "both of a pair named": "90 %",
    "parameter error, relative to the value (median)": "0.03",
    "95 % intervals that hold the value": "93 to 97 %",
    "place right where the name is": "98 %",
    "window overlap (IoU) (median)": "0.8",
    "held-out gap shrink where explained (median)": "0.97",
    "policy gap shrink on V1-V4 (median)": "0.85",
    "wall time, one intersection (median)": "240 s",
    "wall time, several intersections (median)": "900 s",
}
"""Measure to a value that would be better still than the goal."""


@dataclass(frozen=True)
class Row:
    """One measure.

    Attributes:
        measure: Name of the measure.
        n: Number of cases (or parameters).
        count: Number of successes among them; None for a measure that is not a share.
        value: The share or the median; None without cases.
        low: Lower end of the 95 % Wilson interval of a share, or the lower quartile.
        high: Upper end of this interval, or the upper quartile.
        unit: Unit of the value; ``"%"`` for shares, stored as 0 to 1; ``""`` for ratios.
        ship: The goal, in words.
        met: True if `value` meets the goal; None without cases or without a goal.
    """

    measure: str
    n: int
    count: int | None
    value: float | None
    low: float | None
    high: float | None
    unit: str
    ship: str
    met: bool | None


def wilson(count: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927).

    Args:
        count: Number of successes.
        n: Number of cases, at least 1.
    """
    interval = binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def rows_of(grades: Sequence[Grade]) -> list[Row]:
    """Compute all measures: names first, then numbers."""
    return [*_naming(grades), *_numbers(grades)]


def _naming(grades: Sequence[Grade]) -> list[Row]:
    single = [x for x in grades if x.group == "single"]
    strong = [x for x in single if x.strength != "small"]
    rich = [x for x in strong if x.periods >= MANY and x.speeds]
    seen = [x for x in rich if x.visible]
    one = [x for x in strong if x.periods == 1]
    blunt = [x for x in strong if x.periods >= MANY and not x.speeds]
    small = [x for x in single if x.strength == "small"]
    trio = [x for x in strong if x.hidden in TRIO]
    none = [x for x in grades if x.group == "none"]
    outside = [x for x in grades if x.group == "outside"]
    whole = [x for x in outside if x.hidden in UNKNOWN]
    errors = [x for x in grades if x.group == "measurement"]
    pairs = [x for x in grades if x.group == "pair"]
    settings = [x for x in grades if x.group == "setting"]
    hidden = [x for x in grades if x.group not in ("none", "outside")]
    trio_text = "acceleration, start-up delay, headway kept apart (medium or large)"
    return [
        _share("single effect, medium or large, named (5 periods, speeds)", rich, _right, 0.9),
        _share("of these, those that a test which knows the effect sees", seen, _right),
        _share("the same from one period", one, _right, 0.8),
        _share("the same, 5 periods without speeds", blunt, _right),
        _share("single effect, small, named", small, _right),
        _share(trio_text, trio, _right, 0.9),
        _share("nothing hidden, yet something named", none, _wrong, most=0.05),
        *(
            _share(
                f"the same, {100 * share:g} % from day to day",
                [x for x in none if x.day_to_day == share],
                _wrong,
            )
            for share in VARIATIONS
        ),
        _share("error of measurement named", errors, _right),
        _share("error of measurement called drivers' behaviour", errors, _blames, most=0.02),
        _share("effect outside the library called explained", outside, _explained, most=0.1),
        _share("of these, effects that no library has", whole, _explained),
        _share("confident and wrong", grades, lambda x: x.confident_wrong, most=0.03),
        _share("both of a pair named", pairs, lambda x: x.found == 1.0, 0.7),
        _share("V1-V4: every effect named, and no other", settings, _right),
        _share("abstained, though a library effect is hidden", hidden, _abstained),
        _share("failed", grades, lambda x: x.outcome == "failed"),
    ]


def _numbers(grades: Sequence[Grade]) -> list[Row]:
    hidden = [x for x in grades if x.group not in ("none", "outside")]
    estimates = [estimate for x in grades for estimate in x.estimates]
    placed = [x for x in hidden if x.place_right is not None]
    relative = [x.relative for x in estimates]
    of_effect = [x.of_effect for x in estimates]
    windows = [x.window_iou for x in hidden]
    shrinks = [x.shrink for x in hidden if x.verdict == "explained"]
    policies = [x.policy_shrink for x in hidden if x.group == "setting"]
    small = [x.wall_s for x in grades if x.lights == 1]
    large = [x.wall_s for x in grades if x.lights > 1]
    return [
        _median("parameter error, relative to the value", relative, most=0.1),
        _median("parameter error, relative to the effect", of_effect),
        _coverage([x.inside for x in estimates]),
        _share("place right where the name is", placed, lambda x: bool(x.place_right), 0.9),
        _median("window overlap (IoU)", windows, least=0.6),
        _median("held-out gap shrink where explained", shrinks, least=0.8),
        _median("policy gap shrink on V1-V4", policies, least=0.5),
        _median("wall time, one intersection", small, most=600.0, unit="s"),
        _median("wall time, several intersections", large, most=2700.0, unit="s"),
    ]


def confusion(grades: Iterable[Grade]) -> dict[str, Counter[str]]:
    """Count, for each hidden effect, the names that diagnoses gave it."""
    found: dict[str, Counter[str]] = defaultdict(Counter)
    for item in grades:
        found[item.hidden][_taken_for(item)] += 1
    return dict(sorted(found.items()))


def markdown(grades: Sequence[Grade], drawn: int | None = None) -> str:
    """Return the table and the confusions as Markdown.

    Args:
        grades: Grades of the cases.
        drawn: Number of cases that were drawn; None to leave it out.
    """
    left = "" if drawn is None else f"{len(grades)} of {drawn} cases that were drawn are graded."
    lines = [
        *([left, ""] if left else []),
        "| measure | n | result | 95 % interval, or quartiles | goal | met | aim |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows_of(grades):
        met = "" if row.met is None else "yes" if row.met else "no"
        between = "" if row.low is None else f"{_text(row, row.low)} to {_text(row, row.high)}"
        result = "" if row.value is None else _text(row, row.value)
        if row.count is not None and row.n:
            result = f"{row.count} of {row.n}: {result}"
        goals = f"{row.ship} | {met} | {AIMS.get(row.measure, '')}"
        lines.append(f"| {row.measure} | {row.n} | {result} | {between} | {goals} |")
    lines += ["", "| hidden | n | right | taken for |", "|---|---|---|---|"]
    right = Counter(item.hidden for item in grades if item.outcome == "right")
    for hidden, names in confusion(grades).items():
        taken = ", ".join(f"{name} ({count})" for name, count in names.most_common())
        lines.append(f"| {hidden} | {names.total()} | {right[hidden]} | {taken} |")
    return "\n".join(lines) + "\n"


def write_table(grades: Sequence[Grade], path: Path, drawn: int) -> None:
    """Write the table as Markdown, or as JSON if the name ends in ``.json``.

    Args:
        grades: Grades of the cases.
        path: The file.
        drawn: Number of cases that were drawn.
    """
    if path.suffix != ".json":
        write_whole(path, markdown(grades, drawn))
        return
    content = {
        "schema": SCHEMA,
        "drawn": drawn,
        "graded": len(grades),
        "rows": [asdict(row) for row in rows_of(grades)],
        "confusion": confusion(grades),
    }
    write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _right(grade: Grade) -> bool:
    return grade.outcome == "right"


def _wrong(grade: Grade) -> bool:
    return grade.outcome == "wrong"


def _blames(grade: Grade) -> bool:
    return bool(grade.blamed)


def _abstained(grade: Grade) -> bool:
    return grade.outcome == "abstained"


def _explained(grade: Grade) -> bool:
    return grade.verdict == "explained"


def _taken_for(grade: Grade) -> str:
    """Return the verdict of a diagnosis in a word or two."""
    names = "+".join(grade.named)
    words = {
        "no_discrepancy": "nothing",
        "explained": names or "explained by nothing",
        "partially_explained": f"partly {names}" if names else "partly something",
        "not_identifiable": f"one of several, {names} among them" if names else "one of several",
        "provisional": "unfinished",
        "unknown": "unknown",
        "failed": "failed",
    }
    return words[grade.verdict]


def _share(
    measure: str,
    grades: Sequence[Grade],
    happened: Callable[[Grade], bool],
    least: float | None = None,
    most: float | None = None,
) -> Row:
    n, count = len(grades), sum(map(happened, grades))
    share = count / n if n else None
    low, high = wilson(count, n) if n else (None, None)
    return Row(measure, n, count, share, low, high, "%", *_goal(share, least, most, "%"))


def _coverage(inside: Sequence[bool | None]) -> Row:
    """Return the share of 95 % intervals that hold the value; the goal has two sides."""
    known = [x for x in inside if x is not None]
    n, count = len(known), sum(known)
    share = count / n if n else None
    low, high = wilson(count, n) if n else (None, None)
    met = None if share is None else 0.85 <= share <= 0.99
    text = "85 to 99 %"
    return Row("95 % intervals that hold the value", n, count, share, low, high, "%", text, met)


def _median(
    measure: str,
    values: Iterable[float | None],
    least: float | None = None,
    most: float | None = None,
    unit: str = "",
) -> Row:
    known = np.array([x for x in values if x is not None])
    if not len(known):
        ship, met = _goal(None, least, most, unit)
        return Row(f"{measure} (median)", 0, None, None, None, None, unit, ship, met)
    low, middle, high = (float(x) for x in np.quantile(known, (0.25, 0.5, 0.75)))
    goal = _goal(middle, least, most, unit)
    return Row(f"{measure} (median)", len(known), None, middle, low, high, unit, *goal)


def _goal(
    value: float | None, least: float | None, most: float | None, unit: str
) -> tuple[str, bool | None]:
    if least is None and most is None:
        return "", None
    limit: Any = least if least is not None else most
    sign = "at least" if least is not None else "at most"
    shown = f"{100 * limit:g} %" if unit == "%" else f"{limit:g} {unit}".strip()
    if value is None:
        return f"{sign} {shown}", None
    return f"{sign} {shown}", value >= limit if least is not None else value <= limit


def _text(row: Row, value: float | None) -> str:
    if value is None:
        return ""
    if row.unit == "%":
        return f"{100 * value:.1f} %"
    return f"{value:.0f} {row.unit}" if row.unit else f"{value:.3f}"
