"""Draw the hidden effects of a case: class, strength, place and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, islice, product
from typing import Any

import numpy as np

from studies.blind.outside_effects import BusStops, Driveway
from studies.blind.places import Busy
from studies.blind.strengths import ALL_KINDS, ERRORS, KINDS, MODELS, SCALE, STRENGTHS, nominal_of
from ugat_marl.diagnosis import IN_THE_LOG
from ugat_marl.effects import (
    EVERYWHERE,
    PAPER_WORLDS,
    Effect,
    effect_from_record,
    known_effects,
    measurement_effects,
)
from ugat_marl.errors import UnknownNameError
from ugat_marl.scenarios import Scenario, edge_of_lane

GROUPS: Mapping[str, float] = {
    "none": 0.20, "single": 0.28, "measurement": 0.28, "pair": 0.10, "setting": 0.05,
    "outside": 0.09,
}  # fmt: skip
"""The groups of classes, and their usual shares of the cases."""

EFFECT_SHARE = 0.05
"""Share of the cases for an effect that is requested by name beside groups."""

DECOYS = 0.3
"""Share of the other cases in which an effect that is not hidden is left out of the library.

So the list of left-out effects does not reveal the hidden one.
"""

MARGIN_S = 600.0
"""Least seconds between a window and the ends of a period."""

ADVANCE = "advance"
"""Kind of the detectors ahead of the stop line."""

ALSO_OUT: Mapping[str, tuple[str, ...]] = {"demand_level": ("demand_surge",)}
"""Effects that are left out together with an effect, because they mean the same."""

UNKNOWN = ("bus_stops", "driveway", "double_parking")
"""What the library has in no form."""

_OWN = (*UNKNOWN, "reaction_step", *MODELS)

OUTSIDE = (
    *_OWN,
    *(f"without {x}" for x in KINDS if x not in (*IN_THE_LOG, "driver_model", "reaction_step")),
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """Request for one case: group, member of the group, strength."""

    group: str
    member: str = ""
    strength: str = ""


@dataclass(frozen=True)
class Sample:
    """Hidden effects of one case.

    Attributes:
        group: Group of the case.
        hidden: Name of the hidden effects.
        strength: Strength of the hidden effects.
        effects: Effects that are applied to the scenario.
        leave_out: Effects that the diagnosis may not use.
    """

    group: str
    hidden: str
    strength: str
    effects: tuple[Effect, ...]
    leave_out: tuple[str, ...] = ()


def draw_tasks(
    classes: Sequence[str],
    strengths: Sequence[str],
    cases: int,
    generator: np.random.Generator,
) -> list[Task]:
    """Draw one task per case, with equal numbers for all members of a group.

    Raises:
        UnknownNameError: There is no such class or strength.
    """
    for name in classes:
        if name not in GROUPS and name not in ALL_KINDS:
            raise UnknownNameError("class", name, (*GROUPS, *ALL_KINDS))
    for name in strengths:
        if name not in STRENGTHS:
            raise UnknownNameError("strength", name, STRENGTHS)
    weights = np.array([GROUPS.get(name, EFFECT_SHARE) for name in classes])
    exact = cases * weights / weights.sum()
    counts = np.floor(exact).astype(int)
    # Cases without effects are rounded up, because too few of them would flatter the result.
    part = exact - counts > 1e-9
    last = np.array([name != "none" for name in classes]) | ~part
    rest = np.lexsort((counts - exact, last))[: cases - counts.sum()]
    counts[rest] += 1
    tasks: list[Task] = []
    for name, count in zip(classes, counts.tolist(), strict=True):
        members = _members(name, strengths)
        order = [members[i] for i in generator.permutation(len(members))]
        if name == "outside":  # half have a form of their own, half are left out by name
            own = [task for task in order if task.member in _OWN]
            denied = [task for task in order if task.member not in _OWN]
            order = [task for pair in zip(cycle(own), denied, strict=False) for task in pair]
        tasks += islice(cycle(order), count)
    return [tasks[i] for i in generator.permutation(len(tasks))]


def _members(name: str, strengths: Sequence[str]) -> list[Task]:
    """Return all tasks of a group, or of an effect."""
    if name == "setting":
        return [Task(name, setting) for setting in PAPER_WORLDS]
    if name == "outside":
        return [Task(name, member) for member in OUTSIDE]
    several: Mapping[str, Sequence[str]] = {"single": tuple(KINDS), "measurement": tuple(ERRORS)}
    if name in GROUPS and name not in several:
        return [Task(name)]
    effects = several.get(name, (name,))
    found = [
        Task(_group(effect), effect, strength)
        for effect, strength in product(effects, strengths)
        if strength in ALL_KINDS[effect].strengths
    ]
    return found or [Task(_group(x), x, ALL_KINDS[x].strengths[0]) for x in effects]


def _group(effect: str) -> str:
    return "measurement" if effect in ERRORS else "single"


def draw_sample(
    task: Task, scenario: Scenario, busy: Busy, generator: np.random.Generator
) -> Sample | None:
    """Draw the hidden effects of one case; return None if the scenario has no place for them."""
    if task.group == "none":
        return _with_decoy(Sample("none", "none", "", ()), generator)
    if task.group == "setting":
        sample = Sample("setting", task.member, "", PAPER_WORLDS[task.member])
        return _with_decoy(sample, generator)
    if task.group == "outside":
        return _outside(task.member, scenario, busy, generator)
    if task.group == "pair":
        return _pair(scenario, busy, generator)
    effect = draw_effect(task.member, task.strength, scenario, busy, generator)
    if effect is None:
        return None
    return _with_decoy(Sample(task.group, task.member, task.strength, (effect,)), generator)


def draw_effect(
    name: str, strength: str, scenario: Scenario, busy: Busy, generator: np.random.Generator
) -> Effect | None:
    """Draw the place and time of an effect; return None if there is no place for it."""
    kind = ALL_KINDS[name]
    if (name == "gap_acceptance" and not busy.permitted) or (
        name == "lane_discipline" and not busy.several_lanes
    ):
        return None
    places = _places(kind.where, busy)
    if name in ("detector_offset", "detector_zone"):  # zones grow downstream
        size_m = abs(kind.value(strength))
        sides = slice(1, None) if name == "detector_zone" else slice(None)
        places = [one for one in places if min(busy.room_m[one[0]][sides]) >= size_m]
    if not places:
        return None
    texts = {**known_effects(), **measurement_effects()}[name].texts
    place = places[int(generator.integers(len(places)))]
    if kind.choices:
        place = (*place, kind.choices[int(generator.integers(len(kind.choices)))])
    record: dict[str, Any] = {"name": name, **dict(zip(texts, place, strict=True))}
    if kind.parameter:
        nominal = nominal_of(name, scenario)[kind.parameter]
        other_side = kind.either and bool(generator.integers(2))
        counted = busy.origins[place[0]] if name == "demand_level" else None
        value = nominal + kind.value(strength, other_side, counted) - kind.nominal
        record[kind.parameter] = round(value, 4)
    if kind.window_s:
        record["begin_s"], record["end_s"] = _window(kind.window(strength), scenario, generator)
    return effect_from_record({**record, **(kind.fixed or {})})


def _places(where: str, busy: Busy) -> list[tuple[str, ...]]:
    """Return the possible values of the text fields of an effect."""
    if where == "everywhere":
        return [()]
    if where == "light":
        lights = busy.lights if len(busy.lights) > 1 else ()
        return [(EVERYWHERE,)] * max(len(lights), 1) + [(light,) for light in lights]
    if where == "turn":
        return list(busy.turns)
    if where == "pair":
        return list(busy.pairs)
    names: Mapping[str, Sequence[str]] = {
        "origin": tuple(busy.origins),
        "closable": busy.closable,
        "lane": busy.lanes,
        "edge": busy.edges,
        "detector": busy.detectors,
        "group": busy.groups,
        "beside": busy.beside,
        "advance": tuple(place for place in busy.groups if place.startswith(ADVANCE)),
        "model": MODELS,
    }
    return [(name,) for name in names[where]]


def _window(
    length_s: float, scenario: Scenario, generator: np.random.Generator
) -> tuple[float, float]:
    settings = scenario.settings
    duration = scenario.decisions * scenario.control.decision_interval_s
    length = min(length_s, duration / 2)
    margin = min(MARGIN_S, (duration - length) / 2)
    begin = round(settings.begin_s + generator.uniform(margin, duration - length - margin))
    return float(begin), float(begin + round(length))


def _pair(scenario: Scenario, busy: Busy, generator: np.random.Generator) -> Sample | None:
    """Draw two effects of different families, both medium or large."""
    names = [x for x in ALL_KINDS if x not in IN_THE_LOG]
    for _ in range(100):
        one, two = (names[i] for i in generator.choice(len(names), 2, replace=False))
        strength = ("medium", "large")[int(generator.integers(2))]
        if ALL_KINDS[one].family == ALL_KINDS[two].family:
            continue
        found = [draw_effect(x, strength, scenario, busy, generator) for x in (one, two)]
        effects = [effect for effect in found if effect is not None]
        if len(effects) == 2:
            hidden = "+".join(sorted((one, two)))
            return _with_decoy(Sample("pair", hidden, strength, tuple(effects)), generator)
    return None


def _outside(
    member: str, scenario: Scenario, busy: Busy, generator: np.random.Generator
) -> Sample | None:
    """Draw an effect that the library does not have, or that the diagnosis may not use."""
    strength = ("medium", "large")[int(generator.integers(2))]
    scale = SCALE[strength]
    effects: tuple[Effect | None, ...]
    if member in ("bus_stops", "driveway"):
        if not busy.edges:
            return None
        edge = busy.edges[int(generator.integers(len(busy.edges)))]
        if member == "bus_stops":
            return Sample(
                "outside", member, strength, (BusStops(edge, 10.0 * scale, 25.0),), ("parking",)
            )
        return Sample("outside", member, strength, (Driveway(edge, 0.1 * scale),))
    if member == "double_parking":
        parked = draw_effect("parking", strength, scenario, busy, generator)
        edge = "" if parked is None else edge_of_lane(str(parked.record()["lane"]))
        ways = [turn for turn in busy.turns if turn[0] == edge]
        if parked is None or not ways:
            return None
        start, end = ways[int(generator.integers(len(ways)))]
        turn = effect_from_record(
            {"name": "turning", "from_edge": start, "to_edge": end, "share": 0.1 * scale}
        )
        return Sample("outside", member, strength, (parked, turn), ("parking",))
    if member in MODELS:
        model = effect_from_record({"name": "driver_model", "model": member})
        return Sample("outside", member, "", (model,), ("driver_model",))
    name = member.removeprefix("without ")
    strength = strength if strength in KINDS[name].strengths else KINDS[name].strengths[0]
    effects = (draw_effect(name, strength, scenario, busy, generator),)
    if effects[0] is None:
        return None
    leave_out = (name, *ALSO_OUT.get(name, ()))
    return Sample("outside", member, strength, (effects[0],), leave_out)


def _with_decoy(sample: Sample, generator: np.random.Generator) -> Sample:
    hidden = {effect.name for effect in sample.effects}
    if generator.random() >= DECOYS:
        return sample
    others = [x for x in KINDS if x in known_effects() and x not in hidden]
    name = others[int(generator.integers(len(others)))]
    return Sample(sample.group, sample.hidden, sample.strength, sample.effects, (name,))
