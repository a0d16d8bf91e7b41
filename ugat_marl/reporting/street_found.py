"""Findings of a training in the log of the street: commands, detectors, effects."""

from __future__ import annotations

import contextlib
import re
from typing import Any

from ugat_marl.effects import known_effects
from ugat_marl.errors import CheckpointError
from ugat_marl.grounding import JUDGED, LIBRARY, commands_in_words, detectors_in_words
from ugat_marl.policies import rule_in
from ugat_marl.reporting.formats import number
from ugat_marl.reporting.page import Grid
from ugat_marl.reporting.run_records import RunRecord


def found_on_street(record: RunRecord) -> dict[str, Any] | None:
    """Return what was found of the network as a whole, as the last iteration left it.

    Args:
        record: The training.

    Returns:
        None if the training fitted no street.
    """
    if "street/commands" not in record.last_iteration:
        return None
    return {
        "unlike": _unlike(record),
        "commands": commands_found(record),
        "detectors": detectors_found(record),
        "effects": _effects(record),
        "kept": _kept(record),
    }


def _unlike(record: RunRecord) -> str:
    """Return a warning if no simulated world is like the street; "" if one is."""
    beyond = record.last_iteration.get("street/beyond_worlds")
    if beyond is None:
        return ""
    return (
        f"The log is unlike every simulated world: {beyond:.0%} of its statistics are beyond "
        "theirs. Trust no value below, and compare network and traffic of the simulation with "
        "those of the street."
    )


def commands_found(record: RunRecord) -> str:
    """Return what became of commands, in a sentence."""
    numbers = record.last_iteration
    lag = re.compile(r"channel/lag_(\d+)")
    shares = {int(found[1]): v for name, v in numbers.items() if (found := lag.fullmatch(name))}
    words = commands_in_words(
        shares, numbers.get("channel/lost", 0.0), bool(numbers.get("channel/forbids"))
    )
    return f"Commands: {words}."


def detectors_found(record: RunRecord) -> str:
    """Return the faults of detectors, in a sentence; "" if they were not looked for."""
    values = record.parts("eyes")
    return f"Detectors: {detectors_in_words(values)}." if values else ""


def _effects(record: RunRecord) -> Grid | None:
    """Return the effects with intervals and chances; None if they were not fitted."""
    rows, numbers = list[list[str]](), record.last_iteration
    for prior in LIBRARY:
        name = f"effects/{prior.name}"
        ends = ("", "/low", "/high", "/nominal")
        middle, low, high, nominal = (numbers.get(f"{name}{end}") for end in ends)
        if middle is None or low is None or high is None or nominal is None:
            continue
        unit = next(iter(known_effects()[prior.name].ranges.values())).unit or "–"
        chance = numbers.get(f"{name}/chance")
        rows.append(
            [
                prior.name.replace("_", " "), unit, number(nominal), number(middle),
                f"{number(low)} to {number(high)}", "–" if chance is None else f"{chance:.0%}",
            ]
        )  # fmt: skip
    headings = ["effect", "unit", "simulation", "street", "90 % interval", "chance"]
    return Grid(headings, rows, headings[2:]) if rows else None


def _kept(record: RunRecord) -> str:
    """Return which policy was kept, by its travel times in worlds of the street."""
    times_s = record.parts("judged")
    told = {text: times_s[name] for name, text in JUDGED.items() if name in times_s}
    if not told:
        return ""
    best = min(told, key=lambda text: told[text])
    values = ", ".join(f"{text} {number(time_s)} s" for text, time_s in told.items())
    if rule := _rule_kept(record):
        best = f"{JUDGED['of_the_rule']} {rule}"
    return f"Average travel time in the fitted street: {values}. Kept was {best}."


def _rule_kept(record: RunRecord) -> str | None:
    """Return the spelling of the rule that was kept; None if a trained policy was."""
    files = ("policy.pt", "policies/fitted-street.pt")  # of a job of tables, and of a training
    for path in (record.directory / name for name in files):
        if path.exists():
            with contextlib.suppress(CheckpointError):
                return rule_in(path)
    return None
