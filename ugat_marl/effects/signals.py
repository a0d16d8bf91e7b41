"""Effects on traffic lights: traffic that starts late, and other clearance times."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import ClassVar

from ugat_marl.effects.base import (
    EVERYWHERE,
    Effect,
    ExaminedStrengths,
    NumberParameter,
    TextParameter,
)
from ugat_marl.effects.documents import edit
from ugat_marl.effects.places import network_places
from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import LateGreenMemory as Held
from ugat_marl.scenarios import (
    Scenario,
    Segment,
    Withheld,
    parse_time,
    seconds_text,
    validate_settings,
    with_late_green,
    withheld_log,
)

QUEUE_START_S = 2.0
"""Start-up time in s that the mesoscopic model lacks, because its queues move at once."""


@dataclass(frozen=True)
class LateGreen(Effect):
    """Every link that turns green stays red for `seconds` first: start-up lost time.

    Controllers do not see it: they command and observe the full green. The scenario has it as
    `late_green_s`, and the environment applies it to the signals it sends to SUMO.
    """

    name: ClassVar[str] = "late_green"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 30.0)}
    texts: ClassVar[dict[str, TextParameter]] = {
        "place": TextParameter("traffic light", everywhere=True)
    }
    # Tenths: fractions of a simulation step are spread over many greens.
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((2.0,), 0.0, 0.3, step=0.1)
    place: str
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set the late green of one traffic light, or of all of them.

        Raises:
            UnknownNameError: No such traffic light.
        """
        settings = scenario.settings.model_dump()
        tables = {
            tls: dict(intersection) for tls, intersection in settings["intersections"].items()
        }
        if self.place == EVERYWHERE:
            settings["control"] = {**settings["control"], "late_green_s": self.seconds}
            for table in tables.values():
                table.pop("late_green_s", None)
        else:
            places = network_places(scenario)
            places.check(self.name, "traffic light", self.place, places.lights)
            tables[self.place] = {**tables.get(self.place, {}), "late_green_s": self.seconds}
        settings["intersections"] = {
            tls: intersection for tls, intersection in tables.items() if intersection
        }
        return replace(
            scenario,
            settings=validate_settings(settings, f"scenario {scenario.id!r}"),
            applied=(*scenario.applied, str(self)),
        )


@dataclass(frozen=True)
class YellowTime(Effect):
    """The yellow of controlled signals lasts `seconds`, in whole simulation steps."""

    name: ClassVar[str] = "yellow_time"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 20.0)}
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set `control.yellow_s`."""
        return _with_control(scenario, self, "yellow_s", self.seconds)


@dataclass(frozen=True)
class AllRedTime(Effect):
    """The all-red of controlled signals lasts `seconds`, in whole simulation steps."""

    name: ClassVar[str] = "all_red_time"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 20.0)}
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set `control.all_red_s`."""
        return _with_control(scenario, self, "all_red_s", self.seconds)


def late_greens(scenario: Scenario) -> dict[str, float]:
    """Return the late green of traffic lights in s, without those that have none."""
    start_s = QUEUE_START_S if scenario.settings.is_mesoscopic else 0.0
    general = scenario.control.late_green_s + start_s
    lights = network_places(scenario).lights if general else ()
    tables = scenario.settings.intersections
    late = {tls: scenario.late_green_s(tls) + start_s for tls in (*lights, *tables)}
    return {tls: seconds for tls, seconds in late.items() if seconds > 0}


def with_late_green_programmes(
    scenario: Scenario, red: Mapping[str, Withheld] | None = None
) -> Scenario:
    """Return the scenario with late green in SUMO's own programmes, for the simulator only.

    The phases of agents are read from the unchanged scenario. A programme has whole simulation
    steps, so the late green is rounded to them. Programmes that follow the traffic have the red of
    single links at the beginning of a green alone, since their greens have no fixed lengths, and
    those that jump between their phases have none.

    Args:
        scenario: The scenario.
        red: Traffic light to the red of its single links, beside late green.

    Raises:
        ScenarioError: A programme jumps between its phases, so they cannot be split for late green.
    """
    late, red = late_greens(scenario), red or {}
    if not late and not red:
        return scenario
    step = scenario.settings.step_length_s
    queues = QUEUE_START_S if scenario.settings.is_mesoscopic else 0.0

    def change(root: ET.Element) -> bool:
        logics = [x for x in root.iter("tlLogic") if x.get("id") in late or x.get("id") in red]
        for logic in logics:
            name = logic.get("id", "")
            seconds = late.get(name, 0.0)
            whole = round(seconds / step) * step
            if _jumps(logic):
                if seconds > queues:  # of queues alone nobody asked for it
                    raise _too_late(logic, scenario)
            elif name in red and logic.get("type", "static") == "static":
                _withhold(logic, whole, red[name], scenario)
            else:
                own = [whole + begin_s for begin_s in red[name].begin_s] if name in red else whole
                _delay(logic, own, step)
        return bool(logics)

    return replace(
        scenario,
        network=edit((scenario.network,), change, "<tlLogic")[0],
        additional=edit(scenario.additional, change, "<tlLogic"),
    )


def _with_control(scenario: Scenario, effect: Effect, key: str, seconds: float) -> Scenario:
    if scenario.settings.is_mesoscopic:
        raise ScenarioError(
            f"{effect}: the queue model shows its clearance as red; put {effect.name} before it"
        )
    step = scenario.settings.step_length_s
    changed = scenario.with_control(**{key: math.floor(seconds / step + 0.5) * step})
    return replace(changed, applied=(*scenario.applied, str(effect)))


def _delay(logic: ET.Element, late_s: float | Sequence[float], step_s: float) -> None:
    """Split every phase of a programme in which something turns green."""
    phases = logic.findall("phase")
    if not late_s or not phases:
        return
    cycle = _cycle(phases)
    held, _ = with_late_green(cycle, late_s, step_s, Held.after(cycle[-1][1]))
    for phase, segment in zip(phases, cycle, strict=True):
        held, shown = with_late_green([segment], late_s, step_s, held)
        place = list(logic).index(phase)
        for extra, (seconds, state) in enumerate(shown[:-1]):
            attributes = {"duration": seconds_text(seconds), "state": state}
            logic.insert(place + extra, ET.Element("phase", attributes))
        lost = sum(seconds for seconds, _ in shown[:-1])
        phase.set("state", shown[-1][1] if shown else segment[1])
        for key in ("duration", "minDur", "maxDur"):
            if key in phase.attrib:
                left = max(parse_time(phase.get(key, "0")) - lost, step_s)
                phase.set(key, seconds_text(left))


def _withhold(logic: ET.Element, late_s: float, red: Withheld, scenario: Scenario) -> None:
    """Show red to single links in a programme of fixed times, as an environment does in its plans.

    Decisions are counted from the start of the first cycle, and the second cycle is kept: in it
    every green has a begin.
    """
    phases = logic.findall("phase")
    cycle = _cycle(phases)
    *begins, length = accumulate((seconds for seconds, _ in cycle), initial=0.0)
    if length <= 0:
        return
    first = [(begin, state) for begin, (_, state) in zip(begins, cycle, strict=True)]
    log = [*first, *((length + begin, state) for begin, state in first)]
    step, decision_s = scenario.settings.step_length_s, scenario.control.decision_interval_s
    shown = withheld_log(log, red, late_s, step, decision_s, 2 * length)
    before = [state for time, state in shown if time <= length]
    second = [(0.0, before[-1])]
    second += [(time - length, state) for time, state in shown if length < time < 2 * length]
    for phase in phases:
        logic.remove(phase)
    for (begin, state), (end, _) in pairwise([*second, (length, "")]):
        ET.SubElement(logic, "phase", {"duration": seconds_text(end - begin), "state": state})


def _cycle(phases: Sequence[ET.Element]) -> list[Segment]:
    return [(parse_time(phase.get("duration", "0")), phase.get("state", "")) for phase in phases]


def _too_late(logic: ET.Element, scenario: Scenario) -> ScenarioError:
    return ScenarioError(
        f"scenario {scenario.id!r}: late green in the programme of traffic light "
        f"{logic.get('id')!r}, whose phases name their successors (next=...), is not possible"
    )


def _jumps(logic: ET.Element) -> bool:
    return any("next" in phase.attrib for phase in logic.iter("phase"))
