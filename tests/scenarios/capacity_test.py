"""Degrees of saturation against closed forms on a crossing of four roads."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from ugat_marl.progress import Silent
from ugat_marl.scenarios import (
    Link,
    Network,
    NetworkRanges,
    Scenario,
    degrees_of_saturation,
    departures,
    draw_scenario,
    from_turning_shares,
    grid_roads,
    make_scenario,
)
from ugat_marl.scenarios.capacity import (
    CYCLE_S,
    LEFT_HEADWAY_S,
    PERMITTED_EQUIVALENT,
    RIGHT_HEADWAY_S,
    _conflicts,
    _equivalents,
    may_go,
    through_headway_s,
)

SIDES = ("west1", "southA", "east1", "northA")
"""Ends of the roads, anticlockwise: the road after a right turn is the next one."""
FLOWS = {"west1": (90, 500, 60), "east1": (150, 310, 40), "southA": (120, 280, 70),
         "northA": (60, 400, 20)}  # fmt: skip
"""Vehicles per hour to the left, straight on and to the right, from each end."""


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    made = make_scenario(
        tmp_path_factory.mktemp("crossing") / "one",
        grid_roads("1x1", 300, 13.9),
        from_turning_shares(300, (0.2, 0.6, 0.2), 0, 600, 1),
        settings={},
        command="",
        force=False,
        reporter=Silent(),
    )
    return made.scenario


def flows(factor: float = 1.0) -> dict[tuple[str, str], float]:
    found: dict[tuple[str, str], float] = {}
    for number, side in enumerate(SIDES):
        for steps, vph in zip((3, 2, 1), FLOWS[side], strict=True):
            out = SIDES[(number + steps) % 4]
            found[f"{side}_A1", f"A1_{out}"] = factor * vph
    return found


def through_lane(side: str) -> float:
    _, straight, right = FLOWS[side]
    return (straight * through_headway_s(13.9) + right * RIGHT_HEADWAY_S) / 3600


def left_lane(side: str, headway_s: float) -> float:
    return headway_s * FLOWS[side][0] / 3600


def test_protected_lefts_are_the_critical_sum_of_two_rings(crossing: Scenario) -> None:
    def pair(a: str, b: str) -> float:
        return max(
            left_lane(a, LEFT_HEADWAY_S) + through_lane(b),
            left_lane(b, LEFT_HEADWAY_S) + through_lane(a),
        )

    timing = crossing.timing
    lost = 4 * (timing.yellow_s + timing.all_red_s) / CYCLE_S
    wanted = (pair("west1", "east1") + pair("southA", "northA")) / (1 - lost)
    assert degrees_of_saturation(crossing, flows()) == {"A1": pytest.approx(wanted)}
    assert degrees_of_saturation(crossing, flows(2)) == {"A1": pytest.approx(2 * wanted)}
    late = crossing.with_control(late_green_s=2.0)
    wanted *= (1 - lost) / (1 - lost - 4 * 2.0 / CYCLE_S)
    assert degrees_of_saturation(late, flows()) == {"A1": pytest.approx(wanted)}


def test_permitted_lefts_add_to_the_traffic_opposite(crossing: Scenario) -> None:
    def pair(a: str, b: str) -> float:
        needs = [
            max(
                through_lane(side),
                left_lane(side, 2 * PERMITTED_EQUIVALENT),
                (PERMITTED_EQUIVALENT * FLOWS[side][0] + FLOWS[opposite][1]) / 1800,
            )
            for side, opposite in ((a, b), (b, a))
        ]
        return max(needs)

    permitted = crossing.with_control(phases="permitted")
    lost = 2 * permitted.timing.clearance_s / CYCLE_S
    wanted = (pair("west1", "east1") + pair("southA", "northA")) / (1 - lost)
    assert degrees_of_saturation(permitted, flows()) == {"A1": pytest.approx(wanted)}


def test_turns_that_give_way_on_two_lanes_share_the_point_of_conflict() -> None:
    left = [Link(number, f"a_{number}", f"x_{number}", "l") for number in range(2)]
    opposite = [Link(2, "b_0", "y_0", "s")]
    turns, straight = ("a", "x"), ("b", "y")
    (found,) = _conflicts(
        ("ggG", "rrG", "rrr"),
        {turns: left, straight: opposite},
        {turns: 0.1, straight: 0.3},
        {turns: [straight], straight: []},
    )
    assert found[0].tolist() == [True, True, False]
    assert found[1] == pytest.approx(PERMITTED_EQUIVALENT * 0.1 / 2 + 0.3)


def test_who_gives_way_takes_the_time_of_two_cars_at_least() -> None:
    speeds_mps = (13.9, 1.0)
    found = [_equivalents("l", speed_mps, yields=True) for speed_mps in speeds_mps]
    assert found == [PERMITTED_EQUIVALENT, through_headway_s(1.0) / 2.0]
    assert _equivalents("l", 13.9, yields=False) == LEFT_HEADWAY_S / 2.0


def test_one_phase_loses_no_time(crossing: Scenario) -> None:
    only = {("west1_A1", "A1_east1"): 900.0}
    assert degrees_of_saturation(crossing, only) == {
        "A1": pytest.approx(0.25 * through_headway_s(13.9))
    }
    assert degrees_of_saturation(crossing, {}) == {"A1": 0.0}


def test_traffic_without_green_is_beyond_any_capacity(crossing: Scenario) -> None:
    width = len(Network.read(crossing).intersections[0].phases[0])
    red = crossing.with_control(phases=("G" + "r" * (width - 1), "r" + "G" + "r" * (width - 2)))
    assert degrees_of_saturation(red, flows()) == {"A1": math.inf}


def test_a_lane_is_served_if_all_its_traffic_may_go() -> None:
    links = [Link(number, "a_0", f"b{number}_0", turn) for number, turn in enumerate("sr")]
    served = {phase: may_go(links, phase) for phase in ("GG", "Gg", "Gs", "Gr", "rs")}
    assert served == {"GG": True, "Gg": True, "Gs": True, "Gr": False, "rs": False}


def test_lanes_share_a_movement(tmp_path: Path) -> None:
    ranges = NetworkRanges(
        intersections=(1, 1), lanes=(3, 3), left_lanes=1, irregular=0, permitted=0
    )
    wide = draw_scenario(tmp_path / "wide", 1, ranges)
    only = {("west1_A1", "A1_east1"): 900.0}
    speed_mps = Network.read(wide).lanes["west1_A1_0"].speed_mps
    wanted = 0.125 * through_headway_s(speed_mps)
    assert degrees_of_saturation(wide, only) == {"A1": pytest.approx(wanted)}


@pytest.mark.parametrize("begin_s", [0.0, 200.0])
def test_routes_are_counted_within_the_episode(crossing: Scenario, begin_s: float) -> None:
    counted: Counter[tuple[str, str]] = Counter()
    for _, depart_s, edges in departures(crossing, routed=True):
        counted.update(pairwise(edges) if begin_s <= depart_s < begin_s + 300 else ())
    late = crossing.settings.model_copy(update={"begin_s": begin_s})
    short = replace(crossing, settings=late).with_duration(300)
    vph = {movement: 12.0 * count for movement, count in counted.items()}
    assert degrees_of_saturation(short) == degrees_of_saturation(short, vph)
    assert degrees_of_saturation(short) != degrees_of_saturation(crossing)
