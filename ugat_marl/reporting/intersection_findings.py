"""Findings at each intersection, with their intervals: a table and a map for each quantity."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ugat_marl.reporting.figures import NamedFigure, picture_name
from ugat_marl.reporting.formats import number
from ugat_marl.reporting.network_maps import node_map
from ugat_marl.reporting.page import Grid
from ugat_marl.reporting.places import AgentPlaces
from ugat_marl.reporting.run_records import RunRecord


@dataclass(frozen=True)
class _Quantity:
    """Number that a fit finds for each intersection.

    Attributes:
        metrics: Metrics of a training with the number, and with the ends of its interval.
        title: Name of the quantity.
        unit: Unit of the number.
        level: Level of its interval, in percent.
        scale: Factor from the metric to the unit.
    """

    metrics: tuple[str, str, str]
    title: str
    unit: str
    level: int = 90
    scale: float = 1.0


def _ends(name: str) -> tuple[str, str, str]:
    """Return the metrics of a part of a fitted street: number, low end and high end."""
    return name, f"{name}_low", f"{name}_high"


_QUANTITIES = (
    _Quantity(
        ("lost_time/best_s", "lost_time/low_s", "lost_time/high_s"), "delay of greens", "s", 95
    ),
    _Quantity(_ends("channel/late_s"), "delay of commands", "s"),
    _Quantity(_ends("channel/missing"), "commands that are lost", "%", scale=100.0),
    _Quantity(_ends("unused/begin_s"), "green unused at its beginning", "s"),
    _Quantity(_ends("unused/each_s"), "green unused in each further decision", "s"),
    _Quantity(_ends("eyes/unseen"), "lanes that are not seen", "lanes"),
)
"""What timed grounding (the first) and a fitted street find."""

_Found = dict[str, tuple[float, float, float]]
"""Agent to the number and to the lower and upper end of its interval."""


def findings_table(record: RunRecord, places: AgentPlaces | None) -> Grid | None:
    """Return the findings at each intersection, as the last iteration left them.

    Args:
        record: The training.
        places: Where its agents are; None if that is not known.

    Returns:
        None if the training found nothing that differs between intersections.
    """
    columns = {quantity: found for quantity in _QUANTITIES if (found := _found(record, quantity))}
    if not columns:
        return None
    lights: Mapping[str, str] = {} if places is None else places.intersection_of
    agents = dict.fromkeys(agent for found in columns.values() for agent in found)
    rows = [
        [agent, lights.get(agent, "–"), *(_cell(found, agent) for found in columns.values())]
        for agent in agents
    ]
    titles = [f"{x.title}, {x.unit} ({x.level} % interval)" for x in columns]
    return Grid(["agent", "traffic light", *titles], rows, titles)


def findings_maps(record: RunRecord, places: AgentPlaces) -> list[tuple[NamedFigure | None, str]]:
    """Return a map of each quantity that was found, with its caption.

    A single intersection needs no map.
    """
    if len(places.intersection_of) < 2:
        return []
    drawn = ((quantity, _found(record, quantity)) for quantity in _QUANTITIES)
    return [_map(record, places, quantity, found) for quantity, found in drawn if found]


def _found(record: RunRecord, quantity: _Quantity) -> _Found:
    """Return a quantity of each agent with its interval; empty if it was not looked for."""
    middle, low, high = (
        {agent: quantity.scale * value for agent, value in record.parts(metric).items()}
        for metric in quantity.metrics
    )
    return {
        agent: (value, low.get(agent, math.nan), high.get(agent, math.nan))
        for agent, value in middle.items()
    }


def _cell(found: _Found, agent: str) -> str:
    if agent not in found:
        return "–"
    middle, low, high = found[agent]
    return f"{number(middle, 2)} ({number(low, 2)} to {number(high, 2)})"


def _map(
    record: RunRecord, places: AgentPlaces, quantity: _Quantity, found: _Found
) -> tuple[NamedFigure | None, str]:
    """Return the map of a quantity; each circle has the number and, below it, its interval."""
    shown = {
        light: found[agent] for agent, light in places.intersection_of.items() if agent in found
    }
    if len(shown) < 2:
        return None, ""
    values = {light: (middle, number(middle, 2)) for light, (middle, _, _) in shown.items()}
    intervals = {light: f"{number(x[1], 2)} to {number(x[2], 2)}" for light, x in shown.items()}
    most = max(1.0, *(middle for middle, _ in values.values()))
    name = picture_name(record.name, "map", quantity.metrics[0])
    title = quantity.title
    ends = (0.0, most)
    picture = node_map(name, title, places.network, values, ends, quantity.unit, intervals)
    interval = f"in brackets the {quantity.level} % interval"
    return picture, f"{title[0].upper()}{title[1:]} at each intersection ({interval})."
