"""Rules that weigh what a switch costs, how long was waited, and how impatient red lanes are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ugat_marl.policies import ControlledNetwork
from ugat_marl.policies.rules.actuated import Actuated
from ugat_marl.policies.rules.phase_scores import (
    LargestQueue,
    LongestWaiting,
    MaxPressure,
    MaxPressureLoss,
)
from ugat_marl.policies.rules.sotl import SelfOrganising
from ugat_marl.scenarios import Intersection, Link

INCOMING = ("n_0", "w_0", "e_0")
PHASES = ("Grr", "rGG", "rrG")
LINKS = tuple(Link(i, lane, "out_0", "s") for i, lane in enumerate(INCOMING))
CAPACITY = {"n_0": 40.0, "w_0": 20.0, "e_0": 10.0, "out_0": 40.0}
AGENT = "signal_0"


def streets(
    clearance_s: float = 5.0, decision_interval_s: float = 10.0, min_green_s: float = 0.0
) -> ControlledNetwork:
    item = Intersection("x", INCOMING, ("out_0",), LINKS, PHASES, (), (), (0.0, 0.0))
    return ControlledNetwork(
        {AGENT: item},
        CAPACITY,
        dict.fromkeys(CAPACITY, 20.0),
        decision_interval_s,
        clearance_s,
        min_green_s=min_green_s,
    )


def movements(*vehicles: int, out: int = 0, shown: int = 0) -> dict[str, Any]:
    capacity = np.array([CAPACITY[lane] for lane in INCOMING])
    counts = np.array(vehicles) / capacity
    parts = [counts, counts, [out / CAPACITY["out_0"]], np.eye(3)[shown]]
    return {AGENT: np.concatenate(parts).astype(np.float32)}


def waiting(*seconds: float) -> dict[str, Any]:
    capacity = np.array([CAPACITY[lane] for lane in INCOMING])
    parts = [np.array(seconds) / capacity / 100.0, np.eye(3)[0]]
    return {AGENT: np.concatenate(parts).astype(np.float32)}


def shown_by(rule: Any, *seen: dict[str, Any]) -> list[int]:
    return [rule.act(each, {})[AGENT] for each in seen]


@pytest.mark.parametrize(("hold_s", "needed"), [(10, 8), (20, 16 / 3), (40, 32 / 7)])
def test_a_switch_must_gain_more_than_its_clearance_loses(hold_s: float, needed: float):
    # 4 vehicles on n_0; w_0 must offer 4 / (1 - 5 / hold) to win
    hold = int(hold_s // 10)
    start = [movements(4, 0, 0)] * hold
    for west in (int(np.floor(needed)), int(np.floor(needed)) + 1):
        seen = (*start, movements(4, west, 0))
        switches = west > needed
        assert shown_by(MaxPressureLoss(streets(), hold_s), *seen)[-1] == int(switches)
        assert shown_by(MaxPressure(streets(), hold_s), *seen)[-1] == int(west > 4)


def test_without_a_clearance_or_a_loss_it_is_max_pressure():
    generator = np.random.default_rng(4)
    seen = [movements(*generator.integers(1, 9, 3)) for _ in range(50)]
    free = shown_by(MaxPressureLoss(streets(clearance_s=0), 20), *seen)
    assert free == shown_by(MaxPressure(streets(), 20), *seen)
    assert free != shown_by(MaxPressureLoss(streets(), 20), *seen)


def test_a_phase_that_can_serve_nothing_is_no_reason_to_switch():
    jammed = movements(1, 3, 0, out=20)  # pressures of -19, -37 and -20
    assert shown_by(MaxPressureLoss(streets(), 10), movements(4, 0, 0), jammed) == [0, 0]
    jammed = movements(0, 3, 0, out=2)  # -2, 1 - 2 = -1 and -2
    assert shown_by(MaxPressure(streets(), 10), movements(4, 0, 0), jammed) == [0, 1]
    assert shown_by(MaxPressureLoss(streets(), 10), movements(4, 0, 0), jammed) == [0, 0]


@pytest.mark.parametrize("hold_s", [5, 10])
def test_a_switch_gains_at_least_the_minimum_green(hold_s: float):
    """No phase is shorter than 10 s, of which 5 s are green: w_0 must offer 4 / (1 - 5 / 10)."""
    network = streets(decision_interval_s=5, min_green_s=5)
    start = [movements(4, 0, 0)] * (int(hold_s) // 5)
    for west in (8, 9):
        seen = (*start, movements(4, west, 0))
        assert shown_by(MaxPressureLoss(network, hold_s), *seen)[-1] == int(west > 8)


def test_longest_waiting_adds_the_waiting_of_the_lanes_a_phase_serves():
    rule = LongestWaiting(streets(), 10)
    seen = waiting(50, 30, 25)
    assert rule.scores(AGENT, seen[AGENT]) == pytest.approx([50, 55, 25], rel=1e-6)
    assert shown_by(rule, seen, waiting(80, 0, 25)) == [1, 0]


def test_red_lanes_collect_impatience_and_green_empties_it():
    rule = SelfOrganising(streets(), threshold=100, hold_s=10)
    # w_0 with 2 and e_0 with 1: 30 vehicle-seconds a decision for phase 1, 10 for phase 2
    steps = [movements(5, 2, 1)] * 3
    assert shown_by(rule, *steps) == [0, 0, 0]
    assert shown_by(rule, *steps[:1]) == [1]  # 120: phase 1 is next
    # from here n_0 collects 50 a decision, w_0 and e_0 nothing
    assert shown_by(rule, *steps) == [1, 0, 0]
    rule.reset(0)
    assert shown_by(rule, *steps) == [0, 0, 0]


def test_impatience_waits_for_the_shortest_green():
    rule = SelfOrganising(streets(), threshold=10, hold_s=30)
    busy = movements(9, 9, 9)
    assert shown_by(rule, *[busy] * 8) == [1, 1, 1, 0, 0, 0, 1, 1]


@pytest.mark.parametrize("hold_s", [10, 20])
@pytest.mark.parametrize(
    "kind", [LargestQueue, MaxPressure, LongestWaiting, SelfOrganising, Actuated]
)
def test_a_right_turn_that_is_always_green_does_not_serve_those_who_go_straight_on(
    kind: Any, hold_s: float
) -> None:
    links = (
        Link(0, "n_0", "out_0", "s"),
        Link(1, "n_0", "out_0", "r"),
        Link(2, "w_0", "out_0", "s"),
    )
    item = Intersection("x", ("n_0", "w_0"), ("out_0",), links, ("GGr", "rGG"), (), (), (0.0, 0.0))
    network = ControlledNetwork({AGENT: item}, CAPACITY, dict.fromkeys(CAPACITY, 20.0), 10.0, 5.0)
    options = {"threshold": 100} if kind is SelfOrganising else {}
    rule = kind(network, hold_s=hold_s, **options) if kind is not Actuated else kind(network)

    def seen(north: int, west: int, shown: int) -> dict[str, Any]:
        counts = np.array([north / 40, west / 20])
        features = [counts] if kind is LongestWaiting else [counts, counts, [0.0]]
        return {AGENT: np.concatenate([*features, np.eye(2)[shown]]).astype(np.float32)}

    chosen = shown_by(rule, *[seen(0, 5, 1)] * 2, *[seen(8, 0, 1)] * 6)
    assert chosen[:2] == [1, 1]
    assert 0 in chosen
