"""The words and numbers of a diagnosis, for its page and for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ugat_marl.diagnosis import clock
from ugat_marl.reporting.formats import number, share

Record = Mapping[str, Any]
"""The content of ``diagnosis.json``, or a part of it."""

UNTRIED = 8
"""Most effects that are named as not examined; of more, the text gives their number."""

VERDICTS = {
    "no_discrepancy": "no discrepancy",
    "explained": "explained",
    "not_identifiable": "not identifiable",
    "partially_explained": "partially explained",
    "unknown": "unknown",
}

MEANINGS = {
    "no_discrepancy": "The scenario as it is could have made these data. That does not say that it "
    "is right in what the data do not show.",
    "explained": "With these effects the simulation could have made the data they were judged "
    "on, and no other explanation of the library comes close.",
    "not_identifiable": "Several explanations fit equally well. The corrected scenario holds the "
    "one listed here; which one is true takes another measurement.",
    "partially_explained": "These effects take off most of the gap, and yet they are not the whole "
    "explanation. What is missing may bend their values.",
    "unknown": "Simulation and measurement disagree, and nothing in the library accounts for it. "
    "Any name would be a guess.",
}


def meaning(record: Record) -> str:
    """Return the meaning of the verdict; "" if the search is not complete."""
    if not record.get("complete", True):
        return ""
    text = MEANINGS.get(str(record["verdict"]), "")
    if record["verdict"] == "unknown" and record["effects"]:
        text += " What is listed here stands in the log of the signals."
    return text


def effect_name(item: Record) -> str:
    """Return the name of an effect with spaces."""
    return str(item["name"]).replace("_", " ")


def place(item: Record) -> str:
    """Return the place of an effect."""
    where = item.get("place")
    return "everywhere" if where in (None, "*", "") else str(where).replace(">", " → ")


def window(span: Sequence[float] | None) -> str:
    """Return begin and end of a window on the scenario's clock; "" for None."""
    return "" if span is None else f"{clock(span[0])} – {clock(span[1])}"


def values(item: Record, *, intervals: bool = True) -> str:
    """Return the parameters of an effect, with their intervals if wanted."""
    found = [_parameter(name, given, intervals) for name, given in item["parameters"].items()]
    return "; ".join(found) or "as such"


def _parameter(name: str, given: Record, intervals: bool) -> str:
    value, low, high = given.get("value"), given.get("low"), given.get("high")
    unit = str(given.get("unit") or "").replace("^2", "²")
    text = f"{name.removesuffix('_s').replace('_', ' ')} "
    text = "" if unit and name in ("seconds", "metres", "mps2", "seconds_per_hour") else text
    if not intervals or value is None or low is None or high is None or low == high:
        return f"{text}{number(value)} {unit}".rstrip()
    middle, low, high = (_rounded(x, high - low) for x in (value, low, high))
    return f"{text}{middle} {unit}".rstrip() + f" ({low} to {high})"


def _rounded(value: float, width: float) -> str:
    """Return a number rounded to two digits of its interval's width."""
    decimals = min(max(1 - math.floor(math.log10(max(width, 1e-9))), 0), 4)
    return f"{value:.{decimals}f}".replace("-", "−")


def disagreement_place(item: Record) -> str:
    """Return the narrowest known place of a disagreement: lane, approach or traffic light."""
    for key in ("lane", "approach", "tls"):
        if item.get(key) is not None:
            return str(item[key])
    return "all of the network"


def strongest(record: Record, count: int) -> list[Record]:
    """Return the strongest disagreements, one per statistic: the first one in the record."""
    found: list[Record] = []
    seen: set[str] = set()
    for item in record.get("where") or ():
        if item["statistic"] not in seen:
            seen.add(item["statistic"])
            found.append(item)
    found.sort(key=lambda item: -abs(item["z"]))
    return found[:count]


def partial(record: Record) -> str | None:
    """Return the warning that a diagnosis is not complete; None if it is."""
    if record.get("complete", True):
        return None
    untried = list(record.get("untried") or ())
    rest = f", … ({len(untried)} in all)" if len(untried) > UNTRIED else ""
    left = f" Not examined yet: {joined(untried[:UNTRIED])}{rest}." if untried else ""
    return (
        f"Partial result: the budget of {number(record.get('budget_s'))} s ended before the search "
        f"did.{left} The same command goes on where this one stopped."
    )


def geh_line(record: Record) -> str | None:
    """Return a sentence on GEH, the usual criterion for counts; None without counts."""
    tables = record.get("courtesy") or {}
    before = (tables.get("before") or {}).get("geh_below_5")
    after = (tables.get("after") or {}).get("geh_below_5")
    if before is None:
        return None
    text = f"GEH < 5 (usual: on 85 % of counts): {share(before)} before, {share(after)} after"
    if record["verdict"] != "no_discrepancy" and before >= 0.85:
        return f"{text}. It passes without any correction: it does not see this gap."
    return f"{text}."


def joined(names: Iterable[str]) -> str:
    """Return names as a list in a sentence."""
    return ", ".join(str(name).replace("_", " ") for name in names)
