"""Lights for more than cars: bicycle lanes beside car lanes, crossings with a light at each end."""

from __future__ import annotations

import re
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import (
    Network,
    PlanPhase,
    SignalPlan,
    movement_codes,
    programme_notes,
    programme_plan,
    sumo_program,
    with_plans,
)
from ugat_marl.scenarios.junctions import crossings_of, foes_of, yields_of
from ugat_marl.scenarios.phases import RightOfWay

ARMS = {"n": (0, 200), "e": (200, 0), "s": (0, -200), "w": (-200, 0)}


def four_arms(folder: Path, lanes: str, more: str = "", phases: str = "conflict-free") -> Path:
    """A scenario on four arms with a light in the middle."""
    folder.mkdir()
    nodes = "".join(f'<node id="{k}" x="{x}" y="{y}"/>' for k, (x, y) in ARMS.items())
    edges = "".join(
        f'<edge id="{start}{end}" from="{start}" to="{end}" speed="13.9" {lanes}'
        for arm in ARMS
        for start, end in ((arm, "C"), ("C", arm))
    )
    files = {
        "n.nod.xml": f'<nodes>{nodes}<node id="C" x="0" y="0" type="traffic_light"/></nodes>',
        "n.edg.xml": f"<edges>{edges}</edges>",
        "n.con.xml": f"<connections>{more}</connections>",
        "r.rou.xml": '<routes><trip id="t" depart="0" from="nC" to="Cs"/></routes>',
        "scenario.toml": f'network = "n.net.xml"\nroutes = ["r.rou.xml"]\nduration_s = 60\n'
        f'[control]\nphases = "{phases}"\n',
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-x", "n.con.xml",
         "-o", "n.net.xml", "--no-turnarounds"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return folder


def test_who_turns_across_a_bicycle_lane_beside_it_waits(tmp_path: Path) -> None:
    lanes = (
        'numLanes="2"><lane index="0" allow="bicycle"/><lane index="1" disallow="bicycle"/></edge>'
    )
    scenario = load_scenario(four_arms(tmp_path / "bicycles-v1", lanes))
    network, root = Network.read(scenario), scenario.network.parse()
    (light,) = network.intersections
    rules = RightOfWay(foes_of(root), yields_of(root))
    beside = [
        (a, b)
        for a in light.links
        for b in light.links
        if a.from_edge == b.from_edge and a.from_lane != b.from_lane and rules.waits(a, b)
    ]
    assert beside, "the test needs a car that crosses a bicycle lane"
    both = [(p, a, b) for p in light.phases for a, b in beside if p[b.index] == "G"]
    assert both
    assert all(phase[a.index] in "gr" for phase, a, _ in both)


@pytest.mark.parametrize("phases", ["conflict-free", "permitted"])
def test_both_lights_of_a_crossing_are_green_together(phases: str, tmp_path: Path) -> None:
    lanes = 'numLanes="1" sidewalkWidth="2"/>'
    crossings = "".join(
        f'<crossing node="C" edges="{k}C C{k}" priority="true" linkIndex="{12 + 2 * n}" '
        f'linkIndex2="{13 + 2 * n}"/>'
        for n, k in enumerate(ARMS)
    )
    scenario = load_scenario(four_arms(tmp_path / "crossings-v1", lanes, crossings, phases))
    text = scenario.network.read().decode()
    named = re.sub(
        r"(?<=[\":])C(?=[_\"])", "town_center", text
    )  # "_c" stands in it as in crossings
    assert named.count("town_center_c") == text.count(":C_c")
    for root in (scenario.network.parse(), ET.fromstring(named)):
        (links,) = crossings_of(root).values()
        assert sorted(link.index for link in links) == list(range(12, 20))
    assert sorted(link.index for link in links) == list(range(12, 20))
    (light,) = Network.read(scenario).intersections
    for first in range(12, 20, 2):
        letters = [(phase[first], phase[first + 1]) for phase in light.phases]
        assert all(a == b for a, b in letters)
        assert ("G", "G") in letters or ("g", "g") in letters


def test_a_plan_that_shows_crossings_longer_is_noted(tmp_path: Path) -> None:
    """netconvert gives people on foot 5 s of red before vehicles get yellow; a plan has none."""
    crossings = "".join(
        f'<crossing node="C" edges="{arm}C C{arm}" priority="true"/>' for arm in ARMS
    )
    lanes = 'numLanes="1" sidewalkWidth="2"/>'
    scenario = load_scenario(four_arms(tmp_path / "walks-v1", lanes, crossings))
    network = Network.read(scenario)
    (light,) = network.intersections
    (note,) = programme_notes(scenario, [programme_plan(light, network)], "p.csv")
    assert "C (crossings" in note


def test_a_crossing_stays_green_while_only_the_other_ring_ends(tmp_path: Path) -> None:
    """Southbound ends 20 s before northbound; both crossings beside them stay green as long."""
    crossings = "".join(
        f'<crossing node="C" edges="{arm}C C{arm}" priority="true"/>' for arm in ARMS
    )
    scenario = load_scenario(
        four_arms(tmp_path / "rings-v1", 'numLanes="1" sidewalkWidth="2"/>', crossings)
    )
    network = Network.read(scenario)
    (light,) = network.intersections
    codes = set(movement_codes(light, network).values())
    north, south = ({code for code in codes if code[:2] == way} for way in ("NB", "SB"))
    phases = (
        PlanPhase(1, 1, tuple(sorted(north)), 40, 3, 2),
        PlanPhase(2, 1, tuple(sorted(south)), 20, 3, 2),
        PlanPhase(2, 1, (), 20, 3, 2),
        PlanPhase(1, 2, tuple(sorted(codes - north - south)), 40, 3, 2),
    )
    planned = with_plans(scenario, [SignalPlan(light.id, 80, 0, phases)], "plan")
    (light,) = Network.read(planned).intersections
    rows = [
        "".join(state[walk.index] for s, state in light.programme for _ in range(round(s)))
        for walk in light.crossings
    ]
    for row in rows:
        assert sum(a != "G" and b == "G" for a, b in zip(row[-1] + row, row, strict=False)) == 1, (
            row
        )
    assert sum(row[:35] == "G" * 35 and "G" not in row[35:40] for row in rows) == 2
    assert sum("G" not in row[:40] and row[40:75] == "G" * 35 for row in rows) == 2, "not before"
