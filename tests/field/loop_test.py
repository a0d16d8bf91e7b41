"""The field loop at a made-up street: every fault, the way back, and what lights then show."""

from __future__ import annotations

import gc
import json
import math
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.interrupts import eventually
from ugat_marl.effects import load_scenario
from ugat_marl.envs import AgentSet, parallel_env
from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.field import DecisionLog, FieldLoop, LaneCount, Site, TrustLimits
from ugat_marl.field.safety import fixed_time
from ugat_marl.field.watchdog import Watchdog
from ugat_marl.policies import (
    DQN,
    UNIVERSAL_NAME,
    NumpyPolicy,
    export_policy,
    observed_options,
    suite_config,
)
from ugat_marl.scenarios import GREEN

GRID = load_scenario("grid2x2-v1")
SITE = Site.of(GRID, {})
LIGHT = SITE.lights[0]
AGENT = SITE.observer.agents[0]
LANE = SITE.sees[LIGHT][0]
QUICK = TrustLimits(answer_ms=2000, return_after=2)  # decisions in time on a busy machine
Counts = dict[str, LaneCount]


class MadeUpStreet:
    """Counts that go up and down, a clock that jumps, and a memory of what was shown."""

    def __init__(self, site: Site = SITE) -> None:
        self.time_s = 0.0
        self.lanes = site.capacity
        self.states = {item.id: item.phases[0] for item in site.network.intersections}
        self.by_second: list[dict[str, str]] = [dict(self.states)]
        self.spoil: Callable[[Counts], Any] = lambda counts: counts

    def now_s(self) -> float:
        return self.time_s

    def shown(self) -> Mapping[str, str]:
        return self.states

    def read(self) -> Counts:
        tick = int(self.time_s // 10)
        return self.spoil(
            {
                lane: LaneCount(self.time_s, float((tick + place) % 5 + 1), 1.0)
                for place, lane in enumerate(self.lanes)
            }
        )

    def show(self, states: Mapping[str, str]) -> None:
        self.states |= states

    def wait(self, until_s: float) -> None:
        self.by_second += [dict(self.states) for _ in range(round(until_s - self.time_s))]
        self.time_s = until_s


class Scripted:
    """Asks for the last phase of every light, unless told to do something else."""

    env_options: Mapping[str, Any] = {}

    def __init__(self, does: Callable[[dict[str, int]], Any] = lambda actions: actions) -> None:
        self.does = does
        self.seen: list[Mapping[str, Any]] = []
        self.infos: list[Mapping[str, Any]] = []

    def reset(self, seed: int) -> None:
        self.seen, self.infos = [], []

    def act(self, observations: Any, infos: Any) -> Any:
        self.seen.append(observations)
        self.infos.append(infos)
        return self.does({agent: len(infos[agent]["action_mask"]) - 1 for agent in infos})


def wait_for_the_answer(loop: FieldLoop) -> None:
    """Wait until the policy's thread has given the answer to a question that was too late."""
    assert eventually(loop._asked._answers.qsize)


def replaced(count: LaneCount | None) -> Callable[[Counts], Counts]:
    """Another count of `LANE`, or none."""

    def spoil(counts: Counts) -> Counts:
        rest = {lane: value for lane, value in counts.items() if lane != LANE}
        return rest if count is None else {**rest, LANE: count}

    return spoil


def decide(loop: FieldLoop, street: MadeUpStreet, times: int = 1) -> list[Any]:
    """The next decisions, carried out."""
    made: list[Any] = []
    loop.drive(times * 10.0, made.append)
    assert len(made) == times
    return made


NOW = 0.0  # the clock of the first decision
DATA_FAULTS: list[tuple[str, LaneCount | None]] = [
    ("missing", None),
    ("stale", LaneCount(NOW - 5.1, 1.0, 0.0)),
    ("stale", LaneCount(NOW + 5.1, 1.0, 0.0)),
    ("stale", LaneCount(math.nan, 1.0, 0.0)),
    ("absurd", LaneCount(NOW, math.nan, 0.0)),
    ("absurd", LaneCount(NOW, math.inf, 0.0)),
    ("absurd", LaneCount(NOW, -1.0, 0.0)),
    ("absurd", LaneCount(NOW, None, 0.0)),  # type: ignore[arg-type]
    ("absurd", LaneCount("now", 1.0, 0.0)),  # type: ignore[arg-type]
    ("absurd", LaneCount(NOW, "2", 0.0)),  # type: ignore[arg-type]
    ("absurd", LaneCount(NOW, 10**400, 0.0)),
    ("absurd", 3),  # type: ignore[list-item]
    ("absurd", LaneCount(NOW, 2.01 * SITE.capacity[LANE], 0.0)),
]


@pytest.mark.parametrize(("kind", "count"), DATA_FAULTS)
def test_a_count_that_cannot_be_believed_sends_its_light_to_the_plan(
    kind: str, count: LaneCount | None
) -> None:
    street, policy = MadeUpStreet(), Scripted()
    loop = FieldLoop(SITE, policy, street, QUICK)
    street.spoil = replaced(count)
    (decision,) = decide(loop, street)
    seeing = {light for light, lanes in SITE.sees.items() if LANE in lanes}
    assert set(decision.fallback) == seeing == {LIGHT}
    assert decision.fallback[LIGHT].startswith(f"{kind}: ")
    assert LANE in decision.fallback[LIGHT]
    assert decision.source == "both"
    for item in SITE.network.intersections[1:]:
        assert decision.phases[item.id] == len(item.phases) - 1
    assert all(np.isfinite(seen).all() for seen in policy.seen[-1].values())


@pytest.mark.parametrize("count", [None, 3, LaneCount(NOW, "many", 0.0)])  # type: ignore[arg-type]
def test_counts_of_lanes_that_nobody_asks_for_are_not_read(count: Any) -> None:
    street = MadeUpStreet()
    other = next(lane for lane in SITE.network.lanes if lane not in SITE.capacity)
    loop = FieldLoop(SITE, Scripted(), street, QUICK)
    street.spoil = lambda counts: {**counts, other: count}
    (decision,) = decide(loop, street)
    assert decision.source == "policy"


@pytest.mark.parametrize(
    "count",
    [
        LaneCount(NOW - 4.9, 1.0),
        LaneCount(NOW, 1.9 * SITE.capacity[LANE]),
        LaneCount(NOW, 0.0, math.nan),
        LaneCount(NOW, 2.0, 3.0),  # nobody asks for the standing ones
        LaneCount(Decimal(0), Decimal(2), None),  # type: ignore[arg-type]
        LaneCount(np.float32(NOW), np.int64(3), "?"),  # type: ignore[arg-type]
    ],
)
def test_a_count_that_can_be_believed_is_used(count: LaneCount) -> None:
    street, policy = MadeUpStreet(), Scripted()
    loop = FieldLoop(SITE, policy, street, QUICK)
    street.spoil = replaced(count)
    (decision,) = decide(loop, street)
    assert decision.source == "policy"
    assert policy.seen[-1][SITE.observer.agents[0]][0] == pytest.approx(
        min(float(count.vehicles) / 40, 1)
    )


def test_standing_vehicles_are_checked_where_the_policy_sees_them() -> None:
    site = Site.of(GRID, {"observation": "queue"})
    for halting in (math.nan, -1.0, 2.5):
        watchdog = Watchdog({LANE: 10.0}, site.halting, TrustLimits())
        (reason,) = watchdog.check({LANE: LaneCount(0.0, 2.0, halting)}, 0.0)[1].values()
        assert reason.startswith("absurd: ")
    assert not watchdog.check({LANE: LaneCount(0.0, 2.0, 2.0)}, 0.0)[1]


def failing(_counts: Counts) -> Counts:
    raise OSError("the cabinet does not answer")


def leaving(_counts: Counts) -> Counts:
    raise SystemExit("the driver has had enough")


@pytest.mark.parametrize("spoil", [failing, leaving, lambda _: None, lambda _: {}, lambda _: 3])
def test_no_counts_send_every_light_to_the_plan(spoil: Callable[[Counts], Any]) -> None:
    street = MadeUpStreet()
    loop = FieldLoop(SITE, Scripted(), street, QUICK)
    street.spoil = spoil
    (decision,) = decide(loop, street)
    assert decision.source == "fallback"
    assert all(reason.startswith("missing: ") for reason in decision.fallback.values())


def test_lights_on_the_plan_ask_for_its_phases_and_the_others_for_the_policys() -> None:
    street = MadeUpStreet()
    loop = FieldLoop(SITE, Scripted(), street, QUICK)
    street.spoil = replaced(None)
    decisions = decide(loop, street, 12)
    plan = fixed_time(SITE.network, 10.0, SITE.timing, QUICK.green_s)
    planned = [plan.act({}, {})[LIGHT] for _ in decisions]
    last = {item.id: len(item.phases) - 1 for item in SITE.network.intersections}
    assert len(set(planned)) == 4
    assert [decision.phases[LIGHT] for decision in decisions] == planned
    for light in SITE.lights[1:]:
        assert {decision.phases[light] for decision in decisions} == {last[light]}
    shown = {states[LIGHT] for states in street.by_second}
    assert {SITE.network.intersections[0].phases[phase] for phase in planned} <= shown


def test_a_light_that_shows_a_foreign_state_is_the_plans_until_it_is_cleared() -> None:
    street, policy = MadeUpStreet(), Scripted()
    width = len(street.states[LIGHT])
    street.states[LIGHT] = "r" * width
    loop = FieldLoop(SITE, policy, street, QUICK)
    decisions = decide(loop, street, 4)
    kinds = [decision.fallback.get(LIGHT, "").partition(":")[0] for decision in decisions]
    assert kinds == ["beginning", "returning", "returning", ""]
    assert all(set(decision.fallback) <= {LIGHT} for decision in decisions)


def test_neighbours_that_see_a_broken_detector_follow_the_plan_too() -> None:
    site = Site.of(GRID, {"neighbours": 1})
    street = MadeUpStreet(site)
    loop = FieldLoop(site, Scripted(), street, QUICK)
    street.spoil = replaced(None)
    (decision,) = decide(loop, street)
    assert set(decision.fallback) == {LIGHT, *site.network.intersection(LIGHT).neighbours}
    assert decision.source == "both"


def held(
    watchdog: Watchdog,
    counts: Callable[[int], dict[str, float]],
    red: Callable[[int], str] = lambda now: "",
) -> dict[int, dict[str, str]]:
    """Time to faults, looked at every 10 s of an hour; `red` names the lanes without green."""
    found: dict[int, dict[str, str]] = {}
    for now in range(0, 3600, 10):
        read = {lane: LaneCount(now, value) for lane, value in counts(now).items()}
        if faults := watchdog.check(read, float(now), dict.fromkeys(red(now), 0.0))[1]:
            found[now] = faults
    return found


TWO = {"a": 20.0, "b": 20.0}


def test_a_count_frozen_while_others_move_is_found_after_its_time_and_not_before() -> None:
    watchdog = Watchdog(TWO, False, TrustLimits(frozen_after_s=300))
    found = held(watchdog, lambda now: {"a": 3.0 if now >= 100 else now % 30, "b": now % 40 / 4})
    assert min(found) == 410
    assert max(found) == 3590
    assert all(set(faults) == {"a"} for faults in found.values())
    assert found[410]["a"] == "frozen: 3 vehicles for 310 s of green on a"


def test_only_green_counts_against_a_queue_that_stands() -> None:
    def counts(now: int) -> dict[str, float]:
        return {"a": 3.0, "b": now % 40 / 4}

    starved = Watchdog(TWO, False, TrustLimits(frozen_after_s=300))
    assert not held(starved, counts, lambda now: "a")
    half = Watchdog(TWO, False, TrustLimits(frozen_after_s=300))
    found = held(half, counts, lambda now: "a" if now % 20 else "")
    assert min(found) == 620


def test_seconds_of_green_count_and_not_the_decisions_that_have_some() -> None:
    watchdog = Watchdog(TWO, False, TrustLimits(frozen_after_s=300))
    for now in range(0, 3600, 10):
        read = {"a": LaneCount(now, 3.0), "b": LaneCount(now, now % 40 / 4)}
        if faults := watchdog.check(read, float(now), {"a": 4.0, "b": 0.0})[1]:
            assert (now, faults) == (760, {"a": "frozen: 3 vehicles for 304 s of green on a"})
            return
    raise AssertionError("never found")


def test_a_full_lane_may_stand_for_long() -> None:
    assert not held(Watchdog(TWO, False, TrustLimits()), lambda now: {"a": 16.0, "b": now % 40 / 4})
    assert held(Watchdog(TWO, False, TrustLimits()), lambda now: {"a": 15.0, "b": now % 40 / 4})


def test_a_feed_frozen_as_a_whole_is_found_even_at_red_and_an_empty_night_is_not() -> None:
    watchdog = Watchdog(TWO, False, TrustLimits(frozen_after_s=300))
    found = held(watchdog, lambda now: {"a": 3.0, "b": 0.0}, lambda now: "ab")
    assert min(found) == 310
    assert found[310]["a"] == "frozen: no count has changed for 310 s, as on lane a"
    assert set(found[310]) == {"a", "b"}
    assert not held(Watchdog(TWO, False, TrustLimits()), lambda now: {"a": 0.0, "b": 0.0})


def test_a_lane_that_comes_back_with_the_count_it_had_is_not_frozen() -> None:
    watchdog = Watchdog(TWO, False, TrustLimits(frozen_after_s=300))
    found = held(
        watchdog,
        lambda now: {"b": now % 40 / 4} | ({} if 200 <= now < 1000 else {"a": 3.0}),
    )
    missing = [now for now, faults in found.items() if "missing" in faults["a"]]
    assert missing == [*range(200, 1000, 10)]
    assert min(now for now in found if now >= 1000) == 1310


def test_the_loop_tells_which_lanes_had_green() -> None:
    """A lane that is never served stands still for ever; one that is served may not."""
    (item, *_) = SITE.network.intersections
    first = {link.from_lane for link in item.links if item.phases[0][link.index] in GREEN}
    served, starved = min(first), min(set(item.incoming_lanes) - first)
    for lane, faulty in ((served, True), (starved, False)):
        street = MadeUpStreet()
        policy = Scripted(lambda actions: dict.fromkeys(actions, 0))
        loop = FieldLoop(SITE, policy, street, TrustLimits(answer_ms=2000, frozen_after_s=100))
        street.spoil = lambda counts, lane=lane, street=street: {
            **counts,
            lane: LaneCount(street.time_s, 4.0),
        }
        reasons = [decision.fallback.get(LIGHT, "") for decision in decide(loop, street, 14)]
        assert [bool(reason) for reason in reasons] == [False] * 11 + [faulty] * 3
        assert not faulty or reasons[11] == f"frozen: 4 vehicles for 110 s of green on {lane}"


def test_a_lane_that_counts_as_before_after_no_counts_at_all_is_not_frozen() -> None:
    (item, *_) = SITE.network.intersections
    lane = min(link.from_lane for link in item.links if item.phases[0][link.index] in GREEN)
    street = MadeUpStreet()
    policy = Scripted(lambda actions: dict.fromkeys(actions, 0))
    limits = TrustLimits(answer_ms=2000, return_after=0, frozen_after_s=100)
    loop = FieldLoop(SITE, policy, street, limits)

    def constant(counts: Counts) -> Counts:
        return {**counts, lane: LaneCount(street.time_s, 4.0)}

    for spoil, times in ((constant, 1), (failing, 13), (constant, 1)):
        street.spoil = spoil
        (*_, last) = decide(loop, street, times)
    assert not last.fallback


def test_a_lane_that_fell_silent_is_found_but_not_one_that_never_counted() -> None:
    watchdog = Watchdog(dict.fromkeys("abc", 20.0), False, TrustLimits(silent_after_s=1800))
    found = held(
        watchdog, lambda now: {"a": 1.0 if now < 100 else 0.0, "b": 0.0, "c": float(now % 40)}
    )
    assert min(found) == 1910
    assert all(set(faults) == {"a"} for faults in found.values())


def test_a_night_in_which_nobody_comes_any_more_is_no_fault() -> None:
    watchdog = Watchdog(TWO, False, TrustLimits(silent_after_s=600))
    assert not held(watchdog, lambda now: {"a": now % 40 / 4 if now < 900 else 0.0, "b": 0.0})


def raising(error: BaseException) -> Callable[[Any], Any]:
    def does(_actions: Any) -> Any:
        raise error

    return does


POLICY_FAULTS: dict[str, Callable[[dict[str, int]], Any]] = {
    "raises": raising(ValueError("no such lane")),
    "leaves": raising(SystemExit(1)),
    "nothing": lambda actions: None,
    "one missing": lambda actions: dict(list(actions.items())[1:]),
    "one too many": lambda actions: {**actions, "nobody": 0},
    "too high": lambda actions: dict.fromkeys(actions, 99),
    "negative": lambda actions: dict.fromkeys(actions, -1),
    "not whole": lambda actions: dict.fromkeys(actions, 0.5),
    "nan": lambda actions: dict.fromkeys(actions, math.nan),
    "words": lambda actions: dict.fromkeys(actions, "north"),
    "a list": lambda actions: [0] * len(actions),
}


@pytest.mark.parametrize("name", POLICY_FAULTS)
def test_a_policy_that_fails_or_talks_nonsense_is_not_obeyed_and_may_come_back(name: str) -> None:
    street, policy = MadeUpStreet(), Scripted()
    loop = FieldLoop(SITE, policy, street, QUICK)
    policy.does = POLICY_FAULTS[name]
    (decision,) = decide(loop, street)
    assert decision.source == "fallback"
    assert all(reason.startswith("policy: ") for reason in decision.fallback.values())
    policy.does = lambda actions: actions
    sources = [decision.source for decision in decide(loop, street, 4)]
    assert sources == ["fallback", "fallback", "policy", "policy"]


def test_a_policy_that_fails_from_the_beginning_does_not_stop_the_loop() -> None:
    street = MadeUpStreet()
    loop = FieldLoop(SITE, Scripted(raising(RuntimeError("no weights"))), street, QUICK)
    assert [d.source for d in decide(loop, street, 3)] == ["fallback"] * 3
    assert loop.summary.fallback_share == 1.0


def test_a_slow_policy_misses_its_deadline_and_is_not_asked_while_it_is_busy() -> None:
    street, policy = MadeUpStreet(), Scripted()
    loop = FieldLoop(SITE, policy, street, QUICK)
    asked: list[dict[str, int]] = []
    released = threading.Event()

    def slow(actions: dict[str, int]) -> dict[str, int]:
        asked.append(actions)
        released.wait(60)
        return actions

    policy.does = slow
    late, busy = decide(loop, street, 2)  # comes back while the policy is still at it
    assert "late: no answer within" in late.fallback[LIGHT]
    assert busy.fallback[LIGHT] == "late: still busy with an earlier decision"
    assert len(asked) == 1
    policy.does = lambda actions: actions
    released.set()
    wait_for_the_answer(loop)
    sources = [decision.source for decision in decide(loop, street, 3)]
    assert sources == ["fallback", "fallback", "policy"], "a late answer was taken for a new one"


def test_a_policy_that_was_busy_is_reset_before_it_decides_for_a_street_that_came_back() -> None:
    street, policy = MadeUpStreet(), Scripted()
    loop = FieldLoop(SITE, policy, street, QUICK)
    released = threading.Event()

    def slow(actions: dict[str, int]) -> dict[str, int]:
        released.wait(60)
        return actions

    policy.does = slow
    decide(loop, street)
    returned = MadeUpStreet()
    loop.take_over(returned)  # the policy is still at the decision before
    policy.does = lambda actions: actions
    released.set()
    wait_for_the_answer(loop)
    (decision,) = decide(loop, returned)
    assert decision.source == "policy"
    assert len(policy.seen) == 1, "it remembers the street before"


def test_slow_detectors_leave_the_policy_no_time() -> None:
    street = MadeUpStreet()
    loop = FieldLoop(SITE, Scripted(), street, TrustLimits(answer_ms=50, reserve_ms=10))

    def slow(counts: Counts) -> Counts:
        time.sleep(0.045)
        return counts

    street.spoil = slow
    (decision,) = decide(loop, street)
    assert decision.fallback[LIGHT] == "late: 40 ms were over before the policy could be asked"
    assert decision.read_ms >= 45


# --- what the street sees -------------------------------------------------------------------------

FAULTS = st.sampled_from(["none", "none", "missing", "all", "policy"])


@settings(max_examples=20)
@given(st.lists(st.tuples(FAULTS, st.integers(0, 50)), min_size=5, max_size=20), st.integers(0, 5))
def test_lights_keep_green_and_clearance_through_every_hand_over(
    script: list[tuple[str, int]], shift: int
) -> None:
    street, policy = MadeUpStreet(), Scripted()
    loop = FieldLoop(SITE, policy, street, TrustLimits(return_after=shift % 3, green_s=10.0))
    for fault, choice in script:
        street.spoil = {"missing": replaced(None), "all": failing}.get(fault, lambda c: c)
        policy.does = (
            POLICY_FAULTS["too high"]
            if fault == "policy"
            else lambda actions, choice=choice: {
                agent: (choice + place) % (last + 1)
                for place, (agent, last) in enumerate(actions.items())
            }
        )
        decide(loop, street)
    loop.close()
    assert len(street.by_second) == 1 + 10 * len(script)
    assert not broken_rules(street.by_second)


def broken_rules(by_second: list[dict[str, str]]) -> list[str]:
    """What lights of `SITE` must not do, in the words of somebody who stands beside them."""
    found: list[str] = []
    timing = SITE.timing
    for item in SITE.network.intersections:
        shown = [states[item.id] for states in by_second]
        for second, (before, after) in enumerate(pairwise(shown)):
            if any(
                a in GREEN and b not in GREEN and b != "y"
                for a, b in zip(before, after, strict=True)
            ):
                found.append(f"{item.id}: green ends without yellow at {second}")
            just = shown[max(second + 1 - int(timing.all_red_s), 0) : second + 1]
            if "y" in "".join(just) and any(
                b in GREEN and a not in GREEN for a, b in zip(before, after, strict=True)
            ):
                found.append(f"{item.id}: green at {second} without all red before")
        for link in {link.index for link in item.links}:
            letters = "".join("G" if state[link] in GREEN else state[link] for state in shown)
            for kind, run in _runs(letters)[1:-1]:
                short = {"G": timing.min_green_s, "y": timing.yellow_s}.get(kind, 0)
                if len(run) < short:
                    found.append(f"{item.id}: {kind} for {len(run)} s")
        allowed = {frozenset(_greens(phase)) for phase in item.phases}
        found += [
            f"{item.id}: greens of no phase in {state}"
            for state in set(shown)
            if not any(_greens(state) <= greens for greens in allowed)
        ]
    return found


def _greens(state: str) -> frozenset[int]:
    return frozenset(index for index, letter in enumerate(state) if letter in GREEN)


def _runs(letters: str) -> list[tuple[str, str]]:
    runs: list[tuple[str, str]] = []
    for letter in letters:
        if runs and runs[-1][0] == letter:
            runs[-1] = letter, runs[-1][1] + letter
        else:
            runs.append((letter, letter))
    return runs


def test_who_stands_beside_sees_what_is_wrong() -> None:
    item = SITE.network.intersections[0]
    rest = {other.id: other.phases[0] for other in SITE.network.intersections[1:]}
    cut = [{item.id: phase, **rest} for phase in item.phases[:2] for _ in range(6)]
    assert any("without yellow" in rule for rule in broken_rules(cut))
    everything = [{item.id: "G" * len(item.phases[0]), **rest}]
    assert any("of no phase" in rule for rule in broken_rules(everything))


def test_a_street_that_is_late_shortens_nothing() -> None:
    class Late(MadeUpStreet):
        def wait(self, until_s: float) -> None:
            super().wait(until_s + 1.0)

    street = Late()
    loop = FieldLoop(SITE, Scripted(), street, QUICK)
    loop.drive(100.0)
    shown = [states[LIGHT] for states in street.by_second]
    yellows = [
        len(run)
        for kind, run in _runs("".join("y" if "y" in s else "-" for s in shown))
        if kind == "y"
    ]
    assert yellows
    assert min(yellows) >= SITE.timing.yellow_s


def test_a_loop_that_is_gone_leaves_no_thread() -> None:
    def threads() -> set[threading.Thread]:
        return {thread for thread in threading.enumerate() if thread.name == "policy"}

    before = threads()  # those of other tests may end meanwhile
    loop = FieldLoop(SITE, Scripted(), MadeUpStreet(), QUICK)
    loop.drive(20.0)
    (own,) = threads() - before
    del loop
    gc.collect()
    own.join(10.0)
    assert not own.is_alive()


# --- records --------------------------------------------------------------------------------------


def test_every_decision_is_a_line_and_a_second_run_adds_its_own(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    street = MadeUpStreet()
    street.spoil = replaced(None)
    for seconds in (30.0, 20.0):
        log = DecisionLog(path)
        FieldLoop(SITE, Scripted(), street, QUICK, log).drive(seconds)
        log.close()
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert [row["time_s"] for row in rows] == [0, 10, 20, 30, 40]
    assert {row["source"] for row in rows} == {"both"}
    assert rows[0]["reasons"] == {LIGHT: f"missing: no count of lane {LANE}"}
    assert set(rows[0]["phases"]) == set(SITE.lights)
    assert all(0 < row["read_ms"] <= row["latency_ms"] for row in rows)
    assert [entry.name for entry in tmp_path.iterdir()] == ["field.jsonl"]


def test_a_log_that_ends_in_the_middle_of_a_line_is_not_added_to(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    path.write_text('{"time_s": 0')
    with pytest.raises(OptionError, match="whole line"):
        DecisionLog(path)


def test_a_log_that_cannot_be_written_for_a_while_does_not_stop_the_lights(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    log = DecisionLog(folder / "field.jsonl")
    loop = FieldLoop(SITE, Scripted(), MadeUpStreet(), QUICK, log)

    def disturb(decision: Any) -> None:
        if decision.time_s == 10:
            (segment,) = folder.glob("*.part")
            assert len(segment.read_text().splitlines()) == 2
            shutil.rmtree(folder)  # with the lines so far
            folder.touch()  # no folder any more
        if decision.time_s == 40:
            folder.unlink()

    loop.drive(60.0, disturb)
    log.close()
    rows = [json.loads(line) for line in log.path.read_text().splitlines()]
    assert [row["time_s"] for row in rows] == [20, 30, 40, 50]
    assert [entry.name for entry in folder.iterdir()] == ["field.jsonl"]


def test_a_street_that_is_gone_ends_the_loop_with_its_decisions_kept(tmp_path: Path) -> None:
    class Gone(MadeUpStreet):
        def show(self, states: Mapping[str, str]) -> None:
            if self.time_s >= 20:
                raise SimulatorError("the street is gone")
            super().show(states)

    log = DecisionLog(tmp_path / "field.jsonl")
    loop = FieldLoop(SITE, Scripted(), Gone(), QUICK, log)
    with pytest.raises(SimulatorError):
        loop.drive(100.0)
    log.close()
    assert len((tmp_path / "field.jsonl").read_text().splitlines()) == 2


def test_the_summary_adds_up() -> None:
    street = MadeUpStreet()
    loop = FieldLoop(SITE, Scripted(), street, QUICK)
    street.spoil = replaced(None)
    decide(loop, street)
    street.spoil = lambda counts: counts
    summary = loop.drive(40.0)
    assert (summary.decisions, summary.light_decisions) == (5, 20)
    assert dict(summary.reasons) == {"missing": 1, "returning": 2}
    assert summary.fallback_share == 3 / 20
    assert summary.latency_ms(0.0) <= summary.latency_ms(0.5) <= summary.latency_ms(1.0)


def test_the_time_in_which_the_street_sets_the_lights_is_logged() -> None:
    class Slow(MadeUpStreet):
        def show(self, states: Any) -> None:
            time.sleep(0.08)
            super().show(states)

    told: list[Any] = []
    loop = FieldLoop(SITE, Scripted(), Slow(), QUICK)
    summary = loop.drive(20.0, told.append)
    assert summary.latency_ms(0.0) >= 80.0
    assert min(decision.latency_ms for decision in told) == summary.latency_ms(0.0)


@pytest.mark.parametrize(
    ("options", "says"),
    [({"observation": "waiting"}, "waiting times"), ({"signals": "programme"}, "programme")],
)
def test_policies_the_field_cannot_serve_are_refused(options: dict[str, Any], says: str) -> None:
    with pytest.raises(OptionError, match=says):
        Site.of(GRID, options)


@pytest.mark.parametrize(
    "wrong",
    [{"answer_ms": math.inf}, {"stale_after_s": -1}, {"green_s": math.nan}, {"reserve_ms": 50}],
)
def test_impossible_limits_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        TrustLimits(**wrong)


def test_a_street_without_one_of_the_lights_is_refused() -> None:
    street = MadeUpStreet()
    del street.states[LIGHT]
    with pytest.raises(OptionError, match=LIGHT):
        FieldLoop(SITE, Scripted(), street)


# --- time -----------------------------------------------------------------------------------------


def test_a_network_answers_in_time_for_sixteen_lights() -> None:
    scenario = load_scenario("grid4x4-v1")
    policy = DQN(AgentSet.of(parallel_env(scenario))).policy()
    site = Site.of(scenario, policy.env_options)
    street = MadeUpStreet(site)
    loop = FieldLoop(site, policy, street, QUICK)
    summary = loop.drive(1000.0)
    assert len(summary.latencies_ms) == 100
    assert summary.fallback_share == 0


def test_the_street_of_the_page_is_driven() -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "field.md").read_text(encoding="utf-8")
    (example,) = [
        block.partition("```")[0]
        for block in page.split("```python\n")[1:]
        if "class CabinetStreet" in block
    ]
    names: dict[str, Any] = {}
    exec(compile(example, "docs/how-to/field.md", "exec"), names)
    body = example.partition("class CabinetStreet")[2].rstrip().splitlines()
    assert len(body) <= 30

    class Cabinet:
        def __init__(self) -> None:
            self.street = MadeUpStreet()
            self.polled = 0

        def poll(self) -> dict[str, tuple[float, float]]:
            self.polled += 1
            return {k: (c.time_s, c.vehicles) for k, c in self.street.read().items()}

        def states(self) -> Mapping[str, str]:
            return self.street.states

        def command(self, light: str, state: str) -> None:
            self.street.show({light: state})

    cabinet = Cabinet()
    made_up = cabinet.street
    street = names["CabinetStreet"](
        cabinet, clock=made_up.now_s, sleep=lambda s: made_up.wait(made_up.time_s + s)
    )
    summary = FieldLoop(SITE, Scripted(), street, QUICK).drive(60.0)
    assert (summary.decisions, summary.fallback_share, cabinet.polled) == (6, 0, 6)
    assert made_up.states[LIGHT] == SITE.network.intersections[0].phases[-1]
    assert not broken_rules(made_up.by_second)


@pytest.mark.parametrize("on_plan", [False, True])
def test_a_policy_that_needs_its_last_commands_sees_those_the_loop_gave(on_plan: bool) -> None:
    """Also those of the plan, while its light was on the plan: they are what is under way."""
    site = Site.of(GRID, {"commands": 2})
    street, policy = MadeUpStreet(site), Scripted()
    if on_plan:
        street.spoil = replaced(None)
    loop = FieldLoop(site, policy, street, QUICK)
    made = decide(loop, street, 3)
    loop.close()
    assert all(bool(decision.fallback) == on_plan for decision in made)
    for place, light in enumerate(site.lights):
        agent = site.observer.agents[place]
        phases = len(site.network.intersections[place].phases)
        shown = [seen[agent][-2 * phases - 1 : -1].reshape(2, phases) for seen in policy.seen[-3:]]
        assert not shown[0].any()
        assert shown[1].argmax(1)[0] == made[0].phases[light]
        assert not shown[1][1].any()
        assert shown[2].argmax(1).tolist() == [made[1].phases[light], made[0].phases[light]]


def asked_under(site: Site, min_green_s: float, times: int) -> Scripted:
    """A policy that asked for phase 1 at some decisions, under a minimum green."""
    site = replace(site, timing=replace(site.timing, min_green_s=min_green_s))
    street, policy = MadeUpStreet(site), Scripted(lambda asked: dict.fromkeys(asked, 1))
    loop = FieldLoop(site, policy, street, QUICK)
    decide(loop, street, times)
    loop.close()
    return policy


def test_a_policy_that_needs_its_last_commands_sees_the_age_of_the_green_that_runs() -> None:
    """Not of the one that was asked for, which the minimum green holds back."""
    policy = asked_under(Site.of(GRID, {"commands": 1}), min_green_s=12.0, times=3)
    ages_s = [60.0 * float(seen[AGENT][-1]) for seen in policy.seen]
    assert ages_s == pytest.approx([0.0, 10.0, 10.0])


def test_a_policy_is_told_which_phases_it_may_ask_for() -> None:
    """All of them if the minimum green of 25 s ends within the 10 s until the next decision."""
    policy = asked_under(SITE, min_green_s=25.0, times=4)
    free = [bool(infos[AGENT]["action_mask"].all()) for infos in policy.infos]
    assert free == [False, False, True, False]


@pytest.mark.parametrize("form", ["torch", "numpy"])
def test_the_universal_learner_acts_in_the_field_by_what_the_loop_shows_it(
    form: str, tmp_path: Path
) -> None:
    env = parallel_env(GRID, **observed_options(UNIVERSAL_NAME))
    trained = DQN.of(env, suite_config(UNIVERSAL_NAME)).policy()
    acting: Any = trained
    if form == "numpy":
        export_policy(trained, tmp_path / "policy.npz", env)
        acting = NumpyPolicy.load(tmp_path / "policy.npz")
    site = Site.of(GRID, acting.env_options)
    seen: list[tuple[Any, Any]] = []

    class Watched:
        env_options = acting.env_options
        reset = acting.reset

        def act(self, observations: Any, infos: Any) -> Any:
            seen.append((observations, infos))
            return acting.act(observations, infos)

    street = MadeUpStreet(site)
    loop = FieldLoop(site, Watched(), street, TrustLimits(answer_ms=2000))
    made = decide(loop, street, 12)
    loop.close()
    assert {decision.source for decision in made} == {"policy"}
    asked = [[decision.phases[light] for light in site.lights] for decision in made]
    wanted = [trained.act(*shown) for shown in seen[-12:]]
    assert asked == [[actions[agent] for agent in site.observer.agents] for actions in wanted]
    assert len({tuple(phases) for phases in asked}) > 1
    for place, agent in enumerate(site.observer.agents):  # the last of four commands, then the age
        phases = len(site.network.intersections[place].phases)
        memory = seen[-1][0][agent][-4 * phases - 1 :]
        assert memory[:-1].reshape(4, phases).argmax(1).tolist() == [
            phases_[place] for phases_ in asked[-2:-6:-1]
        ]
    assert not broken_rules(street.by_second)
