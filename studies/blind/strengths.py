"""Strengths of hidden effects: small, medium and large, effect by effect.

The distance from the value without the effect is half as large for small and twice as large for
large as for medium. An effect that only counts can show is, at medium strength, large enough to be
seen in the counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from ugat_marl.scenarios import Scenario

Strength = Literal["small", "medium", "large"]
COUNTED = 6.0
"""Least size of a medium change of counts, in standard errors of the count."""
COUNTED_HOURS = 3.0
"""Hours of counting: the fitted periods of five periods of one hour."""
STRENGTHS: tuple[Strength, ...] = ("small", "medium", "large")
SCALE: Mapping[str, float] = {"small": 0.5, "medium": 1.0, "large": 2.0}

Family = Literal["vehicles", "signals", "demand", "road", "detectors", "measurement"]
Where = Literal[
    "everywhere", "light", "origin", "turn", "closable", "lane", "edge", "detector", "pair",
    "model", "advance", "group", "beside",
]  # fmt: skip
"""Kind of place that is drawn for an effect."""


@dataclass(frozen=True)
class Kind:
    """Form in which an effect of the library is hidden.

    Attributes:
        family: Family of the effect; a pair has effects of two families.
        where: Kind of its place.
        parameter: Field that has a strength; "" if only the window or nothing has one.
        nominal: Value of the field without the effect.
        medium: Value of the field at medium strength.
        least: Smallest value drawn.
        greatest: Greatest value drawn.
        either: True if the value may also lie on the other side of the nominal value.
        window_s: Seconds of its window at medium strength; 0 for no window.
        fixed: Fields with fixed values.
        choices: Values of a second text field, one of which is drawn.
        strengths: Strengths that differ from each other.
    """

    family: Family
    where: Where
    parameter: str = ""
    nominal: float = 0.0
    medium: float = 0.0
    least: float = -1e9
    greatest: float = 1e9
    either: bool = False
    window_s: float = 0.0
    fixed: Mapping[str, float] | None = None
    choices: tuple[str, ...] = ()
    strengths: tuple[Strength, ...] = STRENGTHS

    def value(
        self, strength: str, other_side: bool = False, per_hour: float | None = None
    ) -> float:
        """Return the value of the field at a strength.

        Args:
            strength: Strength: small, medium or large.
            other_side: True for a value on the other side of the nominal one, if allowed.
            per_hour: Vehicles per hour that show the effect, if its field is a share of them.
        """
        distance = self.medium - self.nominal
        if per_hour is not None:
            distance = max(distance, COUNTED / math.sqrt(COUNTED_HOURS * per_hour))
        distance *= SCALE[strength]
        value = self.nominal + (-distance if other_side and self.either else distance)
        return round(min(max(value, self.least), self.greatest), 4)

    def window(self, strength: str) -> float:
        """Return the seconds of the window; they are the strength if no field has one."""
        return self.window_s if self.parameter else self.window_s * SCALE[strength]


MODELS = ("IDM", "EIDM", "W99")
"""Driver models that are hidden."""

KINDS: Mapping[str, Kind] = {
    "acceleration": Kind("vehicles", "everywhere", "mps2", 2.6, 1.6, least=0.8),
    "deceleration": Kind("vehicles", "everywhere", "mps2", 4.5, 2.5, least=1.5),
    "startup_delay": Kind("vehicles", "everywhere", "seconds", 0.0, 1.0),
    "headway": Kind("vehicles", "everywhere", "seconds", 1.0, 1.45),
    "min_gap": Kind("vehicles", "everywhere", "metres", 2.5, 3.5),
    "imperfection": Kind("vehicles", "everywhere", "sigma", 0.5, 0.8, greatest=1.0),
    "reaction_step": Kind(
        "vehicles", "everywhere", "seconds", 1.0, 2.0, strengths=("medium", "large")
    ),
    "desired_speed": Kind("vehicles", "everywhere", "factor", 1.0, 0.88, either=True),
    "speed_spread": Kind("vehicles", "everywhere", "deviation", 0.1, 0.2),
    "heavy_share": Kind("vehicles", "everywhere", "share", 0.0, 0.12),
    "yellow_running": Kind("vehicles", "everywhere", "seconds", 0.0, 2.0, greatest=3.0),
    "red_running": Kind("vehicles", "everywhere", "seconds", 0.0, 1.5),
    "gap_acceptance": Kind("vehicles", "everywhere", "seconds", 1.0, 2.5),
    "lane_discipline": Kind("vehicles", "everywhere", "strategic", 1.0, 0.4, least=0.0),
    "driver_model": Kind("vehicles", "model", strengths=("medium",)),
    "late_green": Kind("signals", "light", "seconds", 0.0, 2.0),
    "yellow_time": Kind("signals", "everywhere", "seconds", 3.0, 5.0),
    "all_red_time": Kind("signals", "everywhere", "seconds", 2.0, 4.0),
    "demand_level": Kind("demand", "origin", "factor", 1.0, 1.15, least=0.4, either=True),
    "demand_surge": Kind("demand", "origin", "factor", 1.0, 1.6, window_s=1200.0),
    "demand_timing": Kind("demand", "origin", "seconds", 0.0, 300.0, either=True),
    "turning": Kind("demand", "turn", "share", 0.0, 0.2),
    "lane_closure": Kind("road", "closable", window_s=900.0),
    "parking": Kind("road", "lane", "per_hour", 0.0, 15.0, fixed={"dwell_s": 40.0}),
    "local_speed": Kind("road", "edge", "factor", 1.0, 0.7, least=0.3),
    "undercount": Kind("detectors", "detector", "share", 0.0, 0.15),
    "signal_clock": Kind("detectors", "light", "seconds", 0.0, 2.0, either=True),
    "clock_drift": Kind("detectors", "light", "seconds_per_hour", 0.0, 4.0, either=True),
    "stuck": Kind("detectors", "detector", window_s=900.0),
    "dropout": Kind("detectors", "detector", window_s=900.0),
    "swapped": Kind("detectors", "pair", strengths=("medium",)),
}
"""Every effect of the library but `emergency_deceleration`.

That effect acts only in an emergency, so usual driving does not show it.
"""

ERRORS: Mapping[str, Kind] = {
    "detector_offset": Kind("measurement", "advance", "metres", 0.0, 6.0, either=True),
    "detector_zone": Kind("measurement", "group", "metres", 0.0, 2.0),
    "detector_extension": Kind(
        "measurement", "group", "seconds", 0.0, 0.6, choices=("split", "merged")
    ),
    "detector_speeds": Kind(
        "measurement", "group", choices=("front", "mean"), strengths=("medium",)
    ),
    "detector_pulse": Kind("measurement", "group", "seconds", 0.05, 0.1),
    "detector_splash": Kind("measurement", "beside", "share", 0.0, 0.1),
}
"""Every error of measurement. Offsets of loops at the stop line would lie behind it or beyond the
queue's first vehicle, so that only those of advance loops are drawn."""

ALL_KINDS: Mapping[str, Kind] = {**KINDS, **ERRORS}


def nominal_of(name: str, scenario: Scenario) -> dict[str, float]:
    """Return the value of an effect's field without the effect, in a scenario."""
    kind = ALL_KINDS.get(name)
    if kind is None or not kind.parameter:
        return {}
    control, step = scenario.control, scenario.settings.step_length_s
    own = {
        "yellow_time": control.yellow_s,
        "all_red_time": control.all_red_s,
        "reaction_step": step,
    }
    return {kind.parameter: own.get(name, kind.nominal)}
