"""Named physical effects: values that turn a scenario into another scenario.

The same value makes a "real" domain different from the simulation, is what a diagnosis names, and
is what repairs a model.
"""

from ugat_marl.effects.base import Effect, Parameter
from ugat_marl.effects.settings import (
    ALIASES,
    SETTINGS,
    Domain,
    apply_effects,
    describe,
    effect_from,
    in_domain,
    known_effects,
    load,
    parse_domain,
)
from ugat_marl.effects.vehicles import (
    Acceleration,
    Deceleration,
    EmergencyDeceleration,
    StartupDelay,
    VehicleEffect,
)

__all__ = [
    "ALIASES",
    "SETTINGS",
    "Acceleration",
    "Deceleration",
    "Domain",
    "Effect",
    "EmergencyDeceleration",
    "Parameter",
    "StartupDelay",
    "VehicleEffect",
    "apply_effects",
    "describe",
    "effect_from",
    "in_domain",
    "known_effects",
    "load",
    "parse_domain",
]
