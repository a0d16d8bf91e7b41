"""Yellow and all-red times that the signal log shows by itself."""

from __future__ import annotations

import itertools
import math
from collections import Counter

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import Effect, effect_from_record, known_effects
from ugat_marl.scenarios import AMBER, GREEN, Network, Scenario, SignalLog

IN_THE_LOG = ("yellow_time", "all_red_time")
"""Effects that are read off the signal log. A replay of the log contains them already."""


def timing_effects(
    scenario: Scenario, network: Network, measured: MeasuredData, thresholds: Thresholds
) -> tuple[Effect, ...]:
    """Return effects for yellow and all-red times of the log that differ from the scenario's.

    Logs that show the network's own programme, its states and its clearances, are left out. So are
    times that no clearance has: a red of 22 s is a phase of others, such as pedestrians.
    """
    seen: dict[str, Counter[float]] = {name: Counter() for name in IN_THE_LOG}
    possible = {name: known_effects()[name].ranges["seconds"] for name in IN_THE_LOG}
    controlled = {intersection.id: intersection for intersection in network.intersections}
    for period in measured.periods:
        for tls, log in period.signals.items():
            if tls in controlled and not _own(log, controlled[tls].programme, thresholds):
                for name, duration in _clearances(log):
                    if possible[name].holds(duration):
                        seen[name][round(duration, 1)] += 1
    effects: list[Effect] = []
    clearances = (scenario.control.yellow_s, scenario.control.all_red_s)
    for name, now in zip(IN_THE_LOG, clearances, strict=True):
        total = seen[name].total()
        if total >= thresholds.least_clearances:
            value, count = seen[name].most_common(1)[0]
            if (
                count >= thresholds.usual_share * total
                and abs(value - now) > thresholds.least_timing_s
            ):
                effects.append(effect_from_record({"name": name, "seconds": value}))
    return tuple(effects)


def _own(log: SignalLog, programme: tuple[tuple[float, str], ...], thresholds: Thresholds) -> bool:
    """Return True if a log shows the states and clearances of the network's own programme."""
    if not {state for _, state in log} <= {state for _, state in programme}:
        return False
    twice = (*programme, *programme)
    begins = itertools.accumulate((seconds for seconds, _ in twice), initial=0.0)
    own = _clearances(tuple(zip(begins, (state for _, state in twice), strict=False)))
    shown = _clearances(log[1:])  # the first state may have begun before the log
    alike = sum(
        any(kind == k and abs(duration - d) <= thresholds.least_timing_s for k, d in own)
        for kind, duration in shown
    )
    return alike >= thresholds.usual_share * len(shown)


def _clearances(log: SignalLog) -> list[tuple[str, float]]:
    """Return durations in s of yellow and all-red, by the effect that would set them.

    All-red is from the end of yellow to the next green; other links may be green at the same time.
    With a single green there is none: what comes in between is a phase of others. Red-yellow does
    not count as yellow.
    """
    yellow, all_red = IN_THE_LOG
    greens = {tuple(link in GREEN for link in state) for _, state in log}
    alone = sum(map(any, greens)) < 2
    durations: list[tuple[str, float]] = []
    began: dict[int, float] = {}  # by link, since yellows of two rings overlap
    ended = math.nan
    for (_, before), (time_s, state) in itertools.pairwise(log):
        pairs = list(zip(before, state, strict=False))
        began |= {
            link: time_s
            for link, (old, new) in enumerate(pairs)
            if new in AMBER and old not in AMBER
        }
        over = [link for link, (old, new) in enumerate(pairs) if old in AMBER and new not in AMBER]
        if over:
            begins = {began[link] for link in over if link in began}
            durations += [(yellow, time_s - begin_s) for begin_s in sorted(begins)]
            ended = time_s
        if any(new in GREEN and old not in GREEN for old, new in pairs):
            if not alone:
                durations.append((all_red, time_s - ended))
            ended = math.nan
    return [(name, duration) for name, duration in durations if duration == duration]
