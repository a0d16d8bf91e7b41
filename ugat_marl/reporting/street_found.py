"""Findings of a training in the log of the street: commands, detectors, effects, unused green."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ugat_marl.effects import known_effects
from ugat_marl.grounding import LIBRARY
from ugat_marl.reporting.figures import NamedFigure
from ugat_marl.reporting.formats import number
from ugat_marl.reporting.network_maps import node_map
from ugat_marl.reporting.page import Grid, Page
from ugat_marl.reporting.places import Places
from ugat_marl.reporting.run_records import RunRecord

_UNUSED = {
    "begin_s": "green unused at its beginning",
    "each_s": "green unused in each further decision",
}
_LATEST = 20
"""Largest lag of commands that is looked for in a record, in decisions."""


def found_on_street(page: Page, record: RunRecord, places: Places | str) -> dict[str, Any] | None:
    """Return the section of a fitted street, as the last iteration left it.

    Args:
        page: The page; it numbers its pictures.
        record: The training.
        places: Where its agents are, or why they are not known.

    Returns:
        None if the training fitted no street.
    """
    if _last(record, "street/commands") is None:
        return None
    known = places if isinstance(places, Places) else None
    figures = [] if known is None else [_map(record, known, key) for key in _UNUSED]
    return {
        "commands": commands_found(record),
        "detectors": detectors_found(record),
        "effects": _effects(record),
        "unused": _unused(record, known),
        "figures": page.figures(*figures),
        "note": known.note if known is not None else places,
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
        f"{100 * share:.0f} % take effect {lag} decision{'s' * (lag > 1)} late"
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
    """Return the effects with their intervals; None if they were not fitted."""
    rows: list[list[str]] = []
    for prior in LIBRARY:
        name = f"effects/{prior.name}"
        ends = ("", "/low", "/high", "/nominal")
        middle, low, high, nominal = (_last(record, f"{name}{end}") for end in ends)
        if middle is None or low is None or high is None or nominal is None:
            continue
        unit = next(iter(known_effects()[prior.name].ranges.values())).unit or "–"
        usual = "yes" if low <= nominal <= high else "no"
        rows.append(
            [
                prior.name.replace("_", " "), unit, number(nominal), number(middle),
                f"{number(low)} to {number(high)}", usual,
            ]
        )  # fmt: skip
    headings = ["effect", "unit", "simulation", "street", "90 % interval", "simulation possible"]
    return Grid(headings, rows, headings[2:5]) if rows else None


def _of_agents(record: RunRecord, key: str) -> list[dict[str, float]]:
    """Return median, lower and upper end of one kind of unused green, by agent."""
    return [
        {agent: rows[-1][1] for agent, rows in record.agents(f"unused/{key}{end}").items()}
        for end in ("", "_low", "_high")
    ]


def _unused(record: RunRecord, places: Places | None) -> Grid | None:
    """Return the unused green of each intersection; None if it was not fitted."""
    columns = {key: _of_agents(record, key) for key in _UNUSED}
    lights: Mapping[str, str] = {} if places is None else places.intersection_of
    rows = [
        [
            agent,
            lights.get(agent, "–"),
            *(
                f"{number(middle.get(agent, math.nan), 2)} "
                f"({number(low.get(agent, math.nan), 2)} to {number(high.get(agent, math.nan), 2)})"
                for middle, low, high in columns.values()
            ),
        ]
        for agent in columns["begin_s"][0]
    ]
    headings = ["agent", "traffic light", *(f"{text}, s" for text in _UNUSED.values())]
    return Grid(headings, rows, headings[2:]) if rows else None


def _map(record: RunRecord, places: Places, key: str) -> tuple[NamedFigure | None, str]:
    """Return a map of one kind of unused green; a single intersection needs none."""
    middle, low, high = _of_agents(record, key)
    values = {
        light: (middle[agent], f"{middle[agent]:.1f}")
        for agent, light in places.intersection_of.items()
        if agent in middle
    }
    if len(values) < 2:
        return None, ""
    title = _UNUSED[key]
    tips = {
        places.intersection_of[agent]: f"{low[agent]:.1f} to {high[agent]:.1f}"
        for agent in middle
        if agent in places.intersection_of
    }
    most = max(1.0, *(value for value, _ in values.values()))
    name = f"{record.name}-map-{key}".replace("/", "-")
    picture = node_map(name, title, places.network, values, (0.0, most), "s", tips)
    text = "mean over its lanes; the tip of a disc has the 90 % interval"
    return picture, f"{title[0].upper()}{title[1:]} at each intersection ({text})."


def _kept(record: RunRecord) -> str:
    """Return which policy was kept, by its travel times in worlds of the street."""
    names = {"before": "before", "after_the_lessons": "after the lessons", "after": "after"}
    times = {text: _last(record, f"judged/{name}") for name, text in names.items()}
    told = {text: time_s for text, time_s in times.items() if time_s is not None}
    if not told:
        return ""
    best = min(told, key=lambda text: told[text])
    values = ", ".join(f"{text} {number(time_s)} s" for text, time_s in told.items())
    return f"In worlds of the street the policy took {values}; the one {best} was kept."
