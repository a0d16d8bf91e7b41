"""Findings of a training in the log of the street: commands, detectors, effects."""

from __future__ import annotations

import contextlib
from typing import Any

from ugat_marl.effects import known_effects
from ugat_marl.errors import CheckpointError, counted
from ugat_marl.grounding import JUDGED, LIBRARY
from ugat_marl.policies import rule_in
from ugat_marl.reporting.formats import number
from ugat_marl.reporting.page import Grid
from ugat_marl.reporting.run_records import RunRecord

_LATEST = 20
"""Largest lag of commands that is looked for in a record, in decisions."""


def found_on_street(record: RunRecord) -> dict[str, Any] | None:
    """Return what was found of the network as a whole, as the last iteration left it.

    Args:
        record: The training.

    Returns:
        None if the training fitted no street.
    """
    if _last(record, "street/commands") is None:
        return None
    return {
        "commands": commands_found(record),
        "detectors": detectors_found(record),
        "effects": _effects(record),
        "kept": _kept(record),
    }


def _last(record: RunRecord, name: str) -> float | None:
    """Return the last value of a number; None if it was not recorded."""
    rows = record.series("iteration", name)
    return rows[-1][1] if rows else None


def commands_found(record: RunRecord) -> str:
    """Return what became of commands, in a sentence."""
    shares = {lag: _last(record, f"channel/lag_{lag}") for lag in range(1, _LATEST + 1)}
    parts = [
        f"{100 * share:.0f} % take effect {counted(lag, 'decision')} late"
        for lag, share in shares.items()
        if share
    ]
    if lost := _last(record, "channel/lost"):
        parts.append(f"{100 * lost:.0f} % are lost")
    if _last(record, "channel/forbids"):
        parts.append("some changes of phase are refused")
    return f"Commands: {', '.join(parts) or 'obeyed at once'}."


def detectors_found(record: RunRecord) -> str:
    """Return the faults of detectors, in a sentence; "" if they were not looked for."""
    values = {
        name: _last(record, f"eyes/{name}")
        for name in ("dead", "zone_m", "absolute", "relative", "lag", "lost", "step")
    }
    if values["dead"] is None:
        return ""
    words = {
        "dead": "{:.1f} lanes are not seen",
        "zone_m": "vehicles count only within {:.0f} m of the stop line",
        "absolute": "counts err by {:.1f} vehicles",
        "lag": "counts are {:.0f} decisions late",
        "step": "counts come in steps of {:g} vehicles",
    }
    parts = [text.format(values[name]) for name, text in words.items() if values[name]]
    for name, text in (("relative", "counts err by {:.0f} %"), ("lost", "{:.0f} % are lost")):
        if value := values[name]:
            parts.append(text.format(100 * value))
    return f"Detectors: {', '.join(parts) or 'no fault found'}."


def _effects(record: RunRecord) -> Grid | None:
    """Return the effects with intervals and chances; None if they were not fitted."""
    rows: list[list[str]] = []
    for prior in LIBRARY:
        name = f"effects/{prior.name}"
        ends = ("", "/low", "/high", "/nominal")
        middle, low, high, nominal = (_last(record, f"{name}{end}") for end in ends)
        if middle is None or low is None or high is None or nominal is None:
            continue
        unit = next(iter(known_effects()[prior.name].ranges.values())).unit or "–"
        chance = _last(record, f"{name}/chance")
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
    times = {text: _last(record, f"judged/{name}") for name, text in JUDGED.items()}
    told = {text: time_s for text, time_s in times.items() if time_s is not None}
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
