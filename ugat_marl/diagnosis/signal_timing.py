"""Signal timing that differs from the scenario, read off the signal log without statistics."""

from __future__ import annotations

import itertools
import math
from collections import Counter

from ugat_marl.data import Measured
from ugat_marl.diagnosis.thresholds import THRESHOLDS
from ugat_marl.effects import Effect, effect_from
from ugat_marl.scenarios import GREEN, Network, Scenario, SignalLog

IN_THE_LOG = ("yellow_time", "all_red_time")
"""Effects that are read off the signal log. A replay of the log contains them already."""
_AMBER = frozenset("yY")


def timing_effects(scenario: Scenario, network: Network, measured: Measured) -> tuple[Effect, ...]:
    """Return effects for yellow and all-red times of the log that differ from the scenario's.

    Logs with only states of the network's own programme are left out.
    """
    yellow: Counter[float] = Counter()
    red: Counter[float] = Counter()
    controlled = {item.id: item for item in network.intersections}
    for period in measured.periods:
        for tls, log in period.signals.items():
            if tls in controlled and not _own(log, controlled[tls].programme):
                for kind, duration in _clearances(log):
                    (yellow if kind == "y" else red)[round(duration, 1)] += 1
    found: list[Effect] = []
    control = scenario.control
    clearances = (yellow, control.yellow_s), (red, control.all_red_s)
    for name, (seen, now) in zip(IN_THE_LOG, clearances, strict=True):
        total = sum(seen.values())
        if total >= THRESHOLDS.least_clearances:
            value, count = seen.most_common(1)[0]
            if count >= THRESHOLDS.usual_share * total and abs(value - now) > 0.05:
                found.append(effect_from({"name": name, "seconds": value}))
    return tuple(found)


def _own(log: SignalLog, programme: tuple[tuple[float, str], ...]) -> bool:
    """Return True if a log shows only states of the network's own programme."""
    return {state for _, state in log} <= {state for _, state in programme}


def _clearances(log: SignalLog) -> list[tuple[str, float]]:
    """Return durations in s of yellow (``y``), and from its end to the next green (``r``).

    Other links may be green at the same time. Red-yellow does not count as yellow.
    """
    found: list[tuple[str, float]] = []
    began = ended = math.nan
    for (_, before), (time, state) in itertools.pairwise(log):
        pairs = list(zip(before, state, strict=False))
        if any(new in _AMBER and old not in _AMBER for old, new in pairs):
            began = time
        if any(old in _AMBER and new not in _AMBER for old, new in pairs):
            found.append(("y", time - began))
            ended = time
        if any(new in GREEN and old not in GREEN for old, new in pairs):
            found.append(("r", time - ended))
            ended = math.nan
    return [(kind, duration) for kind, duration in found if duration == duration]
