"""Makes blind cases: draws what is hidden, measures it, and seals the label."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from studies.blind.busy import Busy, busy_places
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
from studies.blind.consequence import Consequences
from studies.blind.drawing import GROUPS, Drawn, Task, deck, draw_hidden
from studies.blind.strengths import STRENGTHS, nominal_of
from ugat_marl.data import write_measured
from ugat_marl.effects import load_scenario
from ugat_marl.errors import BlindTestError, OptionError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Network, Scenario
from ugat_marl.seeding import derive_seed, numpy_generator

FIXED_TIMES = ("fixed-time:20", "fixed-time:30", "fixed-time:40")
PRESSURES = ("max-pressure:10", "max-pressure:20")
"""The signals of the hidden world: fixed-time control, and at times one that reacts to traffic."""


@dataclass(frozen=True)
class Blueprint:
    """What decides a blind test, together with the scenarios' files.

    Attributes:
        scenarios: Names of scenarios, as `load` takes them.
        classes: Groups (none, single, pair, setting, outside) and names of effects.
        strengths: Strengths of single effects.
        cases: Number of cases.
        seed: Root of all seeds.
        periods: Days per case.
        speeds: Whether speeds are measured.
        pressure_share: Share of the cases under max-pressure instead of fixed-time control.
        duration_s: Length of a day; None for the scenario's own.
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


@dataclass(frozen=True)
class _Planned:
    """One case before it is measured."""

    case: Case
    drawn: Drawn
    policy: str
    seed: int


def generate(directory: Path, blueprint: Blueprint, reporter: Reporter | None = None) -> int:
    """Writes the cases of a blind test that are not there yet.

    Args:
        directory: New, or one of the same blueprint, which is gone on with.
        blueprint: What decides the test.
        reporter: Shows progress.

    Returns:
        How many cases were made.

    Raises:
        BlindTestError: The directory holds another blind test, or no scenario has a place for what
            is to be hidden.
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
    """Draws all cases; case by case, so that a longer test begins like a shorter one."""
    generator = numpy_generator(blueprint.seed, "blind", "deck")
    tasks = deck(blueprint.classes, blueprint.strengths, blueprint.cases, generator)
    spare = _spare(tasks)
    consequences = Consequences(blueprint.seed)
    planned: list[_Planned] = []
    with reporter.task("drawing what is hidden", len(tasks)) as advance:
        for index, task in enumerate(tasks):
            planned.append(_planned(blueprint, index, task, spare, scenarios, busy, consequences))
            advance()
    return planned


def _spare(tasks: Sequence[Task]) -> dict[str, list[Task]]:
    """By group, what may be drawn instead of something no scenario has a place for."""
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
            drawn = draw_hidden(attempt, scenarios[name], busy[name], generator)
            if drawn is not None:
                policies = FIXED_TIMES
                # In V4 max-pressure locks some networks up, and a standstill says nothing.
                if generator.random() < blueprint.pressure_share and drawn.group != "setting":
                    policies = PRESSURES
                policy = policies[int(generator.integers(len(policies)))]
                if not consequences.has(scenarios[name], drawn, policy):
                    continue
                case = Case(f"case{index + 1:03d}", name, drawn.leave_out)
                seed = derive_seed(blueprint.seed, "blind", "case", index)
                return _Planned(case, drawn, policy, seed)
    raise BlindTestError(
        f"none of the scenarios {', '.join(names)} has a place busy enough to hide "
        f"{task.member or task.group!r}; add a scenario with more traffic"
    )


def _begin(directory: Path, blueprint: Blueprint, cases: tuple[Case, ...]) -> None:
    """Writes the plan, and beside the labels what they were drawn from."""
    sealed = directory / LABELS / "blueprint.json"
    text = json.dumps(asdict(blueprint), indent=1) + "\n"
    if (directory / PLAN).exists() and (
        read_plan(directory) != cases
        or not sealed.exists()
        or sealed.read_text(encoding="utf-8") != text
    ):
        raise BlindTestError(
            f"{directory}: holds another blind test; give another directory, or the options it was "
            "made with"
        )
    if directory.exists() and not (directory / PLAN).exists() and any(directory.iterdir()):
        raise BlindTestError(f"{directory}: is not empty and no blind test; give another directory")
    write_whole(sealed, text)
    write_plan(directory, cases)


def _make(directory: Path, blueprint: Blueprint, item: _Planned, scenario: Scenario) -> None:
    """Measures one case, and seals its label last, which marks it as made."""
    measured = record(
        scenario,
        item.drawn.effects,
        policy_factory(item.policy),
        periods=blueprint.periods,
        seed=item.seed,
        speeds=blueprint.speeds,
    )
    write_measured(measured, directory / item.case.case / "measured")
    period = measured.periods[0]
    label = Label(
        case=item.case.case,
        scenario=item.case.scenario,
        group=item.drawn.group,
        hidden=item.drawn.hidden,
        strength=item.drawn.strength,
        effects=tuple(Hidden.of(x, nominal_of(x.name, scenario)) for x in item.drawn.effects),
        leave_out=item.drawn.leave_out,
        lights=tuple(item.id for item in Network.read(scenario).intersections),
        begin_s=period.begin_s,
        end_s=period.end_s,
        periods=blueprint.periods,
        speeds=blueprint.speeds,
        policy=item.policy,
        seed=item.seed,
        measured=measured.hash,
    )
    write_label(directory, label)
