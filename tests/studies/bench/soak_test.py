"""The soak of the field loop: its observer by hand-made lights, its controllers, and short ones."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

from studies.bench.soak import FieldSoakBench
from studies.bench.soak_cabinets import SILENCE_S, Cabinet, Cabinets
from studies.bench.soak_observer import Observer, Rules
from studies.bench.soak_program import FAULTS, drawn_events
from ugat_marl.errors import OptionError

RULES = Rules({"J": frozenset({(0, 1), (1, 0)})}, yellow_s=3, all_red_s=2, min_green_s=5)
SAFE = ["Gr"] * 5 + ["yr"] * 3 + ["rr"] * 2 + ["rG"] * 5 + ["ry"] * 3 + ["rr"] * 2 + ["Gr"]
NETWORK = Path(__file__).parents[3] / "scenarios" / "grid2x2-v1"


def seen(states: list[str]) -> Observer:
    observer = Observer(RULES)
    for state in states:
        observer.look({"J": state})
    return observer


def test_lights_that_keep_the_rules_are_safe() -> None:
    observer = seen(SAFE)
    assert (observer.seconds, observer.unsafe) == (21, 0)
    assert not observer.broken


@pytest.mark.parametrize(
    ("states", "rule", "seconds"),
    [
        (["GG"] * 4, "greens that cross", 4),
        (["Gr"] * 5 + ["rr"], "green without yellow", 1),
        ([*SAFE[:10], *["rG"] * 4, "ry"], "short green", 1),
        (["Gr"] * 5 + ["yr"] * 2 + ["rr"], "short yellow", 1),
        (["Gr"] * 5 + ["yr"] * 3 + ["Gr"], "green after yellow", 1),
        (["Gr"] * 5 + ["yr"] * 3 + ["rr"] + ["rG"], "short clearance", 1),
        (["Gr"] * 5 + ["yr"] * 3 + ["rG"], "short clearance", 1),
        (["Gr"] * 5 + ["yG"], "short clearance", 1),
    ],
)
def test_each_rule_is_seen_when_it_is_broken(states: list[str], rule: str, seconds: int) -> None:
    observer = seen(states)
    assert dict(observer.broken) == {rule: seconds}
    assert observer.unsafe == seconds
    assert observer.examples[0].startswith(f"{len(states) - seconds} s J: {rule}")


def test_a_green_that_yields_may_cross() -> None:
    assert seen(["Gg"] * 4).unsafe == 0


def test_the_rules_of_a_network_are_those_of_its_files() -> None:
    rules = Rules.read(NETWORK)
    assert sorted(rules.crossing) == ["A1", "A2", "B1", "B2"]
    assert (rules.yellow_s, rules.all_red_s, rules.min_green_s) == (3, 2, 5)
    # <request index="0" ... foes="0000000001100000">: from the right, links 5 and 6.
    assert {other for one, other in rules.crossing["A1"] if one == 0} == {5, 6}
    for crossing in rules.crossing.values():
        assert {(other, one) for one, other in crossing} == crossing


@pytest.mark.parametrize("seed", range(5))
def test_controllers_are_safe_by_themselves(seed: int) -> None:
    """Without a loop, or with one that holds what it sees, no fault makes a light unsafe."""
    drawn = random.Random(seed)
    cabinets = Cabinets({"J": ["Gr", "rG"]})
    observer = Observer(RULES)
    cabinet = cabinets.by_light["J"]
    held = False
    for second in range(3000):
        if second % 50 == 0:
            cabinet.fault = drawn.choice(["", "stuck", "slow", "own plan"])
            held = drawn.random() < 0.5
            if held:
                cabinets.connected()
        if held and not cabinets.command(cabinets.shown()):
            cabinets.connected()
        observer.look(cabinets.shown())
        cabinets.second()
    assert observer.unsafe == 0, observer.examples


def test_a_silent_loop_is_replaced_by_the_own_plan_and_its_old_line_is_refused() -> None:
    cabinets = Cabinets({"J": ["Gr", "rG"]})
    cabinet: Cabinet = cabinets.by_light["J"]
    assert not cabinets.command({"J": "rr"})
    cabinets.connected()
    assert cabinets.command({"J": "Gr"})
    for _ in range(SILENCE_S):
        cabinets.second()
    assert not cabinet.on_own_plan
    cabinets.second()
    assert cabinet.on_own_plan
    assert not cabinets.command({"J": "Gr"})
    cabinets.connected()
    assert cabinets.command({"J": "Gr"})
    assert not cabinet.on_own_plan


def test_every_ten_minutes_something_fails_and_every_kind_in_its_turn() -> None:
    events = drawn_events(36_000, ["A", "B"], seed=3)
    assert len(events) == 60
    assert [event.begin_s // 600 for event in events] == [*range(60)]
    assert all(event.end_s < (event.begin_s // 600 + 1) * 600 for event in events)
    for begin in range(0, 60, len(FAULTS)):
        assert {event.kind for event in events[begin : begin + len(FAULTS)]} == set(FAULTS)
    assert events == drawn_events(36_000, ["A", "B"], seed=3)
    assert events != drawn_events(36_000, ["A", "B"], seed=4)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits other processes' files")
def test_two_hours_with_faults_have_no_unsafe_second() -> None:
    report = FieldSoakBench(hours=2, scenario="single-v1").run()
    assert report.met, report.notes
    times = {row["fault"]: row["times"] for row in report.rows}
    assert set(FAULTS) <= set(times)
    assert "disobeys" in report.notes[1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits other processes' files")
def test_a_loop_that_does_not_look_at_lights_is_caught() -> None:
    report = FieldSoakBench(hours=1, scenario="single-v1", subject="blind").run()
    unsafe, left = report.targets
    assert unsafe.measured > 0
    assert left.met


def test_no_hours_are_refused() -> None:
    with pytest.raises(OptionError, match="hours"):
        FieldSoakBench(hours=0)
