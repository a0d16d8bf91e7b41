"""The shipped scenarios: what their READMEs promise, and that their sources still make them."""

from __future__ import annotations

import importlib.metadata
import math
import os
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.experiments import HeadroomRow, measure_headroom
from ugat_marl.reporting import headroom_markdown
from ugat_marl.scenarios import (
    Network,
    RoadPlan,
    build_network,
    netconvert_documents,
    read_road_plan,
    read_scenario,
    shipped_scenarios,
)

FOLDER = Path(__file__).resolve().parents[2] / "scenarios"
PHASES = {
    "single-v1": [8],
    "grid2x2-v1": [8] * 4,
    "grid4x4-v1": [8] * 16,
    "arterial1x5-v1": [8] * 5,
    "mixed-v1": [8, 3, 6, 2, 2, 4, 3],
}
BUILT_WITH = "1.28."
"""Other versions of netconvert may write the same network in other words."""

every_scenario = pytest.mark.parametrize("name", PHASES)


@cache
def source(name: str) -> dict[str, Any]:
    return tomllib.loads((FOLDER / name / "source.toml").read_text(encoding="utf-8"))


@cache
def network(name: str) -> Network:
    return Network.read(read_scenario(FOLDER / name))


@cache
def vehicles(name: str) -> list[tuple[str, float, str | None, list[str]]]:
    """Id, departure, type and edges of every vehicle."""
    root = ET.parse(FOLDER / name / "demand.rou.xml").getroot()
    found: list[tuple[str, float, str | None, list[str]]] = []
    for vehicle in root.iter("vehicle"):
        route = vehicle.find("route")
        assert route is not None
        departs = float(vehicle.attrib["depart"])
        found.append(
            (vehicle.attrib["id"], departs, vehicle.get("type"), route.attrib["edges"].split())
        )
    return found


@cache
def turns(name: str) -> dict[tuple[str, str], str]:
    """(edge, next edge) to s, l or r."""
    return {
        (link.from_edge, link.to_lane.rsplit("_", 1)[0]): link.direction.lower()
        for item in network(name).intersections
        for link in item.links
    }


def headroom_rows(name: str) -> list[list[str]]:
    text = (FOLDER / name / "README.md").read_text(encoding="utf-8")
    table = text.partition("<!-- headroom: begin -->\n")[2].partition("<!-- headroom: end -->")[0]
    return [
        [cell.strip(" *") for cell in line.strip("|").split("|")]
        for line in table.splitlines()
        if line.startswith("|")
    ]


def test_all_and_only_these_are_shipped() -> None:
    assert {name for name, _ in shipped_scenarios()} == set(PHASES)
    assert {file.parent.name for file in FOLDER.glob("*/scenario.toml")} == set(PHASES)


@every_scenario
def test_the_shipped_copy_is_the_one_in_the_checkout(name: str) -> None:
    assert read_scenario(name).hash == read_scenario(FOLDER / name).hash


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not importlib.metadata.version("eclipse-sumo").startswith(BUILT_WITH):
        pytest.skip(f"the shipped networks were made by netconvert {BUILT_WITH}x")
    folder = tmp_path_factory.mktemp("scenarios")
    # Another order of hashing and no SUMO_HOME: neither may show in the files.
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONSAFEPATH", "SUMO_HOME")}
    subprocess.run(
        [sys.executable, str(FOLDER / "build.py"), "--into", str(folder)],
        env=environment | {"PYTHONHASHSEED": "7"},
        check=True,
        capture_output=True,
    )
    return folder


@every_scenario
@pytest.mark.parametrize("file", ["network.net.xml", "demand.rou.xml"])
def test_sources_make_the_same_bytes(name: str, file: str, rebuilt: Path) -> None:
    assert (rebuilt / name / file).read_bytes() == (FOLDER / name / file).read_bytes()


@every_scenario
def test_files_tell_neither_date_nor_place(name: str) -> None:
    for file in ("network.net.xml", "demand.rou.xml"):
        text = (FOLDER / name / file).read_text(encoding="utf-8")
        assert "<!--" not in text
        assert not [part for part in FOLDER.parts[1:] if f"/{part}/" in text]


@every_scenario
def test_intersections_and_phases_are_as_promised(name: str) -> None:
    items = network(name).intersections
    assert [len(item.phases) for item in items] == PHASES[name]
    assert not network(name).uncontrolled
    assert all("." not in item.id for item in items)


def test_the_eight_phases_of_the_paper() -> None:
    (item,) = network("single-v1").intersections
    served = {
        frozenset(
            (link.from_edge.rstrip("1A_")[0], link.direction)
            for link in item.links
            if phase[link.index] == "G" and link.direction != "r"
        )
        for phase in item.phases
    }
    pairs = [("n", "s"), ("e", "w")]
    assert served == {
        *(frozenset({(a, turn), (b, turn)}) for a, b in pairs for turn in "sl"),
        *(frozenset({(arm, "s"), (arm, "l")}) for arm in "nesw"),
    }


@every_scenario
def test_no_u_turns_and_every_lane_leads_somewhere(name: str) -> None:
    for item in network(name).intersections:
        assert {link.direction.lower() for link in item.links} <= {"s", "l", "r"}
        own = {
            lane.id for lane in network(name).lanes.values() if lane.edge.endswith(f"_{item.id}")
        }
        assert set(item.incoming_lanes) == own


@every_scenario
def test_every_link_is_served_by_a_phase_and_by_the_programme(name: str) -> None:
    for item in network(name).intersections:
        for states in (item.phases, [state for _, state in item.programme]):
            served = {link.index for link in item.links for s in states if s[link.index] in "Gg"}
            assert served == {link.index for link in item.links}


@every_scenario
def test_programmes_last_90_s_and_show_yellow_before_red(name: str) -> None:
    for item in network(name).intersections:
        assert sum(duration for duration, _ in item.programme) == 90
        states = [state for _, state in item.programme]
        for before, after in zip(states, states[1:] + states[:1], strict=True):
            stopped = [(a, b) for a, b in zip(before, after, strict=True) if a in "Gg" and b == "r"]
            assert not stopped
        if name != "mixed-v1":
            assert not any("g" in state for state in states)


@every_scenario
def test_routes_can_be_driven_and_leave_the_network(name: str) -> None:
    possible, entries = turns(name), set(source(name)["demand"]["entries"])
    for id_, _, _, edges in vehicles(name):
        assert id_.rsplit("_", 1)[0] == edges[0].split("_")[0]
        assert edges[0].split("_")[0] in entries
        assert all(pair in possible for pair in zip(edges, edges[1:], strict=False)), edges
        assert not any(edge == edges[-1] for edge, _ in possible), "ends at a junction"
        junctions = [edge.split("_")[1] for edge in edges]
        assert len(set(junctions)) == len(junctions), "passes a junction twice"


@every_scenario
def test_departures_are_in_order_within_the_hour_with_unique_ids(name: str) -> None:
    departures = [vehicle[1] for vehicle in vehicles(name)]
    assert departures == sorted(departures)
    assert 0 <= departures[0] < 30
    assert 3570 < departures[-1] < 3600
    assert len({vehicle[0] for vehicle in vehicles(name)}) == len(departures)


@every_scenario
def test_every_entry_and_every_bin_has_its_rate(name: str) -> None:
    """Poisson counts lie within four standard deviations of the rate times the profile."""
    demand = source(name)["demand"]
    by_entry = Counter(edges[0].split("_")[0] for *_, edges in vehicles(name))
    for entry, flow in demand["entries"].items():
        assert abs(by_entry[entry] - flow["vph"]) < 4 * math.sqrt(flow["vph"])
    for profile, factors in demand["profiles"].items():
        assert sum(factors) / len(factors) == pytest.approx(1)
        assert max(factors) >= 1.2
        members = {e: f["vph"] for e, f in demand["entries"].items() if f["profile"] == profile}
        bins = Counter(
            int(departs // (3600 / len(factors)))
            for _, departs, _, edges in vehicles(name)
            if edges[0].split("_")[0] in members
        )
        for part, factor in enumerate(factors):
            expected = sum(members.values()) / len(factors) * factor
            assert abs(bins[part] - expected) < 4 * math.sqrt(expected)


@every_scenario
def test_demand_is_asymmetric_and_has_a_peak(name: str) -> None:
    rates = sorted(flow["vph"] for flow in source(name)["demand"]["entries"].values())
    assert rates[-1] >= 1.2 * rates[0]
    by_quarter = Counter(int(departs // 900) for _, departs, _, _ in vehicles(name))
    assert max(by_quarter[1], by_quarter[2]) > 1.15 * max(by_quarter[0], by_quarter[3])


@every_scenario
def test_turning_shares(name: str) -> None:
    """Four standard deviations, and 3 % more where walks that cross their own path are dropped."""
    shares = source(name)["demand"]["turns"]
    seen: dict[str, Counter[str]] = {}
    for *_, edges in vehicles(name):
        for pair in zip(edges, edges[1:], strict=False):
            seen.setdefault(pair[0], Counter())[turns(name)[pair]] += 1
    slack = 0.0 if name == "single-v1" else 0.03
    for edge, counts in seen.items():
        total = sum(counts.values())
        served = {turn for (start, _), turn in turns(name).items() if start == edge}
        wanted = {turn: shares.get(edge, shares["default"])[turn] for turn in served}
        for turn, share in wanted.items():
            expected = share / sum(wanted.values())
            spread = 4 * math.sqrt(expected * (1 - expected) / total)
            assert abs(counts[turn] / total - expected) <= spread + slack, (edge, turn)


def test_mixed_has_vehicles_of_every_kind_of_type() -> None:
    kinds = Counter(kind for _, _, kind, _ in vehicles("mixed-v1"))
    total = sum(kinds.values())
    for kind, share in {"car": 0.5, None: 0.3, "fleet": 0.2}.items():
        assert kinds[kind] / total == pytest.approx(share, abs=0.04)
    root = ET.parse(FOLDER / "mixed-v1" / "demand.rou.xml").getroot()
    (mix,) = root.iter("vTypeDistribution")
    assert mix.attrib["vTypes"].split() == ["car", "truck"]
    assert {kind.attrib["id"] for kind in root.iter("vType")} == {"car", "truck"}


@every_scenario
def test_readme_states_headroom_of_at_least_15_percent(name: str) -> None:
    heading, _, *rows = headroom_rows(name)
    assert heading[0] == "ATT [s]"
    lost = heading.index("lost by the rule best in sim")
    table = {row[0]: row for row in rows}
    assert list(table) == ["sim", "V1", "V2", "V3", "V4"]
    assert float(table["V4"][lost].rstrip("%")) >= 15
    too_late = sum(departs > 3599 for _, departs, _, _ in vehicles(name))
    assert float(table["sim"][-1]) <= too_late, "vehicles never get in, under the best rule in sim"


@pytest.mark.slow
def test_headroom_is_there_when_measured() -> None:
    rows = measure_headroom(read_scenario("single-v1"), ["sim", "V4"], (20, 40), [100], workers=2)
    assert [row.best_hold_s for row in rows] == [20, 40]
    assert rows[0].lost == 0
    assert rows[1].lost == pytest.approx(rows[1].att_s[0] / rows[1].att_s[1] - 1)
    assert rows[1].lost > 0.15
    assert [row.backlog for row in rows] == [0, 0]
    assert all(row.finished > 0.95 for row in rows)


def test_headroom_table_marks_the_best_hold() -> None:
    row = HeadroomRow("V4", (100.0, 80.0), 90.0, 20, 0.25, 0.975, 3.0)
    assert headroom_markdown([row], (10, 20)).splitlines()[-1] == (
        "| V4 | 100.0 | **80.0** | 90.0 | 25% | 97.5% | 3 |"
    )


def test_headroom_of_nothing_is_refused() -> None:
    with pytest.raises(OptionError, match="at least one"):
        measure_headroom(read_scenario("single-v1"), ["sim"], (), [0])


def plan(there: list[str], beyond: list[str]) -> RoadPlan:
    """Two roads in a row, ``A_j`` and ``j_B``, and one south."""
    table = {
        "junctions": {"j": [0, 0]},
        "ends": {"A": [-100, 0], "B": [100, 0], "C": [0, -100]},
        "roads": [
            {"between": ["A", "j"], "there": there, "back": ["s"]},
            {"between": ["j", "B"], "there": beyond, "back": ["s"]},
            {"between": ["C", "j"], "there": ["rl"], "back": [""]},
        ],
    }
    return read_road_plan(table)


def test_builder_connects_lanes_by_turn() -> None:
    found = plan(["r", "s"], ["", "", ""])
    links = [(a, road.id, b) for a, road, b in found.connections(found.roads["A_j"])]
    assert links == [(0, "j_C", 0), (1, "j_B", 0), (1, "j_B", 1), (1, "j_B", 2)]
    links = [(a, road.id, b) for a, road, b in found.connections(found.roads["C_j"])]
    assert links == [(0, "j_B", 0), (0, "j_A", 0)]


@pytest.mark.parametrize(
    ("there", "beyond", "message"),
    [
        (["s", "l"], ["", ""], "no road to the left"),
        (["s", "s"], [""], "more lanes straight on"),
    ],
)
def test_builder_refuses_impossible_lanes(
    there: list[str], beyond: list[str], message: str
) -> None:
    found = plan(there, beyond)
    with pytest.raises(ScenarioError, match=message):
        found.connections(found.roads["A_j"])


def test_builder_passes_on_what_netconvert_says() -> None:
    found = plan(["sr"], [""])
    with pytest.raises(ScenarioError, match="no-such-option"):
        build_network(netconvert_documents(found, 13.9), {"no-such-option": 1})
