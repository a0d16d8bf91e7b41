"""Rules with a cycle, followed by hand: actuated, Webster, the green wave."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.policies import ControlledNetwork, FixedTime, make_rule
from ugat_marl.policies.rules.actuated import Actuated, DelayActuated
from ugat_marl.policies.rules.green_wave import GreenWave, main_roads
from ugat_marl.policies.rules.webster import Webster, webster_plan
from ugat_marl.scenarios import Intersection, Link, edge_of_lane

# Two lanes with a phase each, and one for a third that nobody needs to leave by.
INCOMING = ("n_0", "w_0", "e_0")
PHASES = ("Grr", "rGr", "rrG")
LINKS = tuple(Link(i, lane, "out_0", "s") for i, lane in enumerate(INCOMING))
CAPACITY = {"n_0": 40.0, "w_0": 20.0, "e_0": 10.0, "out_0": 40.0}
FREE_FLOW_S = {"n_0": 24.0, "w_0": 12.0, "e_0": 6.0, "out_0": 24.0}
AGENT = "signal_0"


def streets() -> ControlledNetwork:
    item = Intersection("x", INCOMING, ("out_0",), LINKS, PHASES, (), (), (0.0, 0.0))
    return ControlledNetwork({AGENT: item}, CAPACITY, FREE_FLOW_S, 10.0, 5.0)


def movements(halting: Any, vehicles: Any, shown: int = 0) -> dict[str, Any]:
    capacity = np.array([CAPACITY[lane] for lane in INCOMING])
    parts = [np.array(halting) / capacity, np.array(vehicles) / capacity, [0.0], np.eye(3)[shown]]
    return {AGENT: np.concatenate(parts).astype(np.float32)}


def waiting(seconds: Any, shown: int = 0) -> dict[str, Any]:
    capacity = np.array([CAPACITY[lane] for lane in INCOMING])
    parts = [np.array(seconds) / capacity / 100.0, np.eye(3)[shown]]
    return {AGENT: np.concatenate(parts).astype(np.float32)}


def shown_by(rule: Any, *seen: dict[str, Any]) -> list[int]:
    return [rule.act(each, {})[AGENT] for each in seen]


def test_actuated_goes_on_while_vehicles_stand_or_come_close_together():
    rule = Actuated(streets(), longest_s=60, gap_s=3)
    queue = movements([2, 1, 0], [5, 1, 0])
    stream = movements([0, 1, 0], [8, 1, 0])  # 24 s / 3 s = 8 vehicles on the lane
    gap = movements([0, 1, 0], [7, 1, 0])
    assert shown_by(rule, queue, queue, stream, gap, gap) == [0, 0, 0, 1, 1]  # w_0 stands
    # the same seven vehicles are a stream for a gap of 3.5 s
    assert shown_by(Actuated(streets(), 60, 3.5), gap, gap, gap) == [0, 0, 0]


def test_actuated_ends_at_the_longest_green_if_another_phase_is_called():
    rule = Actuated(streets(), longest_s=30)
    busy = movements([9, 3, 0], [9, 3, 0])
    assert shown_by(rule, *[busy] * 8) == [0, 0, 0, 1, 1, 1, 0, 0]  # the third phase is skipped
    rule.reset(0)
    alone = movements([9, 0, 0], [9, 0, 0])
    assert shown_by(rule, *[alone] * 6) == [0] * 6
    assert shown_by(rule, busy) == [1]  # it has long been its turn


def test_actuated_takes_phases_in_turn_and_rests_where_nobody_is():
    rule = Actuated(streets(), longest_s=20)
    empty, last = movements([0, 0, 0], [0, 0, 0]), movements([0, 0, 0], [0, 0, 1])
    assert shown_by(rule, last, empty, empty) == [2, 2, 2]
    everywhere = movements([1, 1, 1], [1, 1, 1])
    assert shown_by(rule, *[everywhere] * 6) == [0, 0, 1, 1, 2, 2]


def test_delay_actuated_ends_when_those_who_waited_move():
    rule = DelayActuated(streets(), longest_s=60, most_waiting_s=10)
    assert shown_by(rule, waiting([90, 30, 5]), waiting([11, 30, 5])) == [0, 0]
    # 9 s on n_0 pay no more; the 5 s on e_0 call no green
    assert shown_by(rule, waiting([9, 30, 5]), waiting([40, 0, 5])) == [1, 0]
    with pytest.raises(OptionError, match="observation='waiting'"):
        rule.act({AGENT: np.zeros(5, np.float32)}, {})


@pytest.mark.parametrize(
    ("ratios", "decisions"),
    [
        # L = 10, C = 20 / 0.5 = 40 s: 30 s of green as 18 + 12, phases of 23 and 17 s
        ((0.3, 0.2), [2, 2]),
        # L = 10, C = 20 / 0.3 = 66.7 s: 56.7 s as 48.6 + 8.1, phases of 53.6 and 13.1 s
        ((0.6, 0.1), [6, 1]),
        # L = 15, C = 27.5 / 0.5 = 55 s: 40 s as 24 + 8 + 8, phases of 29, 13 and 13 s
        ((0.3, 0.1, 0.1), [3, 2, 1]),
        # L = 10, C = 20 s: 10 s as 5 + 5; the formula knows no demand either
        ((0.0, 0.0), [1, 1]),
        # L = 10, oversaturated: 180 s, 170 as 127.5 + 42.5, phases of 132.5 and 47.5 s
        ((0.9, 0.3), [13, 5]),
    ],
)
def test_websters_cycle_and_splits(ratios: tuple[float, ...], decisions: list[int]):
    assert webster_plan(ratios, 5.0, 10.0) == decisions


def test_no_planned_phase_is_shorter_than_clearance_and_minimum_green():
    # 7 decisions for phases of 53.6 and 13.1 s; 5 + 15 s are 2 decisions, 5 + 16 s are 3
    assert webster_plan((0.6, 0.1), 5.0, 10.0, 15.0) == [5, 2]
    assert webster_plan((0.6, 0.1), 5.0, 10.0, 16.0) == [5, 3]
    held = replace(streets(), min_green_s=15.0)
    assert shown_by(FixedTime(held, 10), *[{}] * 7) == [0, 0, 1, 1, 2, 2, 0]
    assert shown_by(GreenWave(held, 10), *[{}] * 7) == [0, 0, 1, 1, 2, 2, 0]
    assert Webster(replace(held, min_green_s=25.0)).plan(AGENT) == [3, 3, 3]


@pytest.mark.parametrize("spec", ["fixed-time:10", "green-wave:10:10"])
def test_a_plan_shows_each_of_its_phases_whatever_the_minimum_green(spec: str):
    env = parallel_env("single-v1", "min_green=15", duration_s=200)
    with contextlib.closing(env):
        rule, shown = make_rule(spec, env), Counter[int]()
        rule.reset(1)
        observations, infos = env.reset(seed=1)
        while env.agents:
            *_, infos = env.step(rule.act(observations, infos))
            shown.update(env.phases)
    (approach,) = ControlledNetwork.of(env).approaches.values()
    assert {*shown} == {*approach.cycle} and min(shown.values()) >= 2


def test_webster_counts_what_comes_in_red():
    rule = Webster(streets(), saturation_vph=1800)
    # nothing counted yet: 20 s each. In red n_0 grows by 1 in 10 s, w_0 by 2.
    vehicles = np.array([3.0, 0.0, 0.0])
    shown: list[int] = []
    phase = 0
    for _ in range(6):
        phase = rule.act(movements([0, 0, 0], vehicles, phase), {})[AGENT]
        shown.append(phase)
        grows = np.array([1.0, 2.0, 0.0])
        grows[phase] = -1.0  # leaves; must not be counted
        vehicles = np.maximum(vehicles + grows, 0)
    assert shown == [0, 0, 1, 1, 2, 2]
    # 0.1 and 0.2 vehicles a second of 0.5: ratios 0.2, 0.4 and 0, L = 15,
    # C = 27.5 / 0.4 = 68.75 s, 53.75 s as 17.9 + 35.8: phases of 22.9, 40.8 and 5 s
    rule.act(movements([0, 0, 0], vehicles, phase), {})
    assert rule.plan(AGENT) == [2, 4, 1]
    rule.reset(0)
    assert rule.plan(AGENT) == [2, 2, 2]


def test_webster_keeps_the_flow_of_a_lane_that_is_full():
    rule, roads = Webster(streets(), saturation_vph=1800), streets()
    capacity = roads.approaches[AGENT].capacity
    for vehicles in np.arange(0.0, 120.0, 2.0):  # n_0 and w_0 have red; n_0 fills, w_0 does not
        rule.act(movements([0, 0, 0], np.minimum([vehicles, 0, 0], capacity), 2), {})
    counted = rule._counts[AGENT].flows_per_s()
    assert counted is not None
    assert counted == pytest.approx([0.2, 0.0, 0.0], rel=0.05)


def test_webster_forgets_old_counts():
    rule = Webster(streets())
    heavy, light = 5.0, 0.5
    for growth, steps in ((heavy, 60), (light, 600)):
        vehicles = np.zeros(3)
        for _ in range(steps):
            rule.act(movements([0, 0, 0], vehicles, 0), {})
            vehicles = vehicles + np.array([0.0, growth, 0.0])
            if vehicles[1] > 10:  # they leave while w_0 is green
                rule.act(movements([0, 0, 0], vehicles, 1), {})
                vehicles = np.zeros(3)
    counted = rule._counts[AGENT].flows_per_s()
    assert counted is not None
    assert counted[1] == pytest.approx(0.05, rel=0.05)


def row_of(lights: int, apart_s: float) -> ControlledNetwork:
    """Lights in a row from west to east; side streets from the north."""
    items: dict[str, Intersection] = {}
    free_flow_s: dict[str, float] = {}
    for k in range(lights):
        incoming = (f"north{k}_0", f"r{k}_0", f"l{k + 1}_0")
        outgoing = (f"south{k}_0", f"r{k + 1}_0", f"l{k}_0")
        links = tuple(
            Link(i, a, b, "s") for i, (a, b) in enumerate(zip(incoming, outgoing, strict=True))
        )
        phases = ("Grr", "rGG")
        free_flow_s |= dict.fromkeys((*incoming, *outgoing), apart_s)
        items[f"signal_{k}"] = Intersection(
            f"x{k}", incoming, outgoing, links, phases, (), (), (0.0, 0.0)
        )
    road_s = dict.fromkeys(map(edge_of_lane, free_flow_s), apart_s)
    return ControlledNetwork(
        items, dict.fromkeys(free_flow_s, 40.0), free_flow_s, 10.0, 5.0, road_s
    )


def test_the_main_road_runs_through_all_lights():
    (road,) = main_roads(row_of(3, apart_s=21))
    assert road.agents == ("signal_0", "signal_1", "signal_2")
    assert road.edges == ("r0", "r1", "r2")
    assert road.arrival_s == (0.0, 21.0, 42.0)
    assert len(main_roads(streets())) == 1


def test_a_node_between_two_lights_does_not_end_the_road():
    """Maps cut roads where something changes; travel times then are those of all pieces."""
    whole = row_of(3, apart_s=21)
    cut = whole.intersections["signal_0"]
    links = tuple(
        replace(link, to_lane="piece_0") if link.to_edge == "r1" else link for link in cut.links
    )
    pieces = replace(
        whole,
        intersections={**whole.intersections, "signal_0": replace(cut, links=links)},
        road_s={**whole.road_s, "piece": 8.0, "other": 1.0, "r1": 12.0},
        straight={"piece": "other", "other": "r1"},
    )
    (road,) = main_roads(pieces)
    assert road.agents == ("signal_0", "signal_1", "signal_2")
    assert road.edges == ("r0", "r1", "r2") and road.arrival_s == (0.0, 21.0, 42.0)
    around = replace(pieces, straight={"piece": "other", "other": "piece"})
    assert {len(each.agents) for each in main_roads(around)} == {3}  # westwards it is whole


def test_the_green_travels_with_the_vehicles():
    rule = GreenWave(row_of(3, apart_s=21), green_s=20, main_s=40)
    assert rule._offsets == {"signal_0": 0, "signal_1": 2, "signal_2": 4}
    seen = [rule.act({}, {}) for _ in range(12)]
    along = {agent: [each[agent] for each in seen] for agent in seen[0]}
    # the road has green (phase 1) for 40 s of 60 s, each light 20 s after the one before it
    assert along["signal_0"] == [1, 1, 1, 1, 0, 0] * 2
    assert along["signal_1"] == [0, 0, 1, 1, 1, 1] * 2
    assert along["signal_2"] == [1, 1, 0, 0, 1, 1] * 2
    rule.reset(0)
    assert rule.act({}, {}) == seen[0]
    assert GreenWave(row_of(2, 21), 20).main_s == 20
    endless = GreenWave(row_of(2, 21), green_s=1e15)
    assert endless.act({}, {}) == {"signal_0": 1, "signal_1": 0}


def test_the_roads_of_a_grid_share_no_light():
    grid = ControlledNetwork.of(parallel_env("grid2x2-v1"))
    roads = main_roads(grid)
    assert sorted(agent for road in roads for agent in road.agents) == sorted(grid.intersections)
    assert [len(road.agents) for road in roads] == [2, 2]
    (arterial,) = main_roads(ControlledNetwork.of(parallel_env("arterial1x5-v1")))
    assert len(arterial.agents) == 5
    assert np.diff(arterial.arrival_s) == pytest.approx([20.0] * 4, abs=1.5)
