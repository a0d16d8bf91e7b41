"""Domains: named lists of effects, with V1 to V4 of the UGAT paper.

Each named domain makes a gap between the simulation and the real domain.

The counterparts are settings of Sim2Signal (Al Rafi et al. 2026, arXiv:2609.01676), with the names
of its repository. The numbers here come from its files of settings and tables of phases. That
benchmark trains in CityFlow and simulates the real domain in SUMO; here both are SUMO.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal, get_args

from ugat_marl.effects.base import Effect
from ugat_marl.effects.sensors import DetectionZone
from ugat_marl.effects.table import (
    EFFECTS,
    apply_effects,
    effect_from_text,
    load_scenario,
    refuse_idle,
)
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError, nearest
from ugat_marl.files import with_home
from ugat_marl.scenarios import Network, Scenario, is_configuration

Domain = str | Sequence[Effect]
"""``"sim"``, a named domain or its alias, ``"effect=value+effect=value"``, a scenario directory or
``.sumocfg`` on the same road network, or effects."""

Gap = Literal["observation", "action", "transition", "reward"]

GAP_KINDS: tuple[Gap, ...] = get_args(Gap)
"""Kinds of gap: in what controllers see, in their commands, in the traffic, in the objective."""


@dataclass(frozen=True)
class NamedDomain:
    """A domain with a name, see `NAMED_DOMAINS`.

    Attributes:
        name: Name of the domain; small and capital letters are the same.
        gap: Kind of gap.
        effects: Effects in text form: ``effect=value+effect=value``.
        counterpart: Corresponding setting of Sim2Signal, or "".
        note: Difference from the counterpart, or source of the numbers.
    """

    name: str
    gap: Gap
    effects: str
    counterpart: str = ""
    note: str = ""


_GREENS = "+min_green=10+max_green=40"
_ON_SITE = "there shortest and longest greens are those of each site's plan"
_OLDER = "numbers from an older file, setting{}.yml; that of the final name was not found"
_ASSUMED = "assumed values"


def _observation() -> list[NamedDomain]:
    """Return domains with noise, dead detectors, short detection zones, late or lost counts."""
    worlds = [
        NamedDomain(f"noise-{n}", "observation", f"counting_error={n}", f"noise{n}")
        for n in (3, 5, 10, 20)
    ]
    worlds += [
        NamedDomain(f"zone-{n}", "observation", f"detection_zone={n}", f"dz{n}")
        for n in (10, 20, 50, 100)
    ]
    worlds += [
        NamedDomain(f"failure-{n}", "observation", f"detector_failure={n / 100}", f"sensor{n}")
        for n in (5, 20, 50, 70)
    ]
    combined = ((100, 3, 0.05, ""), (50, 3, 0.1, ""), (20, 3, 0.2, "3"), (10, 5, 0.25, "4"))
    worlds += [
        NamedDomain(
            f"combined-{n}",
            "observation",
            f"detection_zone={zone}+counting_error={error}+detector_failure={share}",
            f"combine{n}",
            older and _OLDER.format(older),
        )
        for n, (zone, error, share, older) in enumerate(combined, start=1)
    ]
    worlds += [
        NamedDomain(f"noise-{n}-percent", "observation", f"counting_noise={n / 100}")
        for n in (3, 10, 20)
    ]
    worlds += [
        NamedDomain("late-counts-10", "observation", "observation_delay=10"),
        NamedDomain("late-counts-30", "observation", "observation_delay=30"),
        NamedDomain("lost-readings-20", "observation", "lost_readings=0.2"),
        NamedDomain("coarse-counts-5", "observation", "quantised_counts=5"),
    ]
    return worlds


def _action() -> list[NamedDomain]:
    """Return domains with late or lost commands, limits of greens, or an order of phases."""
    chained = "there every command also waits for the one before"
    worlds = [
        NamedDomain(f"delay-{s}", "action", f"execution_delay={s}", f"delay setting{n}", chained)
        for n, s in enumerate((20, 30, 40, 60), start=1)
    ]
    worlds += [
        NamedDomain("flexible", "action", _GREENS[1:], "flexible", _ON_SITE),
        NamedDomain("cyclic", "action", f"phase_order=cyclic{_GREENS}", "cyclic", _ON_SITE),
        *(
            NamedDomain(
                f"barrier-{rule}",
                "action",
                f"phase_order=barrier-{rule}{_GREENS}",
                f"barrier_{theirs}_fixed",
                _ON_SITE,
            )
            for rule, theirs in (
                ("leading", "leading"),
                ("lagging", "lagging"),
                ("both", "leading_lagging"),
            )
        ),
        NamedDomain("lost-commands-10", "action", "lost_commands=0.1"),
        NamedDomain("lost-commands-30", "action", "lost_commands=0.3"),
        NamedDomain("long-greens", "action", "min_green=20"),
    ]
    return worlds


def _transition() -> list[NamedDomain]:
    """Return domains with other vehicles, drivers, weather, demand and streets."""
    paper = "Da et al. (2023), Real-world Configurations"
    settings = {
        "V1": (1.00, 2.50, 6.00, 0.50),
        "V2": (1.00, 2.50, 6.00, 0.75),
        "V3": (0.75, 3.50, 6.00, 0.25),
        "V4": (0.50, 1.50, 2.00, 0.50),
    }
    worlds = [
        NamedDomain(
            name,
            "transition",
            f"acceleration={values[0]:g}+deceleration={values[1]:g}"
            f"+emergency_deceleration={values[2]:g}+startup_delay={values[3]:g}",
            f"transition setting{n}",
            paper,
        )
        for n, (name, values) in enumerate(settings.items(), start=1)
    ]
    others = {
        "trucks-10": "heavy_share=0.1",
        "trucks-30": "heavy_share=0.3",
        "headway-1.5": "headway=1.5",
        "headway-2": "headway=2",
        "lost-time-2": "late_green=*,2",
        "demand-80": "demand_level=*,0.8",
        "demand-120": "demand_level=*,1.2",
        "late-demand": "demand_timing=*,300",
        "careless": "imperfection=0.8+speed_spread=0.2+lane_discipline=0.2",
        "idm": "driver_model=IDM",
        "eidm": "driver_model=EIDM",
        "w99": "driver_model=W99",
        "incident": "incident=600,900",
        "fog": "desired_speed=0.8+headway=1.5+startup_delay=0.5",
        "downpour": "V3+desired_speed=0.85+headway=1.3",
        "blizzard": "V4+desired_speed=0.7+headway=2+demand_level=*,0.9",
    }
    worlds += [
        NamedDomain(name, "transition", effects, note=_ASSUMED) for name, effects in others.items()
    ]
    engine = "SUMO's mesoscopic model: an engine to train in, --sim meso"
    return [*worlds, NamedDomain("meso", "transition", "queue_model=500", note=engine)]


def _reward() -> list[NamedDomain]:
    """Return domains with an objective that training does not see."""
    theirs = {
        "efficiency": "efficiency_aligned",
        "emissions": "emission_heavy",
        "fairness": "fairness_heavy",
        "safety": "physical_safety_heavy",
        "person-delay": "",
    }
    other_parts = "the same weights, but measures defined otherwise"
    return [
        NamedDomain(f"want-{name}", "reward", f"objective={name}", other, other and other_parts)
        for name, other in theirs.items()
    ]


NAMED_DOMAINS: dict[str, NamedDomain] = {
    named.name: named for named in (*_observation(), *_action(), *_transition(), *_reward())
}
"""All named domains, by name."""


TO_TRAIN_IN = frozenset({"meso"})
"""Named domains that are simulations for training, and no real domains."""

DOMAIN_ALIASES: dict[str, str] = {
    "light-loads": "V1",
    "heavy-loads": "V2",
    "rain": "V3",
    "snow": "V4",
}
"""Other names of the paper's domains."""


def expand_domains(names: Sequence[str]) -> list[str]:
    """Return domains with ``"all"`` and names of gaps replaced by lists, each name once.

    Args:
        names: Domains. ``"all"`` means ``sim`` and every named domain; the name of a gap means its
            domains. Both leave out those in `TO_TRAIN_IN`.
    """
    expanded: list[str] = []
    streets = [named for named in NAMED_DOMAINS.values() if named.name not in TO_TRAIN_IN]
    for name in names:
        if name.lower() == "all":
            expanded += ["sim", *(named.name for named in streets)]
        elif name.lower() in GAP_KINDS:
            expanded += [named.name for named in streets if named.gap == name.lower()]
        else:
            expanded.append(name)
    return list(dict.fromkeys(expanded))


def parse_domain(domain: Domain) -> tuple[Effect, ...]:
    """Return the effects of a domain; none for ``"sim"``.

    Raises:
        UnknownNameError: The domain or an effect does not exist.
        OptionError: An effect has an impossible value.
    """
    if not isinstance(domain, str):
        given: Any = domain
        if isinstance(given, Path):
            raise OptionError(f"domain {given!r}: give a scenario directory as text, str(path)")
        if not isinstance(given, Sequence):  # an iterator could be read once only
            raise OptionError(
                f"domain {given!r}: give a name such as 'V1', or a list of effects such as "
                "[StartupDelay(0.5)]"
            )
        for part_or_effect in given:
            if not isinstance(part_or_effect, Effect):
                raise OptionError(
                    f"domain {domain!r}: {part_or_effect!r} is not an effect; give a name such as "
                    "'V1' on its own, or a list of effects such as [StartupDelay(0.5)]"
                )
        return tuple(domain)
    parts = _parts(domain)
    if len(parts) > 1:
        return tuple(effect for part in parts for effect in parse_domain(part))
    name = parts[0].lower()
    if name == "sim":
        return ()
    if name in _names():
        return parse_domain(NAMED_DOMAINS[_names()[name]].effects)
    if "=" in name:
        return (effect_from_text(parts[0]),)
    near = nearest(name, ("sim", *NAMED_DOMAINS, *DOMAIN_ALIASES))
    raise UnknownNameError(
        "domain",
        domain,
        ("sim", *PAPER_WORLDS, *DOMAIN_ALIASES, *([near] if near else [])),
        "ugat-marl domains lists all names. Effects (startup_delay=0.5+acceleration=1.0) and the "
        "directory of another scenario on the same network work as well.",
    )


def _names() -> dict[str, str]:
    """Return names and aliases in lower case, each with the name of its domain."""
    return {name.lower(): name for name in NAMED_DOMAINS} | DOMAIN_ALIASES


def _parts(domain: str) -> list[str]:
    """Split a domain at its plus signs, except in ids of edges and lanes."""
    parts: list[str] = []
    for part in domain.split("+"):
        name = parts[-1].partition("=")[0].strip().lower() if parts else ""
        kind = EFFECTS.get(name)
        new = "=" in part or part.strip().lower() in {"", "sim", *_names()}
        named = kind is not None and any(not text.allowed for text in kind.texts.values())
        if named and not new:
            parts[-1] += f"+{part}"
        else:
            parts.append(part)
    return [part.strip() for part in parts]


def domain_label(domain: Domain) -> str:
    """Return the short name of a domain for tables, the same for all spellings of its names."""
    if isinstance(domain, str):
        names = {"sim": "sim", **_names()}
        label = "+".join(names.get(part.lower(), part) for part in _parts(domain))
        return domain if label != domain and domain_path(domain) is not None else label
    return "+".join(map(str, domain)) or "sim"


def is_one_domain(given: Domain | Sequence[Domain]) -> bool:
    """Return True for one domain, and False for a sequence of them.

    A sequence of effects is one domain.

    Raises:
        OptionError: A sequence holds both domains and single effects.
    """
    any_value: Any = given  # what is none, such as None, is refused where it is parsed
    listed = any_value if isinstance(any_value, Sequence) and not isinstance(given, str) else ()
    single = [entry for entry in listed if not isinstance(entry, str | list | tuple)]
    if 0 < len(single) < len(listed):
        raise OptionError(
            f"domains mixes domains and single effects ({single[0]}); put the effects of one "
            "domain into a list of their own"
        )
    return len(single) == len(listed)


def scenario_in_domain(
    scenario: Scenario,
    domain: Domain,
    *,
    recorded: bool = False,
    duration_s: float | None = None,
) -> Scenario:
    """Return the scenario with the effects of `domain`.

    Args:
        scenario: Scenario from `load_scenario`.
        domain: Effects, a name of effects, or the path of another scenario on the same network.
        recorded: True if detectors are recorded there, so that effects on them are accepted. Those
            that a scenario lists are accepted anyway.
        duration_s: Length of episodes, s; None for that of the scenario. Effects on demand and
            those with times need to know it.

    Raises:
        UnknownNameError: The domain or an effect does not exist.
        OptionError: An effect has an impossible value or lies outside of the scenario's time, two
            of them exclude each other, or one changes detectors that nobody reads.
        ScenarioError: A scenario named as a domain cannot be read or has other roads, phases or
            decision intervals.
    """
    if (path := domain_path(domain)) is not None:
        other = load_scenario(path, duration_s)
        if _signals(other) != _signals(scenario):
            raise ScenarioError(
                f"domain {domain!r} has other roads or signals than scenario {scenario.id!r}; "
                "a domain must be on the same network, or a policy means nothing in it"
            )
        _refuse_other_actions(scenario, other, domain)
        return _checked(other.with_duration(duration_s))
    effects = parse_domain(domain)
    if not recorded:
        _refuse_detectors(domain, effects)
    scenario = scenario.with_duration(duration_s)
    refuse_idle(scenario, effects)
    return _checked(apply_effects(scenario, effects))


def _refuse_detectors(domain: Domain, effects: Iterable[Effect]) -> None:
    """Refuse effects on detectors, which would change nothing that agents see."""
    for effect in effects:
        if effect.on_detectors:
            raise OptionError(
                f"domain {domain_label(domain)!r}: {effect.name!r} changes the reports of "
                "detectors, which agents do not see, so it would change nothing here; it is for "
                "recordings, and counting_error, detector_failure and detection_zone are for agents"
            )


def _checked(scenario: Scenario) -> Scenario:
    """Return the scenario; refuse a detection zone together with a reach."""
    zones = (
        record for record in scenario.settings.effects if record.get("name") == DetectionZone.name
    )
    if scenario.control.reach_m and any(zones):
        raise OptionError(
            f"scenario {scenario.id!r}: a detection_zone shows vehicles on the lane at the light "
            "alone, a reach (control.reach_m) those upstream of it, too; leave out one of the two"
        )
    return scenario


def _refuse_other_actions(scenario: Scenario, other: Scenario, domain: Domain) -> None:
    """Refuse a scenario as a domain in which the same action means something else."""
    own_s, other_s = (each.control.decision_interval_s for each in (scenario, other))
    if own_s != other_s:
        raise ScenarioError(
            f"domain {domain!r} decides every {other_s:g} s, and scenario {scenario.id!r} every "
            f"{own_s:g} s; give both the same control.decision_interval_s, or a policy decides at "
            "other times in it"
        )
    own, others = (_greens(each) for each in (scenario, other))
    for light in sorted({*own, *others}):
        here, there = own.get(light, ()), others.get(light, ())
        if here != there:
            pairs = enumerate(zip_longest(here, there, fillvalue="none"))
            place, (mine, theirs) = next((n, pair) for n, pair in pairs if pair[0] != pair[1])
            raise ScenarioError(
                f"domain {domain!r} has other phases than scenario {scenario.id!r}: phase {place} "
                f"of traffic light {light!r} is {theirs} there and {mine} here; give both the same "
                "control.phases and programmes, or an action means another green in it"
            )


def _greens(scenario: Scenario) -> dict[str, tuple[str, ...]]:
    """Return the phases of every agent; it is not told who has to yield."""
    lights = Network.read(scenario).intersections
    return {light.id: tuple(p.replace("g", "G") for p in light.phases) for light in lights}


def domain_path(domain: Domain) -> Path | None:
    """Return the path if a domain is a scenario directory or a SUMO configuration, else None.

    A folder of the name of a domain, such as ``V4``, is given as ``./V4``.
    """
    if not isinstance(domain, str) or domain.strip().lower() in {"sim", *_names()}:
        return None
    path = with_home(domain)
    try:
        file = path if path.name == "scenario.toml" else path / "scenario.toml"
        named = is_configuration(path) or file.is_file()
    except OSError:  # a long list of effects is not a possible path
        return None
    return path if named else None


def _signals(scenario: Scenario) -> set[tuple[str, ...]]:
    """Return all connections with a signal: light, link index, edges and lanes."""
    keys = ("tl", "linkIndex", "from", "fromLane", "to", "toLane")
    return {
        tuple(element.get(key, "") for key in keys)
        for element in scenario.network.parse().iter("connection")
        if "tl" in element.attrib
    }


PAPER_WORLDS: dict[str, tuple[Effect, ...]] = {
    name: parse_domain(NAMED_DOMAINS[name].effects) for name in ("V1", "V2", "V3", "V4")
}
"""Da et al. (2023), table "Real-world Configurations": accel, decel, emergencyDecel (m/s^2) and
startupDelay (s). The default, our ``sim``, is 2.60 / 4.50 / 9.00 / 0.00."""
