"""Table of all effects by name, and effects from the records of a scenario file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from ugat_marl.effects.actuators import ACTING
from ugat_marl.effects.base import EVERYWHERE, Effect
from ugat_marl.effects.demand import DemandLevel, DemandSurge, DemandTiming
from ugat_marl.effects.detection import (
    DetectorExtension,
    DetectorOffset,
    DetectorPulse,
    DetectorSpeeds,
    DetectorSplash,
    DetectorZone,
)
from ugat_marl.effects.detectors import (
    ClockDrift,
    Dropout,
    SignalClock,
    Stuck,
    Swapped,
    Undercount,
)
from ugat_marl.effects.engine import BlockerPatience, QueueModel, Reach
from ugat_marl.effects.fleet import DesiredSpeed, HeavyShare, SpeedSpread
from ugat_marl.effects.objectives import JUDGING
from ugat_marl.effects.roads import Incident, LaneClosure, LocalSpeed, Parking
from ugat_marl.effects.sensors import OBSERVATION_EFFECTS
from ugat_marl.effects.service import LaneService
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
    YellowRunning,
)
from ugat_marl.errors import OptionError, ScenarioError, UgatMarlError, UnknownNameError
from ugat_marl.scenarios import Scenario, parse_decimal, read_scenario

_MEASURABLE: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (
        Acceleration, Deceleration, EmergencyDeceleration, StartupDelay, Headway, MinGap,
        Imperfection, ReactionStep, DesiredSpeed, SpeedSpread, YellowRunning, RedRunning,
        GapAcceptance, LaneDiscipline, HeavyShare, DriverModel,
        LateGreen, YellowTime, AllRedTime,
        DemandLevel, DemandSurge, DemandTiming, Turning,
        LaneClosure, Parking, LocalSpeed,
        Undercount, SignalClock, ClockDrift, Stuck, Dropout, Swapped,
    )
}  # fmt: skip


_OF_MEASUREMENT: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (
        DetectorExtension, DetectorOffset, DetectorZone, DetectorSpeeds, DetectorPulse,
        DetectorSplash,
    )
}  # fmt: skip
ON_CONTROLLERS: dict[str, type[Effect]] = {
    kind.name: kind for kind in (*OBSERVATION_EFFECTS, *ACTING, *JUDGING, LaneService)
}
"""Effects on controllers by name; no diagnosis looks for them."""
_OTHERS: dict[str, type[Effect]] = {
    kind.name: kind for kind in (Incident, QueueModel, BlockerPatience, Reach)
}

EFFECTS: dict[str, type[Effect]] = {
    **_MEASURABLE, **_OF_MEASUREMENT, **ON_CONTROLLERS, **_OTHERS
}  # fmt: skip
"""Effects by name."""


def known_effects() -> Mapping[str, type[Effect]]:
    """Return the effects that a diagnosis can find, by name: traffic, signals, detectors."""
    return dict(_MEASURABLE)


def measurement_effects() -> Mapping[str, type[Effect]]:
    """Return the errors of measurement by name; a diagnosis fits them before other effects."""
    return dict(_OF_MEASUREMENT)


def effect_from_record(record: Mapping[str, Any], where: str = "") -> Effect:
    """Return an effect from its name and parameters, as in ``[[effects]]`` of a scenario file.

    Args:
        record: ``{"name": ..., parameter: value, ...}``.
        where: Text for errors that names the place of the record.

    Raises:
        UnknownNameError: The effect or a parameter does not exist.
        OptionError: A parameter is missing or outside its range.
    """
    values = dict(record)
    name = str(values.pop("name", ""))
    if name not in EFFECTS:
        raise UnknownNameError("effect", name, EFFECTS, where and f"It stands{where}.")
    kind = EFFECTS[name]
    parameters = [field.name for field in fields(kind)]
    for key in values:
        if key not in parameters:
            raise UnknownNameError(
                f"parameter of effect {name!r}:", key, parameters, where and f"It stands{where}."
            )
    if missing := [key for key in parameters if key not in values]:
        raise OptionError(f"effect {name!r}{where}: parameter {missing[0]!r} is missing")
    return kind(**values)


def effect_from_text(text: str) -> Effect:
    """Return the effect of a text ``name=value,value,...``, the form that `str` of an effect gives.

    Raises:
        UnknownNameError: The effect does not exist.
        OptionError: There are too many or too few values, or an impossible one.
    """
    name, _, values = (part.strip() for part in text.partition("="))
    name = name.lower()
    if name not in EFFECTS:
        raise UnknownNameError("effect", name, EFFECTS)
    kind = EFFECTS[name]
    parameters = [field.name for field in fields(kind)]
    parts = [part.strip() for part in values.split(",")]
    if len(parts) != len(parameters):
        raise OptionError(
            f"effect {name!r} takes {len(parameters)} value(s), {', '.join(parameters)}; "
            f"got {values!r}{_hint(kind, parameters, parts)}"
        )
    given: dict[str, Any] = {}
    for parameter, part in zip(parameters, parts, strict=True):
        try:
            given[parameter] = part if parameter in kind.texts else parse_decimal(part)
        except ValueError:
            raise OptionError(f"effect {name!r}: {part!r} is not a number") from None
    return kind(**given)


def _hint(kind: type[Effect], parameters: Sequence[str], parts: Sequence[str]) -> str:
    """Return what the parts of a text lack, as the end of an error; "" if there are too many."""
    left = [part for part in parts if part]
    completed: list[str] = []
    missing: list[str] = []
    for parameter in parameters:
        if left and _is_number(left[0]) != (parameter in kind.texts):
            completed.append(left.pop(0))
        else:
            completed.append(EVERYWHERE)
            missing.append(parameter)
    if left:
        return ""
    if all(name in kind.texts and kind.texts[name].everywhere for name in missing):
        return f"; everywhere it is {kind.name}={','.join(completed)}"
    return f"; missing: {', '.join(missing)}"


def _is_number(text: str) -> bool:
    try:
        parse_decimal(text)
    except ValueError:
        return False
    return True


def apply_effects(scenario: Scenario, effects: Iterable[Effect]) -> Scenario:
    """Apply effects one after the other.

    Raises:
        ScenarioError: The files of the scenario hold something else where a number should be.
    """
    for apply_all, group in groupby(effects, lambda effect: effect.apply_all):
        applied = list(group)
        try:
            scenario = apply_all(scenario, applied)
        except (ValueError, ArithmeticError) as error:
            if isinstance(error, UgatMarlError):
                raise
            raise ScenarioError(
                f"scenario {scenario.id!r}: {' + '.join(map(str, applied))} cannot be applied, "
                f"because a value in its files is missing, not a number, or zero ({error}); "
                "correct the file"
            ) from error
    return scenario


def load_scenario(name: str | Path | Scenario, played_s: float | None = None) -> Scenario:
    """Load a scenario and apply the effects listed in its file (see `read_scenario`).

    Effects on controllers and detectors stay listed in its settings: the environment applies the
    first, and whoever measures the scenario the others.

    Args:
        name: Id or path of a scenario, or a scenario.
        played_s: Length of the episodes that will be played, s; None for that of the file. Effects
            on demand and on roads last as long. The scenario keeps the length of its file: give
            the environment the same number as ``duration_s``.
    """
    scenario = name if isinstance(name, Scenario) else read_scenario(name)
    where = f" in scenario {scenario.id!r}"
    effects = [effect_from_record(record, where) for record in scenario.settings.effects]
    plain = replace(scenario, settings=scenario.settings.model_copy(update={"effects": ()}))
    played = plain.with_duration(played_s)
    refuse_idle(played, effects)
    changed = apply_effects(played, effects)
    return changed if played_s is None else changed.with_duration(plain.settings.duration_s)


def refuse_idle(scenario: Scenario, effects: Iterable[Effect]) -> None:
    """Refuse effects that would change nothing in a scenario, see `Effect.idle_in`.

    Raises:
        OptionError: There is one.
    """
    for effect in effects:
        if why := effect.idle_in(scenario):
            raise OptionError(f"effect {effect}: {why}")


def detector_effects(scenario: Scenario) -> tuple[Effect, ...]:
    """Return the effects on detectors that were applied to a scenario.

    They do not change its files, so code that measures the scenario has to apply them.
    """
    return tuple(effect for effect in _listed(scenario) if effect.on_detectors)


def same_for_agents(one: Scenario, other: Scenario) -> bool:
    """Return True if two scenarios differ in nothing but effects on detectors."""

    def met(scenario: Scenario) -> str:
        listed = tuple(effect.record() for effect in controller_effects(scenario))
        settings = scenario.settings.model_copy(update={"effects": listed})
        return replace(scenario, settings=settings).hash

    return met(one) == met(other)


def controller_effects(scenario: Scenario) -> tuple[Effect, ...]:
    """Return the effects on controllers that were applied to a scenario."""
    return tuple(effect for effect in _listed(scenario) if not effect.on_detectors)


def _listed(scenario: Scenario) -> tuple[Effect, ...]:
    return tuple(map(effect_from_record, scenario.settings.effects))
