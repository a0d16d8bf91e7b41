"""Fixed-time signal plans: cycle, offset, and splits in rings and barriers.

A plan names movements as traffic engineers do: ``NBL`` turns left from a northbound approach. Every
ring shows its phases one after the other. Rings run side by side, and all of them pass a barrier at
the same time. A plan without rings is a plan with one. Within a split comes green, then yellow,
then all-red. The cycle begins at the offset, with the first phases of the first barrier.
"""

from __future__ import annotations

import csv
import io
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain, combinations, count, pairwise
from pathlib import Path
from typing import NamedTuple

from ugat_marl.errors import ScenarioError, nearest
from ugat_marl.files import Document, read_bytes, write_whole, xml_bytes
from ugat_marl.scenarios.csv_tables import as_text, columns_of, delimiter_of, number_in, rows_of
from ugat_marl.scenarios.junctions import Link
from ugat_marl.scenarios.network import Intersection, Network
from ugat_marl.scenarios.phases import (
    Clash,
    RightOfWay,
    are_foes,
    kerb_turn_of,
    opposite_approaches,
    permitted_clash,
    state_of,
    turn_of,
)
from ugat_marl.scenarios.scenario import Scenario
from ugat_marl.scenarios.signals import AMBER, GREEN, YELLOW
from ugat_marl.scenarios.street_names import (
    ALL_DIRECTIONS,
    TURN_NAMES,
    approach_directions,
    intersection_name,
)

CODES: dict[str, str] = dict(
    zip(ALL_DIRECTIONS, ("NB", "NE", "EB", "SE", "SB", "SW", "WB", "NW"), strict=True)
)
"""Direction of travel to its code in Synchro's files."""
_TURN_CODES = {"left": "L", "through": "T", "right": "R", "u-turn": "U"}
COLUMNS = ("light", "intersection", "cycle_s", "offset_s", "ring", "barrier", "phase", "movements",
           "split_s", "yellow_s", "all_red_s")  # fmt: skip
_SAME_S = 0.05
"""Largest difference of times that count as equal, s: tables round to tenths."""
SHORTEST_S = 0.001
"""Shortest part of a cycle: the times of programmes are written with three decimals."""
LONGEST_S = 3600.0
"""Longest time in a plan, s."""
_LEAST_YELLOW_S = 3.0
"""Shortest usual yellow, s (MUTCD 2009, section 4D.26)."""
_PROGRAM = "plan"
_NOBODY = "-"
"""Movements of a phase in which no vehicle goes."""


@dataclass(frozen=True)
class PlanPhase:
    """One phase of a plan.

    Attributes:
        ring: Number of its ring, from 1.
        barrier: Number of its barrier group, from 1.
        movements: Codes of the movements with green, such as ``NBT``.
        split_s: Time of the phase, s: green, yellow and all-red.
        yellow_s: Yellow at its end, s.
        all_red_s: Red after the yellow, s.
    """

    ring: int
    barrier: int
    movements: tuple[str, ...]
    split_s: float
    yellow_s: float
    all_red_s: float

    @property
    def green_s(self) -> float:
        """Seconds of green."""
        return self.split_s - self.yellow_s - self.all_red_s


@dataclass(frozen=True)
class SignalPlan:
    """The fixed-time plan of one traffic light.

    Attributes:
        light: SUMO id of the traffic light.
        cycle_s: Length of the cycle, s.
        offset_s: Start of a cycle on the scenario's clock, s.
        phases: Phases, in the order of each ring.
    """

    light: str
    cycle_s: float
    offset_s: float
    phases: tuple[PlanPhase, ...]


def movement_codes(light: Intersection, network: Network) -> dict[Link, str]:
    """Return the code of the movement of each link, such as ``NBL``."""
    directions = approach_directions(light.links, network.lanes)
    return {
        link: CODES[directions[link.from_edge]]
        + _TURN_CODES[TURN_NAMES.get(link.direction, "through")]
        for link in light.links
    }


def check_plan(plan: SignalPlan, source: str) -> None:
    """Refuse a plan whose times do not fit together.

    Args:
        plan: The plan.
        source: Name of its file in errors.

    Raises:
        ScenarioError: A split is too short for its yellow and all-red, rings differ between two
            barriers, or the splits do not make the cycle.
    """
    where = f"{source}: light {plan.light!r}"
    for number, phase in enumerate(plan.phases, 1):
        if phase.green_s < 1.0 - _SAME_S:
            raise ScenarioError(
                f"{where}: phase {number} ({' '.join(phase.movements)}) has a split of "
                f"{phase.split_s:g} s, and yellow and all-red take "
                f"{phase.yellow_s + phase.all_red_s:g} s of it; a second of green is the least"
            )
    lengths = _ring_lengths_s(plan)
    for barrier, rings in lengths.items():
        if max(rings.values()) - min(rings.values()) > _SAME_S:
            listed = ", ".join(f"ring {ring} {s:g} s" for ring, s in sorted(rings.items()))
            raise ScenarioError(
                f"{where}: the rings differ before the end of barrier {barrier} ({listed}); make "
                "their splits equal"
            )
    total = sum(max(rings.values()) for rings in lengths.values())
    if abs(total - plan.cycle_s) > _SAME_S:
        told = [(phase.ring, phase.barrier, phase.movements) for phase in plan.phases]
        twice = next((" ".join(one[2]) for one in told if told.count(one) > 1), "")
        hint = f"; {twice} is there twice: a light has one plan" if twice else ""
        raise ScenarioError(
            f"{where}: its splits make {total:g} s and its cycle_s is {plan.cycle_s:g}; make them "
            f"equal{hint}"
        )


def plan_states(
    plan: SignalPlan, light: Intersection, network: Network, rules: RightOfWay, source: str
) -> tuple[tuple[float, str], ...]:
    """Return the states of one cycle, ``(duration_s, state)``.

    - A link is green if its movement is green in some ring. It stays green from one phase of a ring
      to the next if both have it.
    - It gives way (``g``) to other greens that go first by the junction's rules.
    - Pedestrian crossings are green with a phase if only turning vehicles cross them. During yellow
      and all-red they stay green if they are green after it, too.

    Args:
        plan: The plan; `check_plan` has accepted it. Small differences of its times are made up.
        light: Its traffic light.
        network: The network.
        rules: Right of way at its junctions.
        source: Name of the plan's file in errors.

    Raises:
        ScenarioError: A movement is unknown or never green, or two greens cross.
    """
    codes = movement_codes(light, network)
    _check_movements(plan, set(codes.values()), source)
    width = max(link.index for link in (*light.links, *light.crossings)) + 1
    width = max([width, *(len(state) for _, state in light.programme)])
    times, shown = _times(_fitted(plan))
    states: list[tuple[float, str]] = []
    clash = _plan_clash(light, rules)
    parts = list(pairwise(times))
    signals = [_signals((begin + end) / 2, shown) for begin, end in parts]
    walks = _walks(signals, light, codes, rules)
    for (begin, end), now, walking in zip(parts, signals, walks, strict=True):
        state = _state(now, walking, light, codes, rules, width)
        going = _shown_with(now.green, light, codes)
        if pair := next((pair for pair in combinations(going, 2) if clash(*pair)), None):
            raise ScenarioError(
                f"{source}: light {plan.light!r}: {_told(pair[0], codes)} and "
                f"{_told(pair[1], codes)} are green together and cross or merge; give them phases "
                "of their own"
            )
        if states and states[-1][1] == state:
            states[-1] = (states[-1][0] + end - begin, state)
        else:
            states.append((end - begin, state))
    return tuple((round(seconds, 3), state) for seconds, state in states)


def _told(link: Link, codes: Mapping[Link, str]) -> str:
    """Return the code of a movement, with its roads where it stands for several ways."""
    ways = {
        (other.from_edge, other.to_edge) for other, code in codes.items() if code == codes[link]
    }
    if len(ways) < 2:
        return codes[link]
    return (
        f"{codes[link]} (here {link.from_edge} -> {link.to_edge}; it stands for {len(ways)} ways)"
    )


_Shown = Sequence[tuple[float, float, float, float, frozenset[str], frozenset[str]]]
"""Start, end of green, end of yellow, end, movements, and movements that stay green after it."""


class _Signals(NamedTuple):
    """Movements with green, with yellow, and in their all-red."""

    green: set[str]
    yellow: set[str]
    clearing: set[str]


def _ring_lengths_s(plan: SignalPlan) -> dict[int, dict[int, float]]:
    """Return the sum of splits, s, of each ring before each barrier, by barrier and ring."""
    lengths: dict[int, dict[int, float]] = defaultdict(lambda: defaultdict(float))
    for phase in plan.phases:
        lengths[phase.barrier][phase.ring] += phase.split_s
    return lengths


def phase_times(plan: SignalPlan) -> list[tuple[float, float, float]]:
    """Return start, end of green and end of yellow of each phase, s from the start of the cycle."""
    lengths = _ring_lengths_s(plan)
    begins = {
        barrier: sum(max(rings.values()) for other, rings in lengths.items() if other < barrier)
        for barrier in lengths
    }
    passed: dict[tuple[int, int], float] = defaultdict(float)
    times: list[tuple[float, float, float]] = []
    for phase in plan.phases:
        begin = begins[phase.barrier] + passed[phase.barrier, phase.ring]
        passed[phase.barrier, phase.ring] += phase.split_s
        green_end = begin + phase.green_s
        times.append((begin, green_end, green_end + phase.yellow_s))
    return times


def _fitted(plan: SignalPlan) -> SignalPlan:
    """Return an accepted plan whose rings meet at each barrier, and whose splits make the cycle.

    The last split of a ring before a barrier takes up what rounding leaves, with more or less
    green. A gap would end the green of movements that stay green across it.
    """
    lengths = _ring_lengths_s(plan)
    last = {(phase.barrier, phase.ring): place for place, phase in enumerate(plan.phases)}
    wanted = {barrier: max(rings.values()) for barrier, rings in lengths.items()}
    wanted[max(wanted)] += plan.cycle_s - sum(wanted.values())
    phases = list(plan.phases)
    for (barrier, ring), place in last.items():
        lacking_s = wanted[barrier] - lengths[barrier][ring]
        phases[place] = replace(phases[place], split_s=phases[place].split_s + lacking_s)
    return replace(plan, phases=tuple(phases))


def _staying(plan: SignalPlan) -> list[frozenset[str]]:
    """Return the movements that stay green after each phase, in the order of the phases."""
    begins = [begin for begin, *_ in phase_times(plan)]
    stays = [frozenset[str]()] * len(begins)
    for ring in {phase.ring for phase in plan.phases}:
        own = [place for place, phase in enumerate(plan.phases) if phase.ring == ring]
        own.sort(key=lambda place: begins[place])
        for place, following in zip(own, [*own[1:], own[0]], strict=True):
            end = begins[place] + plan.phases[place].split_s
            pause = (begins[following] - end + 1e-6) % plan.cycle_s  # it may sit a barrier out
            if pause < 2e-6:
                both = (plan.phases[place].movements, plan.phases[following].movements)
                stays[place] = frozenset(both[0]) & frozenset(both[1])
    return stays


def _times(plan: SignalPlan) -> tuple[list[float], _Shown]:
    """Return the times of changes, s from the start of the cycle, and the phases."""
    shown: list[tuple[float, float, float, float, frozenset[str], frozenset[str]]] = []
    times = {0.0, plan.cycle_s}
    for phase, span, stays in zip(plan.phases, phase_times(plan), _staying(plan), strict=True):
        begin, green_end, yellow_end = span
        end = begin + phase.split_s
        shown.append((begin, green_end, yellow_end, end, frozenset(phase.movements), stays))
        if stays:
            shown.append((green_end, end, end, end, stays, stays))
        # sums of splits may exceed the cycle by their last digits
        times |= {min(time, plan.cycle_s) for time in (begin, green_end, yellow_end, end)}
    kept: list[float] = []
    for time in sorted(times):
        if not kept or time - kept[-1] >= SHORTEST_S:
            kept.append(time)
    return kept, shown


def _plan_clash(light: Intersection, rules: RightOfWay) -> Clash:
    """Return a test if two links cross or merge and must not be green together.

    Left turns may let opposite traffic pass, and opposite left turns may be drawn so tightly that
    they touch. A right turn may merge. `conflicting_greens` permits more, as networks that somebody
    made are to be taken as they are.
    """
    permitted = permitted_clash(light.links, rules)
    opposite = opposite_approaches(light.links, rules)

    def clash(a: Link, b: Link) -> bool:
        turns = kerb_turn_of(a), kerb_turn_of(b)
        if a.from_edge == b.from_edge or (a.to_edge == b.to_edge and "r" in turns):
            return False
        return permitted(a, b) and not (turns == ("l", "l") and opposite(a, b))

    return clash


def _signals(time_s: float, shown: _Shown) -> _Signals:
    """Return what the movements show at a time of the cycle."""
    green: set[str] = set()
    yellow: set[str] = set()
    clearing: set[str] = set()
    for begin, green_end, yellow_end, end, movements, stays in shown:
        if begin <= time_s < green_end:
            green |= movements
        elif green_end <= time_s < yellow_end:
            yellow |= movements - stays
        elif yellow_end <= time_s < end:
            clearing |= movements - stays
    return _Signals(green, yellow - green, clearing - green - yellow)


def _walks(
    signals: Sequence[_Signals],
    light: Intersection,
    codes: Mapping[Link, str],
    rules: RightOfWay,
) -> list[list[Link]]:
    """Return the crossings that are green in each part of the cycle."""
    letters = {link.index for link in light.links}
    walks = [walk for walk in light.crossings if walk.index not in letters]

    def free(walk: Link, now: _Signals) -> bool:
        moving = now.green | now.yellow | now.clearing
        foes = (x for x in light.links if codes[x] in moving and are_foes(x, walk, rules.foes))
        return all(turn_of(link) != "s" for link in foes)

    def following(place: int) -> _Signals:
        in_turn = [*signals[place:], *signals[:place]]
        return next((one for one in in_turn if not (one.yellow or one.clearing)), in_turn[0])

    green: list[list[Link]] = []
    for place, now in enumerate(signals):
        later = following(place)
        green.append(
            [walk for walk in walks if later.green and free(walk, now) and free(walk, later)]
        )
    return green


def _state(
    now: _Signals,
    walks: Sequence[Link],
    light: Intersection,
    codes: Mapping[Link, str],
    rules: RightOfWay,
    width: int,
) -> str:
    going = _shown_with(now.green, light, codes)
    ending = _shown_with(now.yellow, light, codes)
    # Who gives way goes on doing so while the others have yellow.
    ruled = state_of([*going, *ending, *walks], light.links, rules, width)
    last = {link.index for link in ending} - {link.index for link in going}
    return "".join("y" if index in last else letter for index, letter in enumerate(ruled))


def _shown_with(
    movements: Collection[str], light: Intersection, codes: Mapping[Link, str]
) -> list[Link]:
    """Return the links of movements, and those that share a letter with them."""
    indices = {link.index for link in light.links if codes[link] in movements}
    return [link for link in light.links if link.index in indices]


def _check_movements(plan: SignalPlan, known: set[str], source: str) -> None:
    where = f"{source}: light {plan.light!r}"
    listed = {code for phase in plan.phases for code in phase.movements}
    for code in sorted(listed - known):
        raise ScenarioError(
            f"{where}: it has no movement {code!r}; it has {' '.join(sorted(known))}"
        )
    if never := sorted(known - listed):
        raise ScenarioError(
            f"{where}: no phase serves {' '.join(never)}, and vehicles there would wait for ever; "
            "add each to a phase"
        )


def with_plans(scenario: Scenario, plans: Iterable[SignalPlan], source: str) -> Scenario:
    """Return the scenario with plans as the programmes of their lights.

    Args:
        scenario: The scenario; lights without a plan keep their programme, or an earlier plan.
        plans: The plans, one for each light.
        source: Name of their file in errors.

    Raises:
        ScenarioError: A plan is impossible, or names a light that is not an agent.
    """
    network, rules = Network.read(scenario), RightOfWay.of(scenario.network.parse())
    lights = {light.id: light for light in network.intersections}
    name = "plans.add.xml"
    others = tuple(document for document in scenario.additional if document.name != name)
    taken = _programs((scenario.network, *others))
    top, planned = ET.Element("additional"), set[str]()
    for plan in plans:
        if plan.light not in lights:
            raise ScenarioError(
                f"{source}: light {plan.light!r} is not an agent of scenario {scenario.id!r}; its "
                f"agents are {', '.join(lights)}"
            )
        if plan.light in planned:
            raise ScenarioError(f"{source}: two plans for light {plan.light!r}; give it one")
        planned.add(plan.light)
        check_plan(plan, source)
        logic = ET.SubElement(
            top, "tlLogic", id=plan.light, type="static", programID=_free(taken, plan.light),
            offset=f"{plan.offset_s:g}",
        )  # fmt: skip
        for seconds, state in plan_states(plan, lights[plan.light], network, rules, source):
            ET.SubElement(logic, "phase", duration=f"{seconds:.10g}", state=state)
    for document in scenario.additional:
        if document.name == name:
            kept = (
                other
                for other in document.parse()
                if other.tag != "tlLogic" or other.get("id") not in planned
            )
            top.extend(kept)
    untimed = (_without_timetable(document, planned) for document in others)
    return replace(scenario, additional=(*untimed, Document(name, None, xml_bytes(top))))


def _programs(documents: Iterable[Document]) -> set[tuple[str, str]]:
    """Return the light and the id of each programme in some files."""
    return {
        (logic.get("id", ""), logic.get("programID", ""))
        for document in documents
        for part in document.parts()
        for logic in part.iter("tlLogic")
    }


def _free(taken: Container[tuple[str, str]], light: str) -> str:
    """Return an id that no programme of a light has: SUMO refuses two programmes of one id."""
    names = chain((_PROGRAM,), (f"{_PROGRAM}-{number}" for number in count(2)))
    return next(name for name in names if (light, name) not in taken)


def _without_timetable(document: Document, lights: Container[str]) -> Document:
    """Return a file in which no timetable (WAUT) switches the programmes of these lights."""

    def is_timed(element: ET.Element) -> bool:
        return element.tag == "wautJunction" and element.get("junctionID", "") in lights

    def drop(part: ET.Element) -> None:
        part[:] = [element for element in part if not is_timed(element)]

    timed = any(is_timed(element) for part in document.parts() for element in part)
    return document.changed(drop) if timed else document


def programme_plan(light: Intersection, network: Network) -> SignalPlan:
    """Return the plan of a light's own programme, in one ring.

    Every state with green and without yellow begins a phase. The states until the next one are its
    yellow, as long as some light is yellow, and its all-red. Red-amber is part of the all-red.

    Raises:
        ScenarioError: The light has no programme with two greens.
    """
    codes = movement_codes(light, network)
    states = list(light.programme)
    greens = [bool(set(s) & GREEN) and not set(s) & YELLOW for _, s in states]
    if sum(greens) < 2:
        raise ScenarioError(
            f"traffic light {light.id!r}: its programme has fewer than two greens; there is no plan"
        )
    first = greens.index(True)
    phases: list[PlanPhase] = []
    for place in range(len(states)):
        seconds, state = states[(first + place) % len(states)]
        if greens[(first + place) % len(states)]:
            going = (code for link, code in codes.items() if state[link.index] in GREEN)
            served = dict.fromkeys(going)
            phases.append(PlanPhase(1, 1, tuple(served), seconds, 0.0, 0.0))
        else:
            last = phases[-1]
            yellow = seconds if set(state) & AMBER else 0.0
            phases[-1] = replace(
                last,
                split_s=last.split_s + seconds,
                yellow_s=last.yellow_s + yellow,
                all_red_s=last.all_red_s + seconds - yellow,
            )
    begins_s = sum(seconds for seconds, _ in states[:first])
    cycle_s = sum(phase.split_s for phase in phases)
    return SignalPlan(light.id, cycle_s, (light.offset_s + begins_s) % cycle_s, tuple(phases))


def programme_notes(scenario: Scenario, plans: Iterable[SignalPlan], source: str) -> list[str]:
    """Return notes on plans of `programme_plan` that show other states than their programmes.

    A plan says less than a programme: movements of a phase turn yellow together, and one of two
    phases in turn stays green between them.

    Args:
        scenario: The scenario with the programmes.
        plans: The plans, at most one for each light.
        source: Name of their table.
    """
    network, rules = Network.read(scenario), RightOfWay.of(scenario.network.parse())
    notes: list[str] = []
    differing: list[str] = []
    for plan in plans:
        light = network.intersection(plan.light)
        states = _states_or_note(plan, light, network, rules, source, notes)
        if light.times_vary:
            notes.append(
                f"light {plan.light!r}: {light.times_vary}; the plan has the durations of its "
                "phases, and SUMO shows other times"
            )
        elif states and (
            others := _shown_otherwise(plan, states, light, movement_codes(light, network))
        ):
            differing.append(f"{plan.light} ({' '.join(others)})")
    if differing:
        notes.append(
            f"the plan shows other green or yellow than the programme at {', '.join(differing)}: "
            "in a plan all movements of a phase end together, a movement of two phases in turn "
            "stays green between them, red-amber is red, and crossings are green as long as the "
            "phase"
        )
    return notes


def refusal_notes(scenario: Scenario, plans: Iterable[SignalPlan], source: str) -> list[str]:
    """Return a note on each plan that `with_plans` would refuse.

    Args:
        scenario: The scenario.
        plans: The plans, at most one for each light.
        source: Name of their table.
    """
    network, rules = Network.read(scenario), RightOfWay.of(scenario.network.parse())
    notes: list[str] = []
    for plan in plans:
        light = network.intersection(plan.light)
        _states_or_note(plan, light, network, rules, source, notes)
    return notes


def _states_or_note(
    plan: SignalPlan,
    light: Intersection,
    network: Network,
    rules: RightOfWay,
    source: str,
    notes: list[str],
) -> _States:
    """Return the states of a plan; none, and a further note, if `with_plans` would refuse it."""
    try:
        check_plan(plan, source)
        return plan_states(plan, light, network, rules, source)
    except ScenarioError as error:
        notes.append(f"--apply would refuse this plan, so change it first: {error}")
        return ()


def yellow_notes(plans: Iterable[SignalPlan]) -> list[str]:
    """Return a note on phases whose yellow is shorter than practice has it, or none."""
    short = [
        f"{plan.light} (phase {number}: {phase.yellow_s:g} s)"
        for plan in plans
        for number, (phase, stays) in enumerate(
            zip(plan.phases, _staying(_fitted(plan)), strict=True), 1
        )
        if phase.yellow_s < _LEAST_YELLOW_S and set(phase.movements) - stays
    ]
    usual = f"{_LEAST_YELLOW_S:g} to 6 s are usual"
    return [f"yellow is short at {', '.join(short)}; {usual}"] if short else []


def offset_notes(plans: Iterable[SignalPlan]) -> list[str]:
    """Return a note on offsets that are as long as the cycle or longer, or none."""
    long = [
        f"{plan.light} ({plan.offset_s:g} s of a cycle of {plan.cycle_s:g} s: "
        f"{plan.offset_s % plan.cycle_s:g} s)"
        for plan in plans
        if plan.offset_s >= plan.cycle_s
    ]
    told = "whole cycles of the offset count nothing"
    return [f"{told}, at {', '.join(long)}; check the table"] if long else []


_States = Sequence[tuple[float, str]]


def _shown_otherwise(
    plan: SignalPlan, states: _States, light: Intersection, codes: Mapping[Link, str]
) -> list[str]:
    """Return the movements whose green or yellow differs between a plan and the programme.

    "crossings" stands for those of pedestrians.
    """
    cycle_s, later_s = plan.cycle_s, plan.offset_s - light.offset_s
    times = {0.0, *accumulate(seconds for seconds, _ in states)}
    times |= {(end - later_s) % cycle_s for end in accumulate(s for s, _ in light.programme)}
    others: set[str] = set()
    for begin, end in pairwise(sorted(times)):
        if end - begin > _SAME_S:
            middle = (begin + end) / 2
            planned = _state_at(states, middle)
            own = _state_at(light.programme, (middle + later_s) % cycle_s)
            others |= {
                code
                for link, code in codes.items()
                if any(
                    (planned[link.index] in x) != (own[link.index] in x) for x in (GREEN, YELLOW)
                )
            }
            if any((planned[x.index] in GREEN) != (own[x.index] in GREEN) for x in light.crossings):
                others.add("crossings")
    return sorted(others)


def _state_at(states: _States, time_s: float) -> str:
    for seconds, state in states:
        if time_s < seconds:
            return state
        time_s -= seconds
    return states[-1][1]


# --- tables ---------------------------------------------------------------------------------------


def write_plans(path: Path, plans: Iterable[SignalPlan], network: Network) -> None:
    """Write plans as a CSV table, a row for every phase; `read_plans` reads it."""
    names = {
        light.id: intersection_name(light.links, network.streets) for light in network.intersections
    }
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for plan in plans:
        for number, phase in enumerate(plan.phases, 1):
            writer.writerow(
                (
                    plan.light, as_text(names.get(plan.light, "")), f"{plan.cycle_s:g}",
                    f"{plan.offset_s:g}", phase.ring, phase.barrier, number,
                    " ".join(phase.movements) or _NOBODY, f"{phase.split_s:g}",
                    f"{phase.yellow_s:g}", f"{phase.all_red_s:g}",
                )
            )  # fmt: skip
    write_whole(path, text.getvalue().encode("utf-8-sig"))


def read_plans(path: Path) -> tuple[SignalPlan, ...]:
    """Read plans from a CSV table with the columns `COLUMNS`.

    Commas, semicolons or tabs separate the columns.
    ``intersection`` and ``phase`` are for the reader alone and may be missing, as may ``ring`` and
    ``barrier`` (1).

    Raises:
        ScenarioError: The file is missing, a column or value is missing or impossible; the message
            names the line. Or a plan does not fit together.
    """
    text = text_of_table(path)
    reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=delimiter_of(text))
    columns = columns_of(reader, path)
    optional = {"intersection", "phase", "ring", "barrier"}
    needed = [name for name in COLUMNS if name not in optional]
    if missing := [name for name in needed if name not in columns]:
        guess = nearest(missing[0], columns)
        raise ScenarioError(
            f"{path}, line 1: the column {missing[0]} is missing"
            + (f"; is it {guess!r}?" if guess else f"; needed are {', '.join(needed)}")
        )
    for name in columns:
        guess = nearest(name, ("ring", "barrier"))
        if name not in COLUMNS and guess is not None and guess not in columns:
            raise ScenarioError(f"{path}, line 1: column {name!r} is not known; is it {guess!r}?")
    phases: dict[str, list[PlanPhase]] = defaultdict(list)
    frames: dict[str, tuple[float, float]] = {}
    for row in rows_of(reader, path):
        where = f"{path}, line {reader.line_num}"
        if not any((row[name] or "").strip() for name in columns):
            continue  # as a spreadsheet writes below its table
        light = (row["light"] or "").strip()
        if not light:
            raise ScenarioError(f"{where}: light is blank; write it in every row")
        frame = _seconds(row, "cycle_s", where), _seconds(row, "offset_s", where)
        if frames.setdefault(light, frame) != frame:
            raise ScenarioError(
                f"{where}: light {light!r} has another cycle_s or offset_s than in its first "
                "row; a light has one plan"
            )
        phases[light].append(_phase(row, where))
    if not phases:
        raise ScenarioError(f"{path}: no row holds a phase")
    plans = tuple(SignalPlan(light, *frames[light], tuple(own)) for light, own in phases.items())
    for plan in plans:
        check_plan(plan, str(path))
    return plans


def text_of_table(path: Path) -> str:
    """Return the text of a CSV file, unpacked and without a mark of its encoding.

    Raises:
        ScenarioError: It is missing, damaged or not UTF-8.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: is not UTF-8; save it again as CSV in UTF-8") from None


def _phase(row: Mapping[str, str | None], where: str) -> PlanPhase:
    movements = tuple((row["movements"] or "").upper().replace(",", " ").split())
    if not movements:
        raise ScenarioError(
            f"{where}: movements is blank; give some, as in: NBT NBR SBT SBR, or {_NOBODY} for none"
        )
    if movements == (_NOBODY,):
        movements = ()
    return PlanPhase(
        _whole(row, "ring", where),
        _whole(row, "barrier", where),
        movements,
        _seconds(row, "split_s", where),
        _seconds(row, "yellow_s", where),
        _seconds(row, "all_red_s", where),
    )


def _seconds(row: Mapping[str, str | None], key: str, where: str) -> float:
    text = row.get(key)
    value = number_in(text)
    if not 0 <= value <= LONGEST_S:
        raise ScenarioError(f"{where}: {key} = {text!r} is not a time of 0 to {LONGEST_S:g} s")
    return value


def _whole(row: Mapping[str, str | None], key: str, where: str) -> int:
    text = (row.get(key) or "").strip() or "1"
    if not (text.isascii() and text.isdigit() and 1 <= int(text[:3]) <= 99 and len(text) < 3):
        raise ScenarioError(f"{where}: {key} = {text!r} is not a number of 1 to 99")
    return int(text)
