"""Make blind cases: draw hidden effects, record measured data, write the label."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from studies.blind.cases import (
    LABELS,
    PLAN,
    Case,
    Hidden,
    Label,
    label_path,
    read_plan,
    write_label,
    write_plan,
)
from studies.blind.places import Busy, busy_places
from studies.blind.sampling import GROUPS, Sample, Task, draw_sample, draw_tasks
from studies.blind.strengths import STRENGTHS, nominal_of
from studies.errors import BlindTestError
from ugat_marl.data import write_measured
from ugat_marl.effects import Effect, load_scenario
from ugat_marl.errors import OptionError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Network, Period, Scenario
from ugat_marl.seeding import derive_seed, numpy_generator

FIXED_TIMES = ("fixed-time:20", "fixed-time:30", "fixed-time:40")
PRESSURES = ("max-pressure:10", "max-pressure:20")
"""Controllers that react to traffic; the other cases have fixed-time control."""

VARIATIONS = (0.0, 0.05, 0.1)
"""Standard deviations of the demand of a day, as shares of its mean."""

LEAST = 20
"""Least number of detections, to 0.1 s, that a day has only with the effect or only without it."""


@dataclass(frozen=True)
class Blueprint:
    """Settings of a blind test.

    Attributes:
        scenarios: Names of scenarios, as for `load_scenario`.
        classes: Groups (none, single, measurement, pair, setting, outside) and names of effects.
        strengths: Strengths of single effects.
        cases: Number of cases.
        seed: Root of all seeds.
        periods: Days per case.
        speeds: True if speeds are measured.
        pressure_share: Share of the cases under max-pressure instead of fixed-time control.
        duration_s: Length of a day; None for the scenario's own.
        day_to_day: Variations of the demand from day to day, as shares; each case has one.
    """

    scenarios: tuple[str, ...]
    classes: tuple[str, ...] = tuple(GROUPS)
    strengths: tuple[str, ...] = STRENGTHS
    cases: int = 40
    seed: int = 0
    periods: int = 5
    speeds: bool = True
    pressure_share: float = 0.2
    duration_s: float | None = None
    day_to_day: tuple[float, ...] = VARIATIONS

    def __post_init__(self) -> None:
        if not self.scenarios or not self.classes or not self.strengths:
            raise OptionError("a blind test needs at least one scenario, class and strength")
        for name in ("scenarios", "classes", "strengths"):
            if len(set(getattr(self, name))) < len(getattr(self, name)):
                raise OptionError(f"{name} holds one twice: {' '.join(getattr(self, name))}")
        if self.cases < 1 or self.periods < 1 or self.seed < 0:
            raise OptionError("cases and periods must be at least 1, and seed not negative")
        if not 0 <= self.pressure_share <= 1:
            raise OptionError(f"pressure_share = {self.pressure_share}: must be from 0 to 1")
        if not self.day_to_day or not all(0 <= share < 1 for share in self.day_to_day):
            shown = " ".join(f"{share:g}" for share in self.day_to_day)
            raise OptionError(f"day_to_day = {shown}: needs shares from 0 to below 1")


@dataclass(frozen=True)
class _Planned:
    """One case before it is measured."""

    case: Case
    sample: Sample
    policy: str
    seed: int
    day_to_day: float


def generate(directory: Path, blueprint: Blueprint, reporter: Reporter | None = None) -> int:
    """Write the missing cases of a blind test.

    Args:
        directory: A new directory, or one of the same blueprint, which is continued.
        blueprint: Settings of the test.
        reporter: Reporter of the progress.

    Returns:
        Number of cases that were made.

    Raises:
        BlindTestError: The directory holds another blind test, or no scenario has a place for an
            effect.
    """
    reporter = reporter or Silent()
    scenarios = {name: _loaded(name, blueprint) for name in blueprint.scenarios}
    busy: dict[str, Busy] = {}
    with reporter.task("looking at the scenarios", len(scenarios)) as advance:
        for name, scenario in scenarios.items():
            busy[name] = busy_places(scenario, blueprint.seed)
            advance()
    planned = _plan(blueprint, scenarios, busy, reporter)
    _begin(directory, blueprint, tuple(item.case for item in planned))
    made = 0
    with reporter.task("hiding and measuring", len(planned)) as advance:
        for item in planned:
            if not label_path(directory, item.case.case).exists():
                _make(directory, blueprint, item, scenarios[item.case.scenario])
                made += 1
            advance()
    return made


def _loaded(name: str, blueprint: Blueprint) -> Scenario:
    scenario = load_scenario(name)
    if blueprint.duration_s is not None:
        scenario = scenario.with_duration(blueprint.duration_s)
    return scenario


def _plan(
    blueprint: Blueprint,
    scenarios: dict[str, Scenario],
    busy: dict[str, Busy],
    reporter: Reporter,
) -> list[_Planned]:
    """Draw all cases; another number of cases gives other cases."""
    generator = numpy_generator(blueprint.seed, "blind", "deck")
    tasks = draw_tasks(blueprint.classes, blueprint.strengths, blueprint.cases, generator)
    spare = _spare(tasks)
    consequences = Consequences(blueprint.seed)
    planned: list[_Planned] = []
    with reporter.task("drawing what is hidden", len(tasks)) as advance:
        for index, task in enumerate(tasks):
            planned.append(_planned(blueprint, index, task, spare, scenarios, busy, consequences))
            advance()
    return planned


def _spare(tasks: Sequence[Task]) -> dict[str, list[Task]]:
    """Group the tasks; another task replaces one for which no scenario has a place."""
    found: dict[str, list[Task]] = {}
    for task in tasks:
        found.setdefault(task.group, []).append(task)
    return found


def _planned(
    blueprint: Blueprint,
    index: int,
    task: Task,
    spare: dict[str, list[Task]],
    scenarios: dict[str, Scenario],
    busy: dict[str, Busy],
    consequences: Consequences,
) -> _Planned:
    generator = numpy_generator(blueprint.seed, "blind", "draw", index)
    names = [blueprint.scenarios[i] for i in generator.permutation(len(blueprint.scenarios))]
    others = spare[task.group]
    for attempt in (task, *(others[i] for i in generator.permutation(len(others)))):
        for name in names:
            sample = draw_sample(attempt, scenarios[name], busy[name], generator)
            if sample is not None:
                policies = FIXED_TIMES
                # In V4 max-pressure blocks some networks, and a standstill tells nothing.
                if generator.random() < blueprint.pressure_share and sample.group != "setting":
                    policies = PRESSURES
                policy = policies[int(generator.integers(len(policies)))]
                if not consequences.has(scenarios[name], sample, policy):
                    continue
                case = Case(f"case{index + 1:03d}", name, sample.leave_out)
                seed = derive_seed(blueprint.seed, "blind", "case", index)
                own = numpy_generator(blueprint.seed, "blind", "day to day", index)
                share = float(own.choice(blueprint.day_to_day))
                return _Planned(case, sample, policy, seed, share)
    raise BlindTestError(
        f"none of the scenarios {', '.join(names)} has a place busy enough to hide "
        f"{task.member or task.group!r}; add a scenario with more traffic"
    )


def _begin(directory: Path, blueprint: Blueprint, cases: tuple[Case, ...]) -> None:
    """Write the plan, and the blueprint beside the labels."""
    sealed = directory / LABELS / "blueprint.json"
    text = json.dumps(asdict(blueprint), indent=1) + "\n"
    planned = (directory / PLAN).exists()
    begun = sealed.exists() and sealed.read_text(encoding="utf-8") == text
    if planned and (read_plan(directory) != cases or not begun):
        raise BlindTestError(
            f"{directory}: holds another blind test; give another directory, or the options it was "
            "made with"
        )
    if not planned and not begun and directory.exists() and any(directory.iterdir()):
        raise BlindTestError(f"{directory}: is not empty and no blind test; give another directory")
    write_whole(sealed, text)
    write_plan(directory, cases)


def _make(directory: Path, blueprint: Blueprint, item: _Planned, scenario: Scenario) -> None:
    """Measure one case and write its label; the label comes last and marks the case as made."""
    measured = record(
        scenario,
        item.sample.effects,
        policy_factory(item.policy),
        periods=blueprint.periods,
        seed=item.seed,
        speeds=blueprint.speeds,
        day_to_day=item.day_to_day,
    )
    write_measured(measured, directory / item.case.case / "measured")
    period = measured.periods[0]
    label = Label(
        case=item.case.case,
        scenario=item.case.scenario,
        group=item.sample.group,
        hidden=item.sample.hidden,
        strength=item.sample.strength,
        effects=tuple(Hidden.of(x, nominal_of(x.name, scenario)) for x in item.sample.effects),
        leave_out=item.sample.leave_out,
        lights=tuple(item.id for item in Network.read(scenario).intersections),
        begin_s=period.begin_s,
        end_s=period.end_s,
        periods=blueprint.periods,
        speeds=blueprint.speeds,
        policy=item.policy,
        seed=item.seed,
        measured=measured.hash,
        day_to_day=item.day_to_day,
    )
    write_label(directory, label)


class Consequences:
    """Compare a day with an effect with the same day without it.

    Args:
        seed: Root of the seed of that day.
    """

    def __init__(self, seed: int) -> None:
        self._seed = derive_seed(seed, "blind", "consequences")
        self._plain: dict[tuple[str, str], Period] = {}

    def has(self, scenario: Scenario, sample: Sample, policy: str) -> bool:
        """Return true if each effect changes the measured data; faults of detectors always do.

        A setting is judged as a whole, because V1 to V4 contain an emergency braking, which alone
        is never seen with drivers who brake as usual.
        """
        alone = [(effect,) for effect in sample.effects if not effect.on_detectors]
        for effects in [sample.effects] if sample.group == "setting" else alone:
            key = (scenario.hash, policy)
            plain = self._plain.get(key)
            if plain is None:
                plain = self._plain[key] = self._day(scenario, policy, ())
            if differing(plain, self._day(scenario, policy, effects)) < LEAST:
                return False
        return True

    def _day(self, scenario: Scenario, policy: str, effects: tuple[Effect, ...]) -> Period:
        day = record(scenario, effects, policy_factory(policy), periods=1, seed=self._seed)
        return day.periods[0]


def differing(one: Period, two: Period) -> int:
    """Return the number of detections that only one of two periods has, to a tenth of a second."""
    return sum(((_seen(one) - _seen(two)) + (_seen(two) - _seen(one))).values())


def _seen(period: Period) -> Counter[tuple[str, float]]:
    return Counter(
        (name, time)
        for name, item in period.passages.items()
        for time in np.round(item.off_s[np.isfinite(item.off_s)], 1).tolist()
    )
