"""Words for what a diagnosis speaks of: the same in its sentences, in a terminal and on a page."""

from __future__ import annotations

from collections.abc import Sequence

STATISTICS = {
    "lost": "green begins until 1st queued vehicle is across",
    "lost_trend": "time to cross of 1st: change over the period",
    "gap2": "gap, 1st to 2nd queued vehicle",
    "gap3": "gap, 2nd to 3rd",
    "gap4-5": "gaps before 4th and 5th",
    "gap6-8": "gaps before 6th to 8th",
    "gap9+": "gaps before 9th and later",
    "gap_spread": "distance of queue gaps from 2 s",
    "gap_short": "share of queue gaps below 1.7 s",
    "gap_long": "share of queue gaps above 2.6 s",
    "gap_permitted": "queue gaps where green yields",
    "speed1": "speed of 1st queued vehicle",
    "speed2": "speed of 2nd queued vehicle",
    "speed3": "speed of 3rd queued vehicle",
    "speed4-5": "speed of 4th and 5th",
    "speed6-8": "speed of 6th to 8th",
    "over1": "time over detector, 1st, from green",
    "over2-3": "time over detector, 2nd and 3rd",
    "over4+": "time over detector, 4th and later",
    "queued": "share of greens that begin with a queue",
    "discharged": "queued vehicles per green",
    "platoon_gap": "gap in moving platoons",
    "platoon_short": "share of platoon gaps below 1.6 s",
    "platoon_middle": "share of platoon gaps below 2.2 s",
    "platoon_time": "time over detector in platoons",
    "free_speed": "free speed",
    "free_speed_spread": "distance of free speeds from the limit",
    "free_fast": "share of free vehicles 5 % above the limit",
    "free_time": "time over detector, free vehicles",
    "red_speed": "speed of those who approach red",
    "red_slow": "share of slow ones who approach red",
    "red_time": "time over detector, approaching red",
    "yellow_crossings": "vehicles per yellow",
    "late_crossings": "vehicles per change, first 2 s of red",
    "red_crossings": "vehicles per change, later in red",
    "last_crossing": "crossings after green: how late",
    "vehicle_length": "length of vehicles",
    "long_vehicles": "share of vehicles above 8 m",
    "occupied_in_red": "advance detector occupied in red",
    "occupied_in_green": "advance detector occupied in green",
    "queue_over": "share of greens with queue on advance detector",
    "count_advance": "flow at advance detectors",
    "count_stop": "flow at stop detectors",
    "count_exit": "flow at exit detectors",
    "kept_to_stop": "vehicles at stop per vehicle at advance",
    "kept_to_exit": "vehicles at exit per vehicle at stop",
    "occupied": "occupied time of advance detector",
}
"""What the statistics are, in words; those in time have " in time" behind their names."""


def statistic(name: str) -> str:
    """A statistic in words; its own name where none are known."""
    base = name.removesuffix(" in time")
    return STATISTICS.get(base, base) + (" in some stretch of time" if base != name else "")


def clock(seconds: float) -> str:
    """A time of the scenario's clock as h:mm:ss."""
    whole = round(seconds)
    sign, whole = ("-" if whole < 0 else ""), abs(whole)
    return f"{sign}{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def amount(field: str, value: float, unit: str) -> str:
    """A number of an effect as it follows the effect's name: `` of 1.4 s``, `` × 0.8``."""
    if field == "factor":
        return f" × {value:.3g}"
    if field == "share":
        return f" of {100 * value:.3g} %"
    return f" of {value:.3g} {unit.replace('^2', '²')}".rstrip()


def listed(items: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, (", ".join(items[:-1]), *items[-1:])))
