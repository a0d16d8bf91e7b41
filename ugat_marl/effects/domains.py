"""Named domains, by the gap they open between simulation and street.

The counterparts are settings of Sim2Signal (Al Rafi et al. 2026, arXiv:2609.01676), by the names of
its repository, whose files of settings and tables of phases were read for the numbers here. That
benchmark trains in CityFlow and plays the street in SUMO; here both sides are SUMO.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Gap = Literal["observation", "action", "transition", "reward"]

GAPS: tuple[Gap, ...] = get_args(Gap)
"""Where simulation and street may part: what is seen, done, what happens, what is wanted."""


@dataclass(frozen=True)
class NamedDomain:
    """A domain with a name, see `NAMED`.

    Attributes:
        name: What it is called; small and capital letters are the same.
        gap: Which gap it opens.
        effects: Its effects, as in a domain: ``effect=value+effect=value``.
        counterpart: The setting of Sim2Signal it corresponds to, or "".
        note: What is different there, or what the numbers are based on.
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
    """Normal errors in vehicles, lanes that are silent for an episode, short detection zones."""
    found = [
        NamedDomain(f"noise-{n}", "observation", f"counting_error={n}", f"noise{n}")
        for n in (3, 5, 10, 20)
    ]
    found += [
        NamedDomain(f"zone-{n}", "observation", f"detection_zone={n}", f"dz{n}")
        for n in (10, 20, 50, 100)
    ]
    found += [
        NamedDomain(f"failure-{n}", "observation", f"detector_failure={n / 100}", f"sensor{n}")
        for n in (5, 20, 50, 70)
    ]
    combined = ((100, 3, 0.05, ""), (50, 3, 0.1, ""), (20, 3, 0.2, "3"), (10, 5, 0.25, "4"))
    found += [
        NamedDomain(
            f"combined-{n}",
            "observation",
            f"detection_zone={zone}+counting_error={error}+detector_failure={share}",
            f"combine{n}",
            older and _OLDER.format(older),
        )
        for n, (zone, error, share, older) in enumerate(combined, start=1)
    ]
    found += [
        NamedDomain(f"noise-{n}-percent", "observation", f"counting_noise={n / 100}")
        for n in (3, 10, 20)
    ]
    found += [
        NamedDomain("late-counts-10", "observation", "observation_delay=10"),
        NamedDomain("late-counts-30", "observation", "observation_delay=30"),
        NamedDomain("lost-readings-20", "observation", "lost_readings=0.2"),
        NamedDomain("coarse-counts-5", "observation", "quantised_counts=5"),
    ]
    return found


def _action() -> list[NamedDomain]:
    """Commands that arrive late or not at all, phases in a fixed order."""
    chained = "there every command also waits for the one before"
    found = [
        NamedDomain(f"delay-{s}", "action", f"execution_delay={s}", f"delay setting{n}", chained)
        for n, s in enumerate((20, 30, 40, 60), start=1)
    ]
    found += [
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
    return found


def _transition() -> list[NamedDomain]:
    """Other vehicles, drivers, weather, demand and streets."""
    paper = "Da et al. (2023), Real-world Configurations"
    settings = {
        "V1": (1.00, 2.50, 6.00, 0.50),
        "V2": (1.00, 2.50, 6.00, 0.75),
        "V3": (0.75, 3.50, 6.00, 0.25),
        "V4": (0.50, 1.50, 2.00, 0.50),
    }
    found = [
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
    found += [
        NamedDomain(name, "transition", effects, note=_ASSUMED) for name, effects in others.items()
    ]
    engine = "SUMO's mesoscopic model: an engine to train in, --sim meso"
    return [*found, NamedDomain("meso", "transition", "queue_model=500", note=engine)]


def _reward() -> list[NamedDomain]:
    """The same street, judged by what training does not see."""
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


NAMED: dict[str, NamedDomain] = {
    item.name: item for item in (*_observation(), *_action(), *_transition(), *_reward())
}
"""All of them, by name."""


TO_TRAIN_IN = frozenset({"meso"})
"""Named domains that stand for a simulation, and for no street."""


def spelled_out(names: Sequence[str]) -> list[str]:
    """Return domains with ``"all"`` and names of gaps replaced by lists, each domain once.

    Args:
        names: Domains; ``"all"`` is ``sim`` and every named one, the name of a gap all of its own,
            but for those that are there `TO_TRAIN_IN`.
    """
    found: list[str] = []
    streets = [item for item in NAMED.values() if item.name not in TO_TRAIN_IN]
    for name in names:
        if name.lower() == "all":
            found += ["sim", *(item.name for item in streets)]
        elif name.lower() in GAPS:
            found += [item.name for item in streets if item.gap == name.lower()]
        else:
            found.append(name)
    return list(dict.fromkeys(found))
