"""Checks of a scenario: network, phases, demand, effects, files."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ugat_marl.effects import PAPER_WORLDS, load_scenario, scenario_in_domain
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.scenarios import (
    GREEN,
    Demand,
    Intersection,
    Network,
    Scenario,
    check_demand,
    conflicting_greens,
    read_scenario,
)
from ugat_marl.testing.episodes import begin, proceed, random_actions
from ugat_marl.testing.results import CheckResult, NotChecked, require, run_checks

Change = Callable[[Scenario, str], Scenario]
"""Function that puts a scenario into a domain."""


class ScenarioCase:
    """Scenario that is checked.

    Args:
        name: Name, directory or scenario, as for `ugat_marl.load_scenario`.
        seed: Seed of the short simulations.
        change: Function that puts a scenario into a domain.
    """

    def __init__(
        self, name: str | Path | Scenario, seed: int = 1, change: Change = scenario_in_domain
    ) -> None:
        self.name = name
        self.seed = seed
        self._change = change
        self._domains: dict[str, Scenario] = {}
        self._failed: set[str] = set()
        self._envs: list[TrafficEnv] = []

    @cached_property
    def _scenario(self) -> Scenario:
        return load_scenario(self.name)

    @cached_property
    def _network(self) -> Network:
        return Network.read(self.scenario)

    @property
    def scenario(self) -> Scenario:
        """The scenario, with the effects that its own file names."""
        return self._once("_scenario", "it cannot be loaded")

    @property
    def network(self) -> Network:
        """Network of the scenario."""
        return self._once("_network", "its network cannot be used")

    @cached_property
    def _demand(self) -> Demand:
        return check_demand(self.scenario, self.network)

    @property
    def demand(self) -> Demand:
        """Demand of the scenario, in which all edges exist."""
        return self._once("_demand", "its routes do not exist")

    def in_domain(self, domain: str) -> Scenario:
        """Return the scenario in a domain."""
        if domain not in self._domains:
            self._domains[domain] = self._change(self.scenario, domain)
        return self._domains[domain]

    def need_demand(self) -> None:
        """Skip a check that simulates if the demand or the network is broken.

        Raises:
            NotChecked: The scenario cannot be simulated.
        """
        _ = self.demand

    def _once(self, attribute: str, why: str) -> Any:
        if attribute in self._failed:
            raise NotChecked(f"not checked, because {why}")
        self._failed.add(attribute)
        value = getattr(self, attribute)
        self._failed.discard(attribute)
        return value

    def environment(self, scenario: Scenario) -> TrafficEnv:
        """Return an environment of the scenario; `tidy` closes it."""
        env = parallel_env(scenario)
        self._envs.append(env)
        return env

    def tidy(self) -> None:
        """Close the environments of the last check."""
        while self._envs:
            self._envs.pop().close()


def it_loads(case: ScenarioCase) -> None:
    """The files of the scenario exist and its settings are valid."""
    require(case.scenario.decisions > 0, f"scenario {case.scenario.id!r} has no decision in it")


def its_network_can_be_controlled(case: ScenarioCase) -> None:
    """The network has traffic lights with phases that can be shown and do not conflict."""
    require(case.network.intersections, "the network has no traffic light")


def every_lane_gets_green(case: ScenarioCase) -> None:
    """Every lane and every link is green in some phase; otherwise vehicles wait for ever."""
    for intersection in case.network.intersections:
        served = _served(intersection)
        links = [link for link in intersection.links if link.index not in served]
        lanes = {link.from_lane for link in intersection.links if link.index in served}
        never = [lane for lane in intersection.incoming_lanes if lane not in lanes]
        require(
            not never,
            f"traffic light {intersection.id!r}: no phase gives green to the lanes {never}; add a "
            'phase under [intersections] or use phases = "conflict-free"',
        )
        require(
            not links,
            f"traffic light {intersection.id!r}: the links {[link.index for link in links]} (from "
            f"{sorted({link.from_lane for link in links})}) are green in no phase; vehicles that "
            "turn there block their lane for ever",
        )


def _served(intersection: Intersection) -> set[int]:
    may_go = GREEN | {"s"}
    return {
        i for phase in intersection.phases for i, letter in enumerate(phase) if letter in may_go
    }


def no_greens_conflict(case: ScenarioCase) -> None:
    """No phase and no state of the network's own programme gives green to crossing streams."""
    foes = _foes(case.scenario)
    for intersection in case.network.intersections:
        shown = {
            "phase": intersection.phases,
            "programme": [state for _, state in intersection.programme],
        }
        for origin, states in shown.items():
            for state in states:
                pair = conflicting_greens(state, intersection.links, foes)
                require(
                    not pair,
                    f"traffic light {intersection.id!r}: the {origin} {state!r} gives protected "
                    f"green (G) to the links {pair}, whose ways cross; write g for the one that "
                    "must yield, or split the phase",
                )


def _foes(scenario: Scenario) -> dict[str, list[int]]:
    """Return junction to a bit mask of foes for each row of its right-of-way matrix."""
    foes: dict[str, list[int]] = {}
    for junction in scenario.network.parse().iter("junction"):
        rows = sorted(junction.iter("request"), key=lambda row: int(row.get("index", "0")))
        foes[junction.get("id", "")] = [int(row.get("foes", "0"), 2) for row in rows]
    return foes


def its_routes_exist(case: ScenarioCase) -> None:
    """All routes use edges of the network, and at least one vehicle departs."""
    require(case.demand.vehicles or case.demand.flows, "nobody departs within the episode")


def routes_are_connected(case: ScenarioCase) -> None:
    """Each edge of a written route leads to the next one."""
    case.need_demand()
    leads = {
        (element.get("from"), element.get("to"))
        for element in case.scenario.network.parse().iter("connection")
    }
    for document in (*case.scenario.routes, *case.scenario.additional):
        for who, edges in _routes(document.parse()):
            for a, b in zip(edges, edges[1:], strict=False):
                require(
                    (a, b) in leads,
                    f"{document.source}: {who} goes from edge {a!r} to {b!r}, but no connection "
                    "leads there; route the demand again (duarouter)",
                )


def _routes(root: ET.Element) -> list[tuple[str, list[str]]]:
    routes: list[tuple[str, list[str]]] = []
    for parent in root.iter():
        for element in parent:
            if element.tag == "route" and element.get("edges"):
                name = element.get("id") or parent.get("id") or "?"
                routes.append((f"the route of {name!r}", element.get("edges", "").split()))
    return routes


def vehicles_enter_early(case: ScenarioCase) -> None:
    """At least one vehicle enters within the first tenth of the episode."""
    case.need_demand()
    decisions = max(1, case.scenario.decisions // 10)
    seconds = decisions * case.scenario.control.decision_interval_s
    early = case.scenario.with_duration(seconds)
    env = case.environment(early)
    moment = begin(env, case.seed)
    choose = random_actions(case.seed)
    for step in range(decisions):
        moment = proceed(env, choose(step, env, moment.infos))
    scores = env.scores()
    require(
        scores.departed > 0,
        f"no vehicle has entered in the first {seconds:g} s ({scores.backlog:g} are due); check "
        "begin_s, departure times and departLane",
    )


def effects_change_it(case: ScenarioCase) -> None:
    """V1 to V4 can be applied, give four new hashes, and run in SUMO."""
    case.need_demand()
    hashes = {case.scenario.hash: "sim"}
    for name in PAPER_WORLDS:
        changed = case.in_domain(name)
        other = hashes.setdefault(changed.hash, name)
        require(
            other == name,
            f"{name} has the hash of {other}: the effects change nothing; they must reach every "
            "vType in use and the default type",
        )
        env = case.environment(changed)
        moment = begin(env, case.seed)
        proceed(env, random_actions(case.seed)(0, env, moment.infos))


def writing_keeps_it(case: ScenarioCase) -> None:
    """A scenario that is written and loaded again has the same hash, in `sim` and in V4."""
    for domain in ("sim", "V4"):
        changed = case.in_domain(domain)
        with TemporaryDirectory(prefix="ugat_marl-check-") as folder:
            again = read_scenario(changed.write(Path(folder) / "written-v1"))
            require(
                again.hash == changed.hash,
                f"in {domain}, the scenario that was written and loaded has another hash: "
                f"{again.hash[:12]} instead of {changed.hash[:12]}; write all files and settings",
            )


SCENARIO_CHECKS = (
    it_loads,
    its_network_can_be_controlled,
    every_lane_gets_green,
    no_greens_conflict,
    its_routes_exist,
    routes_are_connected,
    vehicles_enter_early,
    effects_change_it,
    writing_keeps_it,
)
"""All checks of a scenario; each takes a `ScenarioCase`."""


def check_scenario(name: str | Path | Scenario, seed: int = 1) -> list[CheckResult]:
    """Check a scenario.

    The checks simulate a tenth of an episode in `sim` and one decision in each of V1 to V4.

    Args:
        name: Name, directory or scenario, as for `ugat_marl.load_scenario`.
        seed: Seed of the simulations.
    """
    return run_checks(SCENARIO_CHECKS, ScenarioCase(name, seed))
