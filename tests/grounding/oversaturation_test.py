"""A planted jam: greens that lead to a full lane are not taken for greens that serve nobody."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.crossroads import crossroads_with
from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.effects import load_scenario
from ugat_marl.grounding.oversaturation import Oversaturation
from ugat_marl.grounding.summaries import NAMES, LaneView
from ugat_marl.scenarios import Network

LAYOUTS = {"a_0": AgentLayout(1, 2), "b_0": AgentLayout(1, 2)}
GREEN = np.array([[True, False]])
SCALE = np.full(1, 40.0)
VIEW = LaneView(
    ("road_0", "next_0"),
    (GREEN, GREEN),
    (SCALE, SCALE),
    (0, 0),
    np.full(2, 40.0),
    np.full(2, 30.0),
    ((1,), ()),
)
"""The lane at a leads to the lane at b. Each holds 40 vehicles."""
SERVED = 4.0


def log_of(jammed: float, decisions: int = 400) -> TransitionLog:
    """Return a log in which the lane at b is full in a share of the decisions, at the end.

    The light at a is green in three of six decisions. A green serves four vehicles where the next
    lane is free, and none where it is full.
    """
    generator = np.random.default_rng(1)
    recorder = TransitionRecorder(Provenance("by hand", "", "street", (), 10.0, "count", LAYOUTS))
    count, before = 12.0, 1
    for t in range(decisions):
        jam = t >= (1.0 - jammed) * decisions
        phase = 0 if t % 6 < 3 else 1
        served = SERVED if phase == 0 and not jam else 0.0
        then = max(count - served, 6.0) + float(generator.integers(0, 2) if phase == 0 else 4)
        then = min(then, 30.0)
        ahead = 38.0 if jam else 3.0
        both = [
            {
                "a_0": np.array([a / 40.0, *np.eye(2)[shown]]),
                "b_0": np.array([ahead / 40.0, *np.eye(2)[shown]]),
            }
            for a, shown in ((count, before), (then, phase))
        ]
        did = {"a_0": phase, "b_0": phase}
        recorder.record(0, t, both[0], did, did, {"a_0": 0.0, "b_0": 0.0}, both[1])
        count, before = then, phase
    return recorder.log()


def service(view: LaneView, log: TransitionLog) -> float:
    """Return the mean fall of long queues in greens that go on, at a."""
    return float(view.summary(log).values[0, NAMES.index("fall, green goes on, 9 or more")])


def test_service_is_not_biased_by_a_jam() -> None:
    free, jammed = log_of(0.0), log_of(0.5)
    truth = service(VIEW, free)
    assert truth == pytest.approx(SERVED - 0.5, abs=0.3)
    assert service(VIEW, jammed) == pytest.approx(truth, abs=0.3)
    blind = replace(VIEW, onward=((), ()))
    assert service(blind, jammed) < truth - 1.0, "without a look ahead half of the service is gone"


def test_shares_are_those_planted() -> None:
    log = log_of(0.4)
    found = Oversaturation.of(VIEW, VIEW.rows(log), ["a_0", "b_0"])
    assert found.full.tolist() == pytest.approx([0.0, 0.4], abs=0.01)
    assert found.held.tolist() == pytest.approx([0.2, 0.0], abs=0.02)
    first, second = found.describe()
    assert first.startswith("a_0: oversaturated in 20%") and "b_0" in second
    assert found.any[1] == pytest.approx(0.4, abs=0.01)


def test_free_traffic_is_not_called_oversaturated() -> None:
    found = Oversaturation.of(VIEW, VIEW.rows(log_of(0.0)), ["a_0", "b_0"])
    assert found.describe() == []


def test_a_jam_behind_a_node_of_the_map_is_seen(tmp_path: Path) -> None:
    """With `movements`, where the lane behind the light ends at no light."""
    network = Network.read(crossroads_with("", tmp_path, 60, 200))
    (item,) = network.intersections
    own, out = len(item.incoming_lanes), len(item.outgoing_lanes)
    jammed = item.outgoing_lanes.index("ME_0")
    layout = AgentLayout(2 * own + out, len(item.phases))
    recorder = TransitionRecorder(
        Provenance("by hand", "", "street", (), 10.0, "movements", {"a_0": layout})
    )
    for t in range(10):
        seen = np.zeros(layout.features + layout.phases)
        seen[layout.features] = 1.0
        seen[2 * own + jammed] = 0.95 if t < 4 else 0.5
        seen[2 * own + (jammed + 1) % out] = 0.85
        recorder.record(0, t, {"a_0": seen}, {"a_0": 0}, {"a_0": 0}, {"a_0": 0.0}, {"a_0": seen})
    log = recorder.log()
    held = {
        lane: row.held
        for lane, row in zip(
            item.incoming_lanes, LaneView.of(network, "movements").rows(log), strict=True
        )
    }
    leads = {link.from_lane for link in item.links if link.to_lane == "ME_0"}
    assert leads and {lane for lane in held if held[lane].any()} == leads
    assert all(held[lane].tolist() == [True] * 4 + [False] * 6 for lane in leads)
    few = {name: replace(lane, length_m=20.0) for name, lane in network.lanes.items()}
    short = LaneView.of(replace(network, lanes=few), "movements")
    assert not any(row.held.any() for row in short.rows(log)), "one vehicle would fill it"


def test_lanes_of_a_network_know_where_they_lead() -> None:
    view = LaneView.of(Network.read(load_scenario("grid2x2-v1")), "count")
    assert any(view.onward)
    for lane, ways in zip(view.lanes, view.onward, strict=True):
        assert all(view.lanes[k] != lane for k in ways)
    alone = LaneView.of(Network.read(load_scenario("single-v1")), "count")
    assert not any(alone.onward)
