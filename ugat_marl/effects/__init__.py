"""Named physical effects: values that turn a scenario into another scenario.

The same value makes a "real" domain different from the simulation, is what a diagnosis names, and
is what repairs a model.
"""

from ugat_marl.effects.base import EVERYWHERE, Effect, Parameter, Text
from ugat_marl.effects.demand import DemandLevel, DemandSurge, DemandTiming
from ugat_marl.effects.detectors import (
    ClockDrift,
    DetectorEffect,
    Dropout,
    SignalClock,
    Stuck,
    Swapped,
    Undercount,
    observed,
    owners,
)
from ugat_marl.effects.fleet import DesiredSpeed, HeavyShare, SpeedSpread
from ugat_marl.effects.roads import LaneClosure, LocalSpeed, Parking, parked_at_other_times
from ugat_marl.effects.settings import (
    ALIASES,
    SETTINGS,
    Domain,
    apply_effects,
    describe,
    detector_effects,
    effect_from,
    in_domain,
    known_effects,
    load,
    parse_domain,
    scenario_of,
)
from ugat_marl.effects.signals import AllRedTime, LateGreen, YellowTime
from ugat_marl.effects.turning import Turning
from ugat_marl.effects.vehicles import (
    Acceleration,
    Deceleration,
    DriverModel,
    EmergencyDeceleration,
    GapAcceptance,
    Headway,
    Imperfection,
    LaneDiscipline,
    MinGap,
    ReactionStep,
    RedRunning,
    StartupDelay,
    VehicleEffect,
    YellowRunning,
)

__all__ = [
    "ALIASES",
    "EVERYWHERE",
    "SETTINGS",
    "Acceleration",
    "AllRedTime",
    "ClockDrift",
    "Deceleration",
    "DemandLevel",
    "DemandSurge",
    "DemandTiming",
    "DesiredSpeed",
    "DetectorEffect",
    "Domain",
    "DriverModel",
    "Dropout",
    "Effect",
    "EmergencyDeceleration",
    "GapAcceptance",
    "Headway",
    "HeavyShare",
    "Imperfection",
    "LaneClosure",
    "LaneDiscipline",
    "LateGreen",
    "LocalSpeed",
    "MinGap",
    "Parameter",
    "Parking",
    "ReactionStep",
    "RedRunning",
    "SignalClock",
    "SpeedSpread",
    "StartupDelay",
    "Stuck",
    "Swapped",
    "Text",
    "Turning",
    "Undercount",
    "VehicleEffect",
    "YellowRunning",
    "YellowTime",
    "apply_effects",
    "describe",
    "detector_effects",
    "effect_from",
    "in_domain",
    "known_effects",
    "load",
    "observed",
    "owners",
    "parked_at_other_times",
    "parse_domain",
    "scenario_of",
]
