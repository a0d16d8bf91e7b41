"""SUMO's mesoscopic model as an engine: the same observations, from vehicles and their routes."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest

import ugat_marl
from ugat_marl.effects import (
    known_effects,
    late_greens,
    load_scenario,
    parse_domain,
    scenario_in_domain,
    with_late_green_programmes,
)
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.scenarios import Network, UpstreamLanes, sumo_program
from ugat_marl.simulation.mesoscopic import MesoscopicLanes
from ugat_marl.testing.episodes import play, random_actions


class FakeApi:
    """An edge of two lanes, 200 m at 10 m/s: lane 0 leads right, lane 1 straight on and left."""

    def __init__(self) -> None:
        self.at: dict[str, float] = {}  # vehicle to the beginning of its segment
        self.routes: dict[str, tuple[str, ...]] = {}
        self.held_s: dict[str, float] = {}
        self.queue: dict[str, int] = {}
        self.fast: dict[str, float] = {}
        self.lane = self.edge = self.vehicle = self

    def getLinks(self, lane: str) -> Sequence[tuple[str, ...]]:
        return {"in_0": [("right_0",)], "in_1": [("on_0",), ("left_0",)], "wide_0": [("on_0",)],
                "wide_1": [("on_0",), ("left_0",)], "one_0": [("on_0",)], "one_1": [("on_0",)],
                }[lane]  # fmt: skip

    def getLength(self, lane: str) -> float:
        return 200.0

    def getLaneNumber(self, edge: str) -> int:
        return 2

    def getMaxSpeed(self, lane: str) -> float:
        return 10.0

    def getLastStepVehicleIDs(self, edge: str) -> Sequence[str]:
        return [name for name, route in self.routes.items() if route[0] == edge]

    def getLanePosition(self, name: str) -> float:
        return self.at[name]

    def getRoute(self, name: str) -> tuple[str, ...]:
        return self.routes[name]

    def getRouteID(self, name: str) -> str:
        return " ".join(self.routes[name])

    def getRouteIndex(self, name: str) -> int:
        return 0

    def getLaneIndex(self, name: str) -> int:
        return self.queue.get(name, 7)

    def getWaitingTime(self, name: str) -> float:
        return self.held_s.get(name, 0.0)

    def getAllowedSpeed(self, name: str) -> float:
        return self.fast.get(name, 10.0)

    def getSpeed(self, name: str) -> float:
        return 0.0 if name in self.held_s else 8.0

    def enter(self, name: str, edge: str, following: str, at: float = 0.0) -> None:
        self.routes[name], self.at[name] = (edge, following), at


LANES = ("in_0", "in_1", "wide_0", "wide_1", "one_0", "one_1")
LIMITS = np.full(6, 10.0)


def test_vehicles_count_where_their_routes_lead() -> None:
    api = FakeApi()
    measured = MesoscopicLanes(api, LANES, 100.0)
    for name, following in (("a", "right"), ("b", "on"), ("c", "left"), ("d", "left")):
        api.enter(name, "in", following)
    assert measured.measure(0.0, LIMITS)[0].tolist() == [1, 3, 0, 0, 0, 0]
    assert measured.measure(0.0, LIMITS)[2].tolist() == [8, 8, 10, 10, 10, 10], (
        "an empty lane has its limit"
    )


def test_those_behind_a_short_lane_count_by_their_share() -> None:
    api = FakeApi()
    behind = UpstreamLanes(((), (("in_0", 0.5), ("in_1", 0.25)), ()))
    measured = MesoscopicLanes(api, ("wide_0", "one_0", "in_1"), 100.0, behind)
    for name, following in (("a", "right"), ("b", "on"), ("c", "left")):
        api.enter(name, "in", following)
    api.held_s["c"] = 4.0
    limits = np.full(3, 10.0)
    assert measured.measure(0.0, limits).tolist() == [
        [0, 0.5 + 2 * 0.25, 2], [0, 0.25, 1], [10, 6, 4], [0, 1, 4],
    ]  # fmt: skip
    assert list(measured.standing.items()) == [("c", "in_1")]


def test_where_two_lanes_lead_on_the_queue_decides_and_then_the_shorter_one() -> None:
    api = FakeApi()
    measured = MesoscopicLanes(api, LANES, 100.0)
    for name in "abc":
        api.enter(name, "wide", "on")
    assert measured.measure(0.0, LIMITS)[0].tolist() == [0, 0, 2, 1, 0, 0]
    api.enter("d", "wide", "on")
    assert measured.measure(10.0, LIMITS)[0].tolist() == [0, 0, 2, 2, 0, 0], "nobody changes over"
    api.queue, api.at = dict.fromkeys("abcd", 1), dict.fromkeys("abcd", 100.0)
    assert measured.measure(20.0, LIMITS)[0].tolist() == [0, 0, 0, 4, 0, 0]
    for name in "efg":
        api.enter(name, "one", "on")
        api.queue[name] = 0
    found = measured.measure(30.0, LIMITS)[0].tolist()
    assert found == [0, 0, 0, 4, 2, 1], "one queue for both lanes says nothing"


def test_who_stays_longer_than_the_way_takes_halts() -> None:
    """Two segments of 100 m, 10 s each: who has not moved on after that is in a queue."""
    api = FakeApi()
    measured = MesoscopicLanes(api, LANES, 100.0)
    api.enter("a", "in", "right")
    rows = [measured.measure(time_s, LIMITS)[:, 0] for time_s in (0.0, 8.0, 16.0, 24.0)]
    assert [row[1] for row in rows] == [0, 1, 1, 1], "5 s before the first look"
    assert rows[3][3] - rows[2][3] == 8.0 and rows[2][2] == 0
    api.at["a"] = 100.0
    assert measured.measure(32.0, LIMITS)[:, 0].tolist() == [1, 0, 8, 0], "it has moved on"
    api.held_s["a"] = 3.0
    assert measured.measure(33.0, LIMITS)[:, 0].tolist() == [1, 1, 0, 3], "SUMO says so"
    del api.routes["a"]
    assert not measured.measure(40.0, LIMITS)[:2].any()


def test_a_slow_driver_in_free_flow_does_not_wait() -> None:
    api = FakeApi()
    api.fast["slow"] = 5.0
    measured = MesoscopicLanes(api, LANES, 500.0)
    for name in ("slow", "usual"):
        api.enter(name, "in", "right")
    halting = [measured.measure(time_s, LIMITS)[1, 0] for time_s in (0.0, 8.0, 16.0, 24.0)]
    assert halting == [0, 0, 1, 2], "200 m take 40 and 20 s, half of them before the first look"
    assert measured.standing == {"slow": "in_0", "usual": "in_0"}


def test_of_a_queue_that_drives_off_as_many_move_as_have_left() -> None:
    """Six wait, SUMO lists them from the end of the queue; the first of them is held up or not."""
    api = FakeApi()
    measured = MesoscopicLanes(api, LANES, 500.0)
    for name in "fedcba":
        api.enter(name, "in", "right")
    api.held_s["a"] = 30.0
    measured.measure(0.0, LIMITS)
    assert measured.measure(50.0, LIMITS)[:, 0].tolist() == [6, 6, 0, 6 * 40.0], "in since -10 s"
    for gone, halting in (("ab", 2), ("c", 0)):
        api.held_s = {}
        for name in gone:
            del api.routes[name]
        assert measured.measure(50.0, LIMITS)[1, 0] == halting
    api.held_s["d"] = 1.0
    assert measured.measure(51.0, LIMITS)[1, 0] == 3, "red again: all of them stand"


# --- in the running simulation


class PlainLook:
    """The same numbers, by asking every vehicle for everything at every look."""

    def __init__(self, lanes: Sequence[str], segment_m: float) -> None:
        self.lanes = lanes
        self.links = {lane: {x[0][:-2] for x in libsumo.lane.getLinks(lane)} for lane in lanes}
        self.of: dict[str, list[int]] = {}
        for place, lane in enumerate(lanes):
            self.of.setdefault(lane[:-2], []).append(place)
        self.segment_m = segment_m
        self.known: dict[str, tuple[str, float, float, int, float]] = {}
        self.left = [0] * len(lanes)
        self.asked, self.moving, self.looked_s = 0, 0, -1e9

    def look(self, time_s: float, limits: Any) -> Any:
        ask, rows = libsumo.vehicle, np.zeros((4, len(self.lanes)))
        before, self.known = self.known, {}
        for edge, own in self.of.items():
            metres = libsumo.lane.getLength(edge + "_0")
            pieces = max(1, int(metres / self.segment_m + 0.5))
            queues: dict[int, list[tuple[str, float, float]]] = {lane: [] for lane in own}
            for name in libsumo.edge.getLastStepVehicleIDs(edge):
                self.asked += 1
                at_m = ask.getLanePosition(name)
                was = before.get(name, ("", 0.0, 0.0, -1, 0.0))
                moved, since_s, needs_s = was[:2] != (edge, at_m), was[2], was[4]
                if was[0] != edge:
                    needs_s = metres / pieces / ask.getAllowedSpeed(name)
                if moved:
                    since_s = time_s - min(time_s - self.looked_s, needs_s) / 2
                following = (*ask.getRoute(name), "")[ask.getRouteIndex(name) + 1]
                fit = [x for x in own if following in self.links[self.lanes[x]]] or own
                several = len(set[str]().union(*(self.links[self.lanes[x]] for x in own))) > 1
                queue = f"{edge}_{ask.getLaneIndex(name)}" if several else ""
                lane = min(fit, key=lambda x: rows[0, x])
                if was[0] == edge and was[3] in fit:
                    lane = was[3]
                lane = next((x for x in fit if self.lanes[x] == queue), lane)
                rows[0, lane] += 1.0
                queues[lane].append((name, time_s - since_s - needs_s, needs_s))
                self.known[name] = edge, at_m, since_s, lane, needs_s
            for name, was in before.items():
                if was[0] == edge and self.known.get(name, ("",))[0] != edge:
                    self.left[was[3]] += 1
            for lane, queue in queues.items():
                self.queue(lane, queue, limits[lane], rows)
        self.looked_s = time_s
        rows[2] = np.where(rows[0] > 0, rows[2] / np.maximum(rows[0], 1.0), limits)
        return rows

    def queue(self, lane: int, names: Any, limit: float, rows: Any) -> None:
        """Adds the vehicles of one lane, the one at the stop line last."""
        ask = libsumo.vehicle
        wait = [name for name, waited, _ in names if waited > 0]
        if wait and ask.getWaitingTime(names[-1][0]) > 0:
            self.left[lane] = 0
        start = wait[::-1][: self.left[lane]]
        self.moving += len(start)
        for name, waited, _ in names:
            if name not in wait:
                speed, held = ask.getSpeed(name), ask.getWaitingTime(name)
                rows[1:, lane] += (speed < 0.1, speed, held)
            elif name not in start:
                rows[1:, lane] += (1.0, 0.0, waited)
        for name, waited, needs_s in names:
            if name in start:
                rows[2, lane] += limit * needs_s / (needs_s + waited)


@pytest.mark.parametrize(
    ("scenario", "domain", "seconds", "least"),
    [
        ("single-v1", "meso", 3600.0, 30_000),
        ("mixed-v1", "meso+heavy-loads", 900.0, 8_000),
        ("single-v1", "queue_model=30", 900.0, 4_000),
    ],
)
def test_what_is_not_asked_again_has_not_changed(
    scenario: str, domain: str, seconds: float, least: int
) -> None:
    """At every decision of an episode with random phases."""
    env = ugat_marl.parallel_env(
        scenario, domain, observation="waiting", duration_s=seconds, simulator="inprocess"
    )
    choose = np.random.default_rng(3)
    table = env.network.lane_table()
    try:
        env.reset(seed=2)
        plain = PlainLook(table.ids, 30.0 if "30" in domain else 500.0)
        limits = np.array([libsumo.lane.getMaxSpeed(lane) for lane in table.ids])
        actions: dict[str, int] = {}
        for step in range(int(seconds) // 10):
            rows = plain.look(env.snapshot.time_s, limits)
            got = env.snapshot
            for row, ours in zip(
                rows, (got.vehicles, got.halting, got.mean_speed_mps, got.waiting_s), strict=True
            ):
                assert row.tolist() == pytest.approx(ours.tolist(), rel=1e-12), (step, got.time_s)
            if step % 2 == 0:
                actions = {
                    agent: int(choose.integers(env.action_space(agent).n)) for agent in env.agents
                }
            env.step(actions)
        assert plain.asked > least and plain.moving > least / 100
    finally:
        env.close()


def test_the_engine_is_an_effect_no_diagnosis_looks_for(tmp_path: Path) -> None:
    assert "queue_model" not in known_effects()
    scenario = load_scenario("single-v1")
    changed = scenario_in_domain(scenario, "meso")
    assert parse_domain("meso") == parse_domain("queue_model=500")
    assert changed.hash != scenario.hash and changed.documents == scenario.documents
    assert load_scenario(changed.write(tmp_path / "written")).hash == changed.hash


def test_queues_do_not_drive_on_in_yellow() -> None:
    """SUMO's would, at the full rate: what agents show between two greens is red."""
    scenario = load_scenario("single-v1").with_control(yellow_s=3.0, all_red_s=2.0)
    changed = scenario_in_domain(scenario, "meso")
    assert (changed.control.yellow_s, changed.control.all_red_s) == (0.0, 5.0)
    assert Network.read(changed).intersections == Network.read(scenario).intersections
    env = ugat_marl.parallel_env(scenario, "meso", duration_s=300, simulator="inprocess")
    shown: set[str] = set()
    try:
        env.reset(seed=1)
        for step in range(10):
            env.step({"signal_0": step % 8})
            shown |= set("".join(libsumo.trafficlight.getRedYellowGreenState("A1")))
    finally:
        env.close()
    assert "y" not in shown


def approach(directory: Path, **flows: float) -> tuple[Path, dict[str, list[int]]]:
    """single-v1 with flows from the west alone, in veh/h by edge; phases green for each."""
    scenario = load_scenario("single-v1")
    scenario.write(directory)
    demand = directory / "demand.rou.xml"
    root = ET.parse(demand).getroot()
    kept = [ET.tostring(item, "unicode") for item in root.iter("vType")]
    kept += [
        f'<flow id="{to}" type="car" begin="0" end="3600" vehsPerHour="{vph}" departLane="best" '
        f'departSpeed="max"><route edges="west1_A1 {to}"/></flow>'
        for to, vph in flows.items()
    ]
    demand.write_text("".join(["<routes>", *kept, "</routes>"]))
    item = Network.read(load_scenario(directory)).intersections[0]
    greens: dict[str, list[int]] = {to: [] for to in flows}
    for link in item.links:
        for number, phase in enumerate(item.phases):
            if (
                link.from_edge == "west1_A1"
                and link.to_lane[:-2] in flows
                and phase[link.index] == "G"
            ):
                greens[link.to_lane[:-2]].append(number)
    return directory, greens


def served(scenario: Path, domain: str, phases: Sequence[int], to: str) -> list[int]:
    """Vehicles that have come to an edge by each decision, under one phase after the other."""
    env = ugat_marl.parallel_env(scenario, domain, simulator="inprocess")
    seen: set[str] = set()
    counts: list[int] = []
    try:
        env.reset(seed=1)
        for phase in phases:
            env.step({"signal_0": phase})
            seen.update(libsumo.edge.getLastStepVehicleIDs(to))
            counts.append(len(seen))
    finally:
        env.close()
    return counts


@pytest.mark.parametrize(("decisions", "expected"), [(1, 2), (2, 7), (3, 12)])
def test_a_green_serves_what_it_does_in_car_following(
    tmp_path: Path, decisions: int, expected: int
) -> None:
    """A green of g s serves 1 + (g - 2) / h, rounded down; h = 1.4 s + 7.5 m / 13.9 m/s.

    The lane is full whenever its green begins. SUMO looks at a red light once in a second, so that
    queues may start up to 1 s late: that changes no number here.
    """
    path, greens = approach(tmp_path / "west-v1", A1_east1=3600.0)
    green = greens["A1_east1"][0]
    red = next(x for x in range(8) if x not in greens["A1_east1"])
    length = 10 * decisions - 5
    bounds = [1 + int((length - 2 - late) / (1.4 + 7.5 / 13.9)) for late in (0.0, 0.999)]
    assert bounds == [expected, expected]
    cycle = [green] * decisions + [red] * 6
    means = {}
    for domain in ("sim", "meso"):
        counts = served(path, domain, [red] * 6 + cycle * 8, "A1_east1")
        ends = counts[5 :: len(cycle)]
        means[domain] = (ends[-1] - ends[1]) / 7
    assert means["meso"] == expected
    assert means["sim"] == pytest.approx(expected, abs=0.7)


def test_a_full_turning_lane_blocks_no_other(tmp_path: Path) -> None:
    """Left-turners see red for ten minutes: 30 fit on their lane, but not in its last 100 m."""
    path, greens = approach(tmp_path / "west-v1", A1_east1=600.0, A1_northA=180.0)
    straight = next(x for x in greens["A1_east1"] if x not in greens["A1_northA"])
    street, whole, short = (
        served(path, domain, [straight] * 60, "A1_east1")[-1]
        for domain in ("sim", "meso", "queue_model=100")
    )
    assert street == pytest.approx(600 / 6, abs=10)
    assert whole == pytest.approx(street, abs=3)
    assert short < street - 20


@pytest.mark.parametrize("domain", ["meso+late_green=*,1", "late_green=*,1+meso"])
def test_a_late_green_comes_on_top_of_that_of_queues(domain: str) -> None:
    assert late_greens(scenario_in_domain(load_scenario("single-v1"), "meso")) == {"A1": 2.0}
    assert late_greens(scenario_in_domain(load_scenario("single-v1"), domain)) == {"A1": 3.0}


def test_a_programme_that_jumps_is_an_error_only_where_lateness_was_asked_for(
    crossing: Callable[..., Path],
) -> None:
    path = crossing(edit=lambda text: text.replace("<phase ", '<phase next="0" '))
    scenario = scenario_in_domain(load_scenario(path), "meso")
    before, after = (
        [phase.attrib for phase in item.network.parse().iter("phase")]
        for item in (scenario, with_late_green_programmes(scenario))
    )
    assert before == after and before
    with pytest.raises(ScenarioError, match="next="):
        with_late_green_programmes(scenario_in_domain(load_scenario(path), "meso+late_green=*,1"))


def test_lanes_hold_all_vehicles_that_go_their_way() -> None:
    env = ugat_marl.parallel_env("single-v1", "meso", duration_s=900, simulator="inprocess")
    item = env.network.intersections[0]
    lanes = env.network.lane_table().ids
    leads = {lane: {x.to_lane[:-2] for x in item.links if x.from_lane == lane} for lane in lanes}
    seen = 0
    try:
        env.reset(seed=1)
        while env.agents:
            env.step({"signal_0": (seen // 40) % 8})
            if not env.agents:
                break
            for lane, count in zip(lanes, env.snapshot.vehicles, strict=True):
                edge = lane.rpartition("_")[0]
                if leads[lane]:
                    goes = [
                        libsumo.vehicle.getRoute(name)[1] in leads[lane]
                        for name in libsumo.edge.getLastStepVehicleIDs(edge)
                    ]
                    assert count == sum(goes)
                    seen += sum(goes)
            assert (env.snapshot.halting <= env.snapshot.vehicles).all()
        assert seen > 1000
    finally:
        env.close()


def test_signals_are_obeyed() -> None:
    """Only through traffic of north and south, and right turns, get through the first phase."""
    env = ugat_marl.parallel_env("single-v1", "meso", duration_s=600, simulator="inprocess")
    try:
        env.reset(seed=1)
        arrived: set[str] = set()
        ways: dict[str, tuple[str, ...]] = {}
        for _ in range(59):
            env.step({"signal_0": 0})
            now = set(libsumo.vehicle.getIDList())
            ways |= {name: libsumo.vehicle.getRoute(name) for name in now}
            arrived |= set(ways) - now
    finally:
        env.close()
    greens = {(x.from_edge, x.to_lane[:-2]) for x in env.network.intersections[0].links
              if env.network.intersections[0].phases[0][x.index] in "Gg"}  # fmt: skip
    assert len(arrived) > 50
    assert {ways[name] for name in arrived} == greens
    assert len(set(ways.values()) - greens) >= 6, "others wanted to"


def test_a_policy_fits_both_engines_and_a_seed_repeats() -> None:
    def episode(domain: str, **options: Any) -> Any:
        env = ugat_marl.parallel_env(
            "mixed-v1", domain, observation="waiting", duration_s=300, **options
        )
        try:
            return env.layouts, play(env, 5, random_actions(5), 999)
        finally:
            env.close()

    layouts, here = episode("meso", simulator="inprocess")
    _, there = episode("meso")
    other, _ = episode("sim")
    assert layouts == other
    assert here.scores == there.scores
    for ours, theirs in zip(here.moments, there.moments, strict=True):
        for agent, vector in ours.observations.items():
            assert np.array_equal(vector, theirs.observations[agent])


def test_queues_are_about_those_of_car_following() -> None:
    """The same signals: a fixed cycle through eight phases, an hour, as many vehicles."""
    scores: list[Any] = []
    for domain in ("sim", "meso"):
        env = ugat_marl.parallel_env("single-v1", domain)
        try:
            cycle = lambda step, *_: {"signal_0": (step // 3) % 8}  # noqa: E731
            scores.append(play(env, 1, cycle, 999).scores)
        finally:
            env.close()
    street, queues = scores
    assert queues.due == street.due
    assert queues.queue == pytest.approx(street.queue, rel=0.25)
    assert queues.att_s == pytest.approx(street.att_s, rel=0.15)


@pytest.mark.parametrize(
    ("domain", "options"),
    [
        ("meso+detection_zone=50", {}),
        ("meso", {"crossings": True}),
        ("meso", {"render_mode": "rgb_array"}),  # vehicles would lie at the ends of roads
    ],
)
def test_what_needs_positions_is_refused(domain: str, options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="mesoscopic model.*leave out queue_model"):
        ugat_marl.parallel_env("single-v1", domain, duration_s=60, **options)


def test_a_queue_beyond_a_node_counts_upstream_as_in_car_following(tmp_path: Path) -> None:
    """A road to the light is 80 m long, and 420 m lie before it, far into which its queue reaches.

    The queue model has no waves of moving vehicles in a long queue, so it counts more who stand.
    """
    (tmp_path / "n.xml").write_text(
        '<nodes><node id="W" x="-500" y="0"/><node id="M" x="-80" y="0" type="priority"/>'
        '<node id="J" x="0" y="0" type="traffic_light"/><node id="E" x="300" y="0"/>'
        '<node id="N" x="0" y="300"/><node id="S" x="0" y="-300"/></nodes>'
    )
    edges = "".join(f'<edge id="{a}{b}" from="{a}" to="{b}"/>' for a, b in ROADS)
    (tmp_path / "e.xml").write_text(f"<edges>{edges}</edges>")
    command = [str(sumo_program("netconvert")), "-n", "n.xml", "-e", "e.xml", "-o", "c.net.xml"]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    (tmp_path / "c.rou.xml").write_text(
        '<routes><route id="we" edges="WM MJ JE"/><route id="ns" edges="NJ JS"/>'
        '<flow id="a" route="we" begin="0" end="600" vehsPerHour="900"/>'
        '<flow id="b" route="ns" begin="0" end="600" vehsPerHour="300"/></routes>'
    )
    (tmp_path / "c.sumocfg").write_text(
        '<configuration><net-file value="c.net.xml"/><route-files value="c.rou.xml"/>'
        '<begin value="0"/><end value="600"/></configuration>'
    )
    upstream = {domain: mean_upstream(tmp_path / "c.sumocfg", domain) for domain in ("sim", "meso")}
    assert upstream["sim"] > 3.0
    assert 1.0 < upstream["meso"] / upstream["sim"] < 2.5


ROADS = ("WM", "MJ", "JE", "NJ", "JS")


def mean_upstream(configuration: Path, domain: str) -> float:
    env = ugat_marl.parallel_env(str(configuration), domain)
    queued: list[float] = []
    try:
        env.reset(seed=1)
        while env.agents:
            turn = len(queued) // 2
            env.step({agent: turn % env.action_space(agent).n for agent in env.agents})
            queued.append(env.snapshot.queued_upstream.sum())
    finally:
        env.close()
    return float(np.mean(queued))
