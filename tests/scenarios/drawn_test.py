"""Drawn networks: valid, repeatable, varied, and as loaded as they say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.__main__ import main
from ugat_marl.errors import OptionError, OutputError, ScenarioError
from ugat_marl.experiments import evaluation_of, problems, rule_factory
from ugat_marl.files import parse_xml
from ugat_marl.scenarios import (
    DrawnNetwork,
    Network,
    NetworkRanges,
    Scenario,
    degrees_of_saturation,
    departures,
    draw_network,
    draw_scenario,
    read_scenario,
    survey,
)
from ugat_marl.scenarios.importers.drawn import approach_lanes, route_shares
from ugat_marl.scenarios.importers.streets import Streets
from ugat_marl.scenarios.importers.turning_shares import walked

SEEDS = range(20)
CONSTANT = ("constant",)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Scenario]:
    folder = tmp_path_factory.mktemp("drawn")
    return {seed: draw_scenario(folder / f"seed{seed}", seed) for seed in SEEDS}


@pytest.mark.slow
def test_every_network_passes_the_check(drawn: dict[int, Scenario]) -> None:
    for seed, scenario in drawn.items():
        facts = survey(scenario)
        assert problems(facts, ()) == [], seed
        assert not facts.uncontrolled
        assert all(len(light.phases) >= 2 for light in facts.intersections)


def test_values_stay_within_their_ranges(drawn: dict[int, Scenario]) -> None:
    ranges = NetworkRanges()
    for seed, scenario in drawn.items():
        network, values = Network.read(scenario), draw_network(seed)
        control = scenario.control
        assert 1 <= len(network.intersections) <= 9
        assert ranges.load[0] <= values.load <= ranges.load[1]
        assert 3 <= control.yellow_s <= 5
        assert 0 <= control.all_red_s <= 2
        assert 5 <= control.decision_interval_s <= 10
        lanes = Counter(lane.edge for lane in network.lanes.values())
        assert set(lanes.values()) <= {1, 2, 3}
        assert all(8 <= lane.speed_mps <= 17 for lane in network.lanes.values())
        assert all(len(arms(values, light.id)) >= 3 for light in network.intersections)
        assert sum(values.entries.values()) == pytest.approx(1)
        assert all(sum(shares) == pytest.approx(1) for shares in values.turns.values())


def arms(values: DrawnNetwork, node: str) -> set[str]:
    return {road.end for road in values.plan.roads.values() if road.start == node}


def test_networks_differ(drawn: dict[int, Scenario]) -> None:
    networks = [Network.read(scenario) for scenario in drawn.values()]
    assert len({scenario.hash for scenario in drawn.values()}) == len(SEEDS)
    assert len({len(network.intersections) for network in networks}) >= 5
    phases = {len(light.phases) for network in networks for light in network.intersections}
    assert {2, 3, 8} <= phases
    kinds = {draw_network(seed).profile for seed in SEEDS}
    assert kinds == {"constant", "rising", "peak"}


def test_the_same_seed_makes_the_same_bytes(tmp_path: Path) -> None:
    for seed in (0, 3):
        for part in "ab":
            draw_scenario(tmp_path / part / f"d{seed}", seed)
        assert contents(tmp_path / "a" / f"d{seed}") == contents(tmp_path / "b" / f"d{seed}")


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def test_the_load_is_that_of_the_busiest_intersection(tmp_path: Path) -> None:
    for seed in range(3):
        ranges = NetworkRanges(load=(0.8, 0.8), profiles=CONSTANT, duration_s=7200)
        scenario = draw_scenario(tmp_path / f"d{seed}", seed, ranges)
        assert max(degrees_of_saturation(scenario).values()) == pytest.approx(0.8, rel=0.08)


def test_the_profile_shapes_the_arrivals(tmp_path: Path) -> None:
    for profile in ("constant", "rising", "peak"):
        ranges = NetworkRanges(
            intersections=(1, 1), profiles=(profile,), lowest_demand=(0.2, 0.2),
            load=(1.0, 1.0), duration_s=7200,
        )  # fmt: skip
        scenario = draw_scenario(tmp_path / profile, 4, ranges)
        times = [depart_s for _, depart_s, _ in departures(scenario, routed=True)]
        counts, _ = np.histogram(times, bins=6, range=(0, 7200))
        values = draw_network(4, ranges)
        wanted = np.array([values.demand_at(600 + 1200 * part) for part in range(6)])
        scale = counts.sum() / wanted.sum()
        assert np.all(abs(counts - scale * wanted) < 4 * np.sqrt(scale * wanted) + 0.05 * scale)


def test_route_shares_are_those_of_drawn_walks(drawn: dict[int, Scenario]) -> None:
    scenario = next(s for s in drawn.values() if len(Network.read(s).intersections) >= 6)
    streets = Streets.of(parse_xml(scenario.network.read(), "net"))
    turns = (0.3, 0.5, 0.2)
    walks = walked(streets, 3000, turns, 7200, 1)
    for entry in streets.entries:
        shares = route_shares(streets, entry, lambda _: turns)
        assert sum(shares.values()) == pytest.approx(1)
        found = Counter(drive.route for drive in walks if drive.route[0] == entry)
        total = sum(found.values())
        for route, share in shares.items():
            spread = 5 * (total * share * (1 - share)) ** 0.5 + 5
            assert abs(found[route] - total * share) < spread


def test_turns_of_vehicles_are_those_drawn(tmp_path: Path) -> None:
    ranges = NetworkRanges(intersections=(1, 1), load=(1, 1), duration_s=20000, profiles=CONSTANT)
    scenario = draw_scenario(tmp_path / "one", 2, ranges)
    values = draw_network(2, ranges)
    streets = Streets.of(parse_xml(scenario.network.read(), "net"))
    counts = Counter(pair for _, _, edges in departures(scenario, routed=True)
                     for pair in pairwise(edges))  # fmt: skip
    entries = Counter[str]()
    for (here, _), count in counts.items():
        entries[here] += count
    for entry, share in values.entries.items():
        assert entries[entry] / sum(entries.values()) == pytest.approx(share, abs=0.02)
        shares = dict(zip("lsr", values.turns[entry], strict=True))
        ahead = {turn: roads[0] for turn, roads in streets.ahead[entry].items()}
        possible = sum(shares[turn] for turn in ahead)
        for turn, road in ahead.items():
            wanted = shares[turn] / possible
            assert counts[entry, road] / entries[entry] == pytest.approx(wanted, abs=0.04)


@pytest.mark.parametrize(
    ("turns", "count", "ahead", "left_lane", "lanes"),
    [
        ("lsr", 1, 1, True, ("srl",)),
        ("lsr", 2, 2, True, ("sr", "l")),
        ("lsr", 2, 2, False, ("sr", "sl")),
        ("lsr", 3, 3, True, ("sr", "s", "l")),
        ("lsr", 3, 1, False, ("srl",)),
        ("lr", 3, 0, False, ("r", "l")),
        ("lr", 1, 0, True, ("rl",)),
        ("sr", 2, 2, True, ("sr", "s")),
        ("ls", 2, 2, True, ("s", "l")),
    ],
)
def test_lanes_of_an_approach(
    turns: str, count: int, ahead: int, left_lane: bool, lanes: Sequence[str]
) -> None:
    assert approach_lanes(frozenset(turns), count, ahead, left_lane=left_lane) == lanes


def open_vehicles(scenario: Scenario, duration_s: float) -> tuple[float, float]:
    """Vehicles due, and those that have not arrived at the end."""
    name = "largest-queue:60"
    played = evaluation_of(
        scenario.with_duration(duration_s), {name: rule_factory(name)}, ("sim",), (1,), workers=1
    )
    due = float(played.values(name, "sim", "due")[0])
    return due, due - float(played.values(name, "sim", "throughput")[0])


@pytest.mark.parametrize("seed", [20, *(pytest.param(n, marks=pytest.mark.slow) for n in (21, 22))])
def test_queues_grow_well_beyond_capacity_and_not_well_below(seed: int, tmp_path: Path) -> None:
    """The load is an estimate: just above 1 some networks still flow."""
    growth: dict[float, float] = {}
    for load in (0.4, 1.3):
        ranges = NetworkRanges(load=(load, load), profiles=CONSTANT, intersections=(1, 2))
        scenario = draw_scenario(tmp_path / f"load{load}", seed, ranges)
        (due, before), (all_due, after) = (open_vehicles(scenario, s) for s in (900, 1800))
        growth[load] = (after - before) / (all_due - due)
    assert growth[0.4] < 0.04
    assert growth[1.3] > 0.04


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("a", "b"):
        assert main(["scenario", "new", str(tmp_path / folder / "town"), "--draw", "7"]) == 0
    library = draw_scenario(tmp_path / "c" / "town", 7)
    hashes = {read_scenario(tmp_path / folder / "town").hash for folder in "ab"}
    assert hashes == {library.hash}
    capsys.readouterr()
    for words in (["--grid", "2x2"], ["--vph", "300"], ["--duration-s", "60"]):
        assert main(["scenario", "new", str(tmp_path / "d"), "--draw", "7", *words]) == 2
        assert words[0] in capsys.readouterr().err


@pytest.mark.parametrize(
    "values",
    [
        {"intersections": (0, 3)}, {"intersections": (7, 8)}, {"lanes": (3, 2)},
        {"load": (0.5, 9.0)}, {"shift": 0.3}, {"profiles": ()}, {"turns": (0.0, 1.0, 0.0)},
        {"profiles": ("foo",)}, {"turns": (0.5, 0.5)}, {"turns": (float("nan"), 0.5, 0.5)},
        {"turns": (0.5, float("nan"), 0.5)}, {"load": (0.5, 0.6, 0.7)}, {"lanes": (1,)},
        {"load": (0.5, float("nan"))}, {"lanes": 2}, {"load": [0.5, 0.6]}, {"shift": (0.1, 0.2)},
        {"duration_s": (600.0, 900.0)}, {"shift": (0.1,)}, {"turns": 0.5},
    ],
)  # fmt: skip
def test_impossible_ranges(values: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        draw_network(1, NetworkRanges(**values))  # pyright: ignore[reportArgumentType]


def test_roads_may_be_as_fast_as_the_ranges_say(tmp_path: Path) -> None:
    ranges = NetworkRanges(speed_mps=(60, 60), intersections=(2, 2), irregular=1.0)
    lanes = Network.read(draw_scenario(tmp_path / "fast", 1, ranges)).lanes
    assert {lane.speed_mps for lane in lanes.values()} == {60.0}


def test_nothing_is_left_where_nobody_enters(tmp_path: Path) -> None:
    ranges = NetworkRanges(intersections=(1, 1), duration_s=20, load=(0.01, 0.01))
    with pytest.raises(ScenarioError, match="nobody enters"):
        draw_scenario(tmp_path / "empty", 1, ranges)
    assert not list(tmp_path.iterdir())


def test_another_scenario_is_not_replaced(tmp_path: Path) -> None:
    draw_scenario(tmp_path / "town", 1)
    with pytest.raises(OutputError):
        draw_scenario(tmp_path / "town", 2)
    assert draw_scenario(tmp_path / "town", 2, force=True).id == "town"
