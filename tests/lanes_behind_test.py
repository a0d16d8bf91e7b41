"""Lanes at lights that are shorter than a vehicle: who waits behind them is seen."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET

import numpy as np
import pytest

import ugat_marl
from ugat_marl.controllers import controller_for
from ugat_marl.effects import load
from ugat_marl.junctions import behind_of
from ugat_marl.network import Network
from ugat_marl.networks.survey import survey
from ugat_marl.redraw import sumo_program
from ugat_marl.scenario import Scenario

NODES = {"M": (0, 0), "N": (0, 200), "S": (0, -200), "W": (-200, 0), "w": (-11, 0), "E": (200, 0)}
ROADS = ("Ww", "wM", "ME", "NM", "MS", "SM", "MN")


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    """A crossroads whose western road has a node of the map 11 m before the middle."""
    folder = tmp_path_factory.mktemp("split")
    nodes = "".join(
        f'<node id="{name}" x="{x}" y="{y}" type="{"traffic_light" if name == "M" else "priority"}"'
        "/>"
        for name, (x, y) in NODES.items()
    )
    edges = "".join(f'<edge id="{r}" from="{r[0]}" to="{r[1]}" speed="13"/>' for r in ROADS)
    (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml",
         "--no-turnarounds"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    cars = "".join(
        f'<vehicle id="{i}" depart="{2 * i}"><route edges="Ww wM ME"/></vehicle>' for i in range(8)
    )
    (folder / "r.rou.xml").write_text(f"<routes>{cars}</routes>")
    (folder / "scenario.toml").write_text(
        'network = "n.net.xml"\nroutes = ["r.rou.xml"]\nduration_s = 200\n'
    )
    return load(folder)


def test_a_short_lane_has_the_lane_behind(split: Scenario) -> None:
    network = Network.read(split)
    short = network.lanes["wM_0"]
    assert short.length_m < 7.5
    assert [name for name, _ in short.behind][-1] == "Ww_0"
    assert all(share == 1.0 for _, share in short.behind)
    assert short.room_m == pytest.approx(short.length_m + network.lanes["Ww_0"].length_m)
    assert short.capacity == pytest.approx(short.room_m / 7.5)
    assert network.lanes["NM_0"].behind == ()
    (item,) = survey(split).intersections
    assert item.lanes_behind == ("wM_0",)


def test_who_waits_behind_is_counted(split: Scenario) -> None:
    """Eight cars and a red light: none has room on the lane itself."""
    env = ugat_marl.parallel_env(split, reward="waiting", observation="waiting")
    (item,) = env.network.intersections
    letter = next(link.index for link in item.links if link.from_lane == "wM_0")
    red = next(i for i, state in enumerate(item.phases) if state[letter] == "r")
    green = next(i for i, state in enumerate(item.phases) if state[letter] in "Gg")
    env.reset(seed=1)
    (agent,) = env.agents
    for _ in range(6):
        env.step({agent: red})
    lane = env.network.lane_table().ids.index("wM_0")
    assert env.snapshot.vehicles[lane] == env.snapshot.halting[lane] == 8
    assert env.snapshot.mean_speed_mps[lane] < 0.1
    assert env.snapshot.waiting_s[lane] > 8 * 20
    for _ in range(6):
        env.step({agent: green})
    assert env.snapshot.vehicles[lane] == 0
    assert env.snapshot.mean_speed_mps[lane] == pytest.approx(13)
    env.close()


def test_a_rule_serves_them(split: Scenario) -> None:
    env = ugat_marl.parallel_env(split, observation="movements")
    rule = controller_for("largest-queue:10", env)
    observations, infos = env.reset(seed=1)
    while env.agents:
        observations, _, _, _, infos = env.step(rule.act(observations, infos))
    assert env.scores().throughput == 8
    env.close()


def net(*links: str) -> ET.Element:
    """``a0>b1`` is a way from lane 0 of road a to lane 1 of road b; with ``*`` it has a light."""
    parts = ""
    for text in links:
        start, end = text.rstrip("*").split(">")
        light = ' tl="T" linkIndex="0"' if text.endswith("*") else ""
        parts += (
            f'<connection from="{start[0]}" fromLane="{start[1]}" to="{end[0]}" toLane="{end[1]}" '
            f'via=":{start}{end}"{light}/>'
        )
    return ET.fromstring(f"<net>{parts}</net>")


LENGTHS_M = {"a_0": 3.0, "a_1": 3.0, "b_0": 50.0, "c_0": 2.0, "d_0": 50.0}


def test_a_lane_that_leads_to_two_is_shared() -> None:
    found = behind_of(net("b0>a0", "b0>a1", "a0>z0*", "a1>z1*"), LENGTHS_M, 7.5)
    assert found == {
        "a_0": {":b0a0": 1.0, "b_0": 0.5},
        "a_1": {":b0a1": 1.0, "b_0": 0.5},
    }


def test_one_looks_back_until_there_is_room() -> None:
    found = behind_of(net("b0>c0", "c0>a0", "a0>z0*"), LENGTHS_M, 7.5)
    assert list(found["a_0"]) == [":c0a0", "c_0", ":b0c0", "b_0"]
    assert list(behind_of(net("b0>c0", "c0>a0", "a0>z0*"), LENGTHS_M, 5.0)["a_0"])[-1] == "c_0"


@pytest.mark.parametrize(
    "links",
    [
        ("b0>a0*", "a0>z0*"),  # who stands there waits for the other light
        ("b0>a0", "b0>d0", "a0>z0*"),  # who stands there may go elsewhere
        ("b0>d0", "d0>z0*"),  # there is room
        ("a0>a0", "a0>z0*"),  # a circle
    ],
)
def test_what_is_not_behind(links: tuple[str, ...]) -> None:
    assert behind_of(net(*links), LENGTHS_M, 7.5) == {}


def test_other_networks_are_measured_as_before() -> None:
    table = Network.read(load("single-v1")).lane_table()
    assert table.behind == ()
    assert np.all(table.capacity > 1)
