"""When two descriptions mean the same effects, and which of the hidden ones have to be named."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from studies.blind.cases import Hidden, Label
from studies.blind.strengths import KINDS
from ugat_marl.effects import EVERYWHERE

OPTIONAL = frozenset({"emergency_deceleration"})
"""Hidden effects that need not be named: nobody who drives as usual shows them."""

WEAK_STARTUP_S = 0.5
"""Below this, a start-up delay beside other effects need not be named (V3 has 0.25 s)."""

WHOLE = 0.95
"""A window over this share of the period is no window."""


def required_and_allowed(
    label: Label, truth: Sequence[Hidden]
) -> tuple[frozenset[str], frozenset[str]]:
    """The names that must be given, and all that may be."""
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
    """Effects in one spelling, so that two descriptions of the same thing are equal."""
    found = [canonical_effect(item, label) for item in effects]
    kept: list[Hidden] = []
    for item in found:
        kind = KINDS.get(item.name)
        if kind is not None and kind.where == "light" and len(label.lights) > 1:
            same = [x for x in found if x.name == item.name]
            if {x.place for x in same} == set(label.lights):  # at all lights means everywhere
                keys = item.parameters
                mean = {k: sum(x.parameters[k] for x in same) / len(same) for k in keys}
                item = replace(item, place=EVERYWHERE, parameters=mean)
        if item not in kept:
            kept.append(item)
    return kept


def canonical_effect(item: Hidden, label: Label) -> Hidden:
    """One effect in its one spelling."""
    name, place, window, parameters = item.name, item.place, item.window, dict(item.parameters)
    if name == "demand_surge" and window is not None and _covers(window, label):
        name, window = "demand_level", None
    kind = KINDS.get(name)
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


def found_effect(raw: Mapping[str, Any]) -> Hidden:
    """An effect of a diagnosis, values without their intervals."""
    values = {
        key: float(item["value"]) if isinstance(item, Mapping) else float(item)
        for key, item in (raw.get("parameters") or {}).items()
    }
    return Hidden.from_dict({**raw, "parameters": values, "nominal": {}})


def match(item: Hidden, others: Sequence[Hidden]) -> Hidden | None:
    """The effect of the same name at the same place."""
    return next((x for x in others if (x.name, x.place) == (item.name, item.place)), None)


def same_name(name: str, others: Sequence[Hidden]) -> Hidden | None:
    """The effect of the same name, wherever it is."""
    return next((x for x in others if x.name == name), None)
