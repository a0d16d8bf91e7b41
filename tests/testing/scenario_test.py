"""Each check of scenarios catches a scenario that breaks just its rule."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

import ugat_marl
from ugat_marl.effects import scenario_in_domain
from ugat_marl.scenarios import Network, Scenario, shipped_scenarios
from ugat_marl.testing import (
    SCENARIO_CHECKS,
    ScenarioCase,
    check_report,
    check_scenario,
    failed_checks,
    run_checks,
)

Subject = Callable[[Path], ScenarioCase]
BROKEN: list[tuple[str, Subject]] = []


def breaks(check: str) -> Any:
    """Marks a case as one that exactly `check` must catch."""

    def mark(subject: Subject) -> Subject:
        BROKEN.append((check, subject))
        return subject

    return mark


def good() -> Scenario:
    return ugat_marl.load_scenario("single-v1")


def with_routes(change: Callable[[str], str]) -> Scenario:
    scenario = good()
    (routes,) = scenario.routes
    return replace(scenario, routes=(routes.edited(change(routes.read().decode()).encode()),))


def with_phases(*phases: str) -> Scenario:
    scenario = good()
    raw = scenario.settings.model_dump()
    (light,) = Network.read(scenario).intersections
    raw["intersections"] = {light.id: {"phases": phases}}
    return replace(scenario, settings=type(scenario.settings).model_validate(raw))


def phases_of(scenario: Scenario) -> tuple[str, ...]:
    return Network.read(scenario).intersections[0].phases


@breaks("it_loads")
def a_file_is_missing(folder: Path) -> ScenarioCase:
    directory = dict(shipped_scenarios())["single-v1"]
    shutil.copytree(directory, folder / "broken-v1")
    (folder / "broken-v1" / "network.net.xml").unlink()
    return ScenarioCase(folder / "broken-v1")


@breaks("its_network_can_be_controlled")
def a_phase_is_too_short(folder: Path) -> ScenarioCase:
    first, second, *_ = phases_of(good())
    return ScenarioCase(with_phases(first, second[:-1]))


@breaks("its_network_can_be_controlled")
def greens_conflict_in_a_phase(folder: Path) -> ScenarioCase:
    first, *_ = phases_of(good())
    return ScenarioCase(with_phases(first, "G" * len(first)))


@breaks("every_lane_gets_green")
def some_lanes_never_go(folder: Path) -> ScenarioCase:
    first, second, *_ = phases_of(good())
    return ScenarioCase(with_phases(first, second))


@breaks("its_network_can_be_controlled")
def a_state_is_too_short(folder: Path) -> ScenarioCase:
    scenario = good()
    text = scenario.network.read().decode()
    state = re.search(r'<phase [^>]*state="([^"]*)"', text)
    assert state
    text = text.replace(f'state="{state[1]}"', f'state="{state[1][:-1]}"')
    return ScenarioCase(replace(scenario, network=scenario.network.edited(text.encode())))


@breaks("no_greens_conflict")
def a_network_that_was_not_checked(folder: Path) -> ScenarioCase:
    """Reading a network refuses such phases; whoever changes that must still be caught."""

    class Unchecked(ScenarioCase):
        @property
        def network(self) -> Network:
            network = super().network
            (item,) = network.intersections
            phases = (*item.phases, "G" * len(item.phases[0]))
            return replace(network, intersections=(replace(item, phases=phases),))

    return Unchecked(good())


@breaks("its_routes_exist")
def a_route_leads_nowhere(folder: Path) -> ScenarioCase:
    return ScenarioCase(with_routes(lambda text: text.replace("A1_east1", "A1_moon", 1)))


@breaks("its_routes_exist")
def everybody_comes_too_late(folder: Path) -> ScenarioCase:
    return ScenarioCase(
        with_routes(lambda text: re.sub(r'depart="[\d.]+"', 'depart="90000"', text))
    )


@breaks("routes_are_connected")
def a_route_jumps(folder: Path) -> ScenarioCase:
    jump = '<vehicle id="x" depart="3599"><route edges="southA_A1 east1_A1"/></vehicle></routes>'
    return ScenarioCase(with_routes(lambda text: text.replace("</routes>", jump)))


@breaks("vehicles_enter_early")
def nobody_comes_at_first(folder: Path) -> ScenarioCase:
    def later(text: str) -> str:
        return re.sub(r'depart="([\d.]+)"', lambda m: f'depart="{float(m[1]) + 500}"', text)

    return ScenarioCase(with_routes(later))


@breaks("effects_change_it")
def effects_do_nothing(folder: Path) -> ScenarioCase:
    return ScenarioCase(good(), change=lambda scenario, domain: scenario)


@breaks("effects_change_it")
def two_domains_are_the_same(folder: Path) -> ScenarioCase:
    return ScenarioCase(
        good(),
        change=lambda scenario, name: scenario_in_domain(scenario, "V1" if name == "V3" else name),
    )


@dataclass(frozen=True)
class Forgetful(Scenario):
    def write(self, directory: Path) -> Path:
        return self.with_control(yellow_s=4).as_plain().write(directory)

    def as_plain(self) -> Scenario:
        return Scenario(
            self.id, self.network, self.routes, self.additional, self.settings, self.applied
        )


@breaks("writing_keeps_it")
def writing_forgets_a_setting(folder: Path) -> ScenarioCase:
    own = good()
    return ScenarioCase(Forgetful(own.id, own.network, own.routes, own.additional, own.settings))


@pytest.mark.parametrize(
    ("check", "subject"),
    BROKEN,
    ids=[f"{check}-{subject.__name__}" for check, subject in BROKEN],
)
def test_a_broken_scenario_is_caught_by_its_check(
    check: str, subject: Subject, tmp_path: Path
) -> None:
    results = run_checks(SCENARIO_CHECKS, subject(tmp_path))
    caught = {result.name: result.message for result in results if result.passed is False}
    assert set(caught) == {check}, caught
    assert len(caught[check]) > 40


def test_every_check_has_a_broken_scenario() -> None:
    assert {name for name, _ in BROKEN} == {check.__name__ for check in SCENARIO_CHECKS}


@pytest.mark.parametrize("name", dict(shipped_scenarios()))
def test_the_shipped_scenarios_pass(name: str) -> None:
    assert not failed_checks(check_scenario(name))


def test_an_unknown_scenario_is_one_failure_with_its_nearest_name() -> None:
    results = check_scenario("grid2x2")
    assert [result.passed for result in results].count(False) == 1
    assert "Did you mean 'grid2x2-v1'?" in check_report(results).plain
