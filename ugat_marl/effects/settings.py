"""Domains: lists of effects by name, V1-V4 of the UGAT paper among them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from ugat_marl.effects.actuators import ACTING
from ugat_marl.effects.base import Effect
from ugat_marl.effects.demand import DemandLevel, DemandSurge, DemandTiming
from ugat_marl.effects.detectors import (
    ClockDrift,
    Dropout,
    SignalClock,
    Stuck,
    Swapped,
    Undercount,
)
from ugat_marl.effects.domains import NAMED
from ugat_marl.effects.engine import BlockerPatience, QueueModel, Reach
from ugat_marl.effects.fleet import DesiredSpeed, HeavyShare, SpeedSpread
from ugat_marl.effects.objectives import JUDGING
from ugat_marl.effects.roads import Incident, LaneClosure, LocalSpeed, Parking
from ugat_marl.effects.sensors import OBSERVING, DetectionZone
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
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError, nearest
from ugat_marl.scenarios import Scenario, read_scenario

Domain = str | Sequence[Effect]
"""``"sim"``, a named domain or its alias, ``"effect=value+effect=value"``, a scenario directory or
``.sumocfg`` on the same road network, or effects."""


def _setting(accel: float, decel: float, emergency: float, startup: float) -> tuple[Effect, ...]:
    return (
        Acceleration(accel),
        Deceleration(decel),
        EmergencyDeceleration(emergency),
        StartupDelay(startup),
    )


SETTINGS: dict[str, tuple[Effect, ...]] = {
    "V1": _setting(1.00, 2.50, 6.00, 0.50),
    "V2": _setting(1.00, 2.50, 6.00, 0.75),
    "V3": _setting(0.75, 3.50, 6.00, 0.25),
    "V4": _setting(0.50, 1.50, 2.00, 0.50),
}
"""Da et al. (2023), table "Real-world Configurations": accel, decel, emergencyDecel (m/s^2) and
startupDelay (s). The default, our ``sim``, is 2.60 / 4.50 / 9.00 / 0.00."""

ALIASES: dict[str, str] = {
    "light-loads": "V1",
    "heavy-loads": "V2",
    "rain": "V3",
    "snow": "V4",
}

_EFFECTS: dict[str, type[Effect]] = {
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


_ON_CONTROLLERS: dict[str, type[Effect]] = {
    kind.name: kind for kind in (*OBSERVING, *ACTING, *JUDGING)
}
_OTHERS: dict[str, type[Effect]] = {
    kind.name: kind for kind in (Incident, QueueModel, BlockerPatience, Reach)
}

_ALL: dict[str, type[Effect]] = {**_EFFECTS, **_ON_CONTROLLERS, **_OTHERS}


def known_effects() -> Mapping[str, type[Effect]]:
    """Return the effects that measured data may show, by name: traffic, signals, detectors."""
    return dict(_EFFECTS)


def effects_on_controllers() -> Mapping[str, type[Effect]]:
    """Return the effects on controllers by name; no diagnosis looks for them."""
    return dict(_ON_CONTROLLERS)


def effect_from(record: Mapping[str, Any], where: str = "") -> Effect:
    """Return an effect from its name and parameters, as in ``[[effects]]`` of a scenario file.

    Args:
        record: ``{"name": ..., parameter: value, ...}``.
        where: Where it stands, for errors.

    Raises:
        UnknownNameError: No effect of this name, or no parameter of this name.
        OptionError: A parameter is missing or outside its range.
    """
    values = dict(record)
    name = str(values.pop("name", ""))
    if name not in _ALL:
        raise UnknownNameError("effect", name, _ALL, where and f"It stands{where}.")
    kind = _ALL[name]
    parameters = [item.name for item in fields(kind)]
    for key in values:
        if key not in parameters:
            raise UnknownNameError(
                f"parameter of effect {name!r}:", key, parameters, where and f"It stands{where}."
            )
    if missing := [key for key in parameters if key not in values]:
        raise OptionError(f"effect {name!r}{where}: parameter {missing[0]!r} is missing")
    return kind(**values)


def parse_domain(domain: Domain) -> tuple[Effect, ...]:
    """Return the effects that make `domain` out of a scenario; none for ``"sim"``.

    Raises:
        UnknownNameError: No such setting or effect.
        OptionError: An effect has an impossible value.
    """
    if not isinstance(domain, str):
        given: Sequence[Any] = domain
        for item in given:
            if not isinstance(item, Effect):
                raise OptionError(
                    f"domain {domain!r}: {item!r} is not an effect; give a name such as 'V1' on "
                    "its own, or a list of effects such as [StartupDelay(0.5)]"
                )
        return tuple(domain)
    parts = _parts(domain)
    if len(parts) > 1:
        return tuple(effect for part in parts for effect in parse_domain(part))
    name = parts[0].lower()
    if name == "sim":
        return ()
    if name in _names():
        found = _names()[name]
        return SETTINGS[found] if found in SETTINGS else parse_domain(NAMED[found].effects)
    if "=" in name:
        return (_effect_from_text(parts[0]),)
    near = nearest(name, ("sim", *NAMED, *ALIASES))
    raise UnknownNameError(
        "domain",
        domain,
        ("sim", *SETTINGS, *ALIASES, *([near] if near else [])),
        "ugat-marl domains lists all names. Effects (startup_delay=0.5+acceleration=1.0) and the "
        "directory of another scenario on the same network work as well.",
    )


def _names() -> dict[str, str]:
    """Return the name of a domain by each of its names in lower case."""
    return {name.lower(): name for name in NAMED} | ALIASES


def _parts(domain: str) -> list[str]:
    """Split a domain at its plus signs, except those in the id of an edge or lane."""
    parts: list[str] = []
    for part in domain.split("+"):
        name = parts[-1].partition("=")[0].strip().lower() if parts else ""
        kind = _ALL.get(name)
        new = "=" in part or part.strip().lower() in {"", "sim", *_names()}
        if kind is not None and kind.texts and not new:
            parts[-1] += f"+{part}"
        else:
            parts.append(part)
    return [part.strip() for part in parts]


def _effect_from_text(text: str) -> Effect:
    name, _, values = (part.strip() for part in text.partition("="))
    name = name.lower()
    if name not in _ALL:
        raise UnknownNameError("effect", name, _ALL)
    kind = _ALL[name]
    parameters = [item.name for item in fields(kind)]
    parts = [part.strip() for part in values.split(",")]
    if len(parts) != len(parameters):
        raise OptionError(
            f"effect {name!r} takes {len(parameters)} value(s), {', '.join(parameters)}; "
            f"got {values!r}"
        )
    given: dict[str, Any] = {}
    for parameter, part in zip(parameters, parts, strict=True):
        try:
            given[parameter] = part if parameter in kind.texts else float(part)
        except ValueError:
            raise OptionError(f"effect {name!r}: {part!r} is not a number") from None
    return kind(**given)


def describe(domain: Domain) -> str:
    """Return a short name for a domain, as tables show it."""
    if isinstance(domain, str):
        return _names().get(domain.strip().lower(), domain)
    return "+".join(map(str, domain)) or "sim"


def apply_effects(scenario: Scenario, effects: Iterable[Effect]) -> Scenario:
    """Apply effects one after the other."""
    for apply_all, group in groupby(effects, lambda effect: effect.apply_all):
        scenario = apply_all(scenario, list(group))
    return scenario


def load_scenario(name: str | Path | Scenario) -> Scenario:
    """Load a scenario and apply the effects its own file lists (see `read_scenario`).

    Those on controllers stay listed in its settings, for the environment to keep.
    """
    scenario = name if isinstance(name, Scenario) else read_scenario(name)
    where = f" in scenario {scenario.id!r}"
    effects = [effect_from(record, where) for record in scenario.settings.effects]
    plain = replace(scenario, settings=scenario.settings.model_copy(update={"effects": ()}))
    return apply_effects(plain, effects)


def detector_effects(scenario: Scenario) -> tuple[Effect, ...]:
    """Return the effects on detectors that were applied to a scenario.

    They leave its files as they are, so that the code that measures it has to ask for them.
    """
    names = (text.partition("=")[0] for text in scenario.applied)
    return tuple(
        _effect_from_text(text)  # undoes str(effect)
        for name, text in zip(names, scenario.applied, strict=True)
        if name in _EFFECTS and _EFFECTS[name].on_detectors
    )


def controller_effects(scenario: Scenario) -> tuple[Effect, ...]:
    """Return the effects on controllers that were applied to a scenario."""
    return tuple(map(effect_from, scenario.settings.effects))


def in_domain(scenario: Scenario, domain: Domain) -> Scenario:
    """Return the scenario as it is in `domain`.

    Args:
        scenario: What `load_scenario` returned.
        domain: Effects, or the name of some, or the path of another scenario on the same network.

    Raises:
        UnknownNameError: No such setting or effect.
        OptionError: An effect has an impossible value, or two of them exclude each other.
        ScenarioError: A scenario named as a domain cannot be read or has other roads.
    """
    if (path := scenario_of(domain)) is not None:
        other = load_scenario(path)
        if _signals(other) != _signals(scenario):
            raise ScenarioError(
                f"domain {domain!r} has other roads or signals than scenario {scenario.id!r}; "
                "a domain must be on the same network, or a policy means nothing in it"
            )
        return _checked(other)
    return _checked(apply_effects(scenario, parse_domain(domain)))


def _checked(scenario: Scenario) -> Scenario:
    """Return the scenario; refuse a detection zone together with a reach."""
    zones = (item for item in scenario.settings.effects if item.get("name") == DetectionZone.name)
    if scenario.control.reach_m and any(zones):
        raise OptionError(
            f"scenario {scenario.id!r}: a detection_zone shows vehicles on the lane at the light "
            "alone, a reach (control.reach_m) those upstream of it, too; leave out one of the two"
        )
    return scenario


def scenario_of(domain: Domain) -> Path | None:
    """Return the other scenario that a domain names, or None; a file called V4 is none."""
    if not isinstance(domain, str):
        return None
    path = Path(domain).expanduser()
    return path if path.suffix == ".sumocfg" or (path / "scenario.toml").is_file() else None


def _signals(scenario: Scenario) -> set[tuple[str, ...]]:
    """Return the connection that each letter of each signal belongs to."""
    keys = ("tl", "linkIndex", "from", "fromLane", "to", "toLane")
    return {
        tuple(item.get(key, "") for key in keys)
        for item in scenario.network.parse().iter("connection")
        if "tl" in item.attrib
    }
