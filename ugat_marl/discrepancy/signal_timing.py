"""Signal timing that differs from the scenario's: read off the log, no statistics needed."""

from __future__ import annotations

from collections import Counter

from ugat_marl.effects import Effect, effect_from
from ugat_marl.measured.data import Measured, SignalLog
from ugat_marl.network import Network
from ugat_marl.scenario import Scenario
from ugat_marl.signals import GREEN, YELLOW

_LEAST = 20
"""Clearances that must have been seen."""
_USUAL = 0.8
"""Share of them that must agree."""


def timing_effects(scenario: Scenario, network: Network, measured: Measured) -> tuple[Effect, ...]:
    """Yellow and all-red times of the log, where they are not those of the scenario's control.

    A log of the network's own programme is compared with that programme instead.
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
    for name, seen, now in (
        ("yellow_time", yellow, control.yellow_s),
        ("all_red_time", red, control.all_red_s),
    ):
        total = sum(seen.values())
        if total >= _LEAST:
            value, count = seen.most_common(1)[0]
            if count >= _USUAL * total and abs(value - now) > 0.05:
                found.append(effect_from({"name": name, "seconds": value}))
    return tuple(found)


def _own(log: SignalLog, programme: tuple[tuple[float, str], ...]) -> bool:
    """Whether a log shows only states of the network's own programme."""
    return {state for _, state in log} <= {state for _, state in programme}


def _clearances(log: SignalLog) -> list[tuple[str, float]]:
    """Durations of yellow, and of the time without green or yellow behind it."""
    kinds = [(time, _kind(state)) for time, state in log]
    merged: list[tuple[float, str]] = []
    for time, kind in kinds:
        if not merged or merged[-1][1] != kind:
            merged.append((time, kind))
    found: list[tuple[str, float]] = []
    for index in range(1, len(merged) - 1):
        time, kind = merged[index]
        duration = merged[index + 1][0] - time
        if kind == "y":
            found.append(("y", duration))
            if merged[index + 1][1] != "r":
                found.append(("r", 0.0))
        elif kind == "r" and merged[index - 1][1] == "y":
            found.append(("r", duration))
    return found


def _kind(state: str) -> str:
    """Yellow while any link has it: links that stay green do not end the clearance of others."""
    if any(letter in YELLOW for letter in state):
        return "y"
    return "G" if any(letter in GREEN for letter in state) else "r"
